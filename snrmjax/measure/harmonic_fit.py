"""Harmonics of measured time records: their least-squares fit and its errors."""

from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Complex, Float, Int, Shaped

from snrmjax.measure.signals import checked_amplitudes, require_orders
from snrmjax.numerics.finite_slopes import safe_root
from snrmjax.numerics.result import AbstractResult, Variable
from snrmjax.numerics.status import Status

_SHOWN = 8


class HarmonicFitStatus(Status):
    """How the harmonic fit of one record ended."""

    SUCCESSFUL = 0, "fitted"
    NOT_FINITE = (
        1,
        "a sample is not finite, or the frequency is not finite and positive; remove such samples",
    )
    RANK_DEFICIENT = (
        2,
        "the samples cannot tell the harmonics apart; record longer (a period or more), sample "
        "faster than twice the highest harmonic, or fit fewer harmonics",
    )
    FREQUENCY_NOT_FOUND = (
        3,
        "the record does not hold a frequency near the given one (within 2/duration in Hz and a "
        "quarter of it); start closer, or record longer if the tone is lost in noise",
    )


class HarmonicFit(AbstractResult):
    """Harmonics of a record, x(t) = Re Σ X_k e^{ikΩ(t − reference_time)}, and their errors.

    `harmonic_order` starts with 0, the (real) mean. The covariance is that of the real parts of
    all harmonics followed by their imaginary parts; it is NaN when no degree of freedom is left.
    Everything but `condition` is NaN where `status` is not `HarmonicFitStatus.SUCCESSFUL`.
    """

    coordinates: ClassVar[tuple[str, ...]] = ("record", "harmonic")

    amplitude: Complex[Array, "*batch harmonic"]  # unit of the record, peak
    covariance: Float[Array, "*batch parameter parameter"]  # unit of the record, squared
    frequency: Float[Array, "*batch"]  # rad/s, as given or refined
    frequency_std: Float[Array, "*batch"]  # rad/s, NaN when the frequency was given
    noise_std: Float[Array, "*batch"]  # unit of the record, from the residual, per sample
    residual_rms: Float[Array, "*batch"]  # unit of the record
    condition: Float[Array, "*batch"]  # largest over smallest singular value of the fit
    reference_time: Float[Array, "*batch"]  # s
    status: Int[Array, "*batch"]
    degrees_of_freedom: int = eqx.field(static=True)
    harmonic_order: tuple[int, ...] = eqx.field(static=True)

    def summary(self) -> tuple[str, ...]:
        """See `AbstractResult`."""
        status = np.ravel(np.asarray(self.status))
        found = np.unique(np.asarray(self.frequency)[np.asarray(self.status) == 0]) / (2 * np.pi)
        failed = sorted({HarmonicFitStatus(int(one)) for one in status if one})
        at_first = np.asarray(self.harmonic_order) == 1
        fundamental = np.ravel(np.abs(np.asarray(self.amplitude)[..., at_first]))
        return (
            f"HarmonicFit: {len(status)} records, harmonics "
            f"{', '.join(map(str, self.harmonic_order))}",
            f"{int(np.sum(status == 0))} fitted"
            + (f" at {found.min():.6g} to {found.max():.6g} Hz" if found.size else ""),
            *(f"fundamental amplitude {size:.4g}" for size in fundamental[:_SHOWN]),
            *(f"{int(np.sum(status == one))}: {one.message}" for one in failed),
        )

    def variables(self) -> dict[str, Variable]:
        """See `AbstractResult`; all records in one row."""
        shape = (-1, len(self.harmonic_order))
        amplitude = np.asarray(self.amplitude).reshape(shape)
        std = np.asarray(self.complex_std).reshape(shape)
        both, unit = ("record", "harmonic"), "unit of the record"
        status = np.ravel(np.asarray(self.status))
        names = np.array([HarmonicFitStatus(int(one)).name.lower() for one in status], dtype=str)
        frequency = np.ravel(np.asarray(self.frequency)) / (2 * np.pi)
        orders = np.array(self.harmonic_order)
        return {
            "record": Variable(("record",), np.arange(len(status)), "1", "record"),
            "harmonic": Variable(("harmonic",), orders, "1", "harmonic order"),
            "amplitude_re": Variable(both, amplitude.real, unit, "amplitude, real part"),
            "amplitude_im": Variable(both, amplitude.imag, unit, "amplitude, imaginary part"),
            "complex_std": Variable(both, std, unit, "rms of the complex error"),
            "frequency_hz": Variable(("record",), frequency, "Hz", "fundamental frequency"),
            "status": Variable(("record",), names, "", "how the fit ended"),
        }

    def harmonic(self, order: int) -> Complex[Array, "*batch"]:
        """Amplitude of one harmonic, in the unit of the record."""
        return self.amplitude[..., self._index(order)]

    @property
    def real_std(self) -> Float[Array, "*batch harmonic"]:
        """1σ of the real parts, in the unit of the record."""
        return safe_root(self._variance[..., : len(self.harmonic_order)])

    @property
    def imag_std(self) -> Float[Array, "*batch harmonic"]:
        """1σ of the imaginary parts, in the unit of the record."""
        return safe_root(self._variance[..., len(self.harmonic_order) :])

    @property
    def complex_std(self) -> Float[Array, "*batch harmonic"]:
        """Root mean square of the complex errors, in the unit of the record."""
        n = len(self.harmonic_order)
        return safe_root(self._variance[..., :n] + self._variance[..., n:])

    @property
    def amplitude_std(self) -> Float[Array, "*batch harmonic"]:
        """1σ of the magnitudes, in the unit of the record; valid well above the noise."""
        unit = self.amplitude / jnp.abs(self.amplitude)
        return self._std_along(unit.real, unit.imag)

    @property
    def phase_std(self) -> Float[Array, "*batch harmonic"]:
        """1σ of the phases in rad; valid well above the noise."""
        unit = self.amplitude / jnp.abs(self.amplitude)
        return self._std_along(-unit.imag, unit.real) / jnp.abs(self.amplitude)

    @property
    def _variance(self) -> Float[Array, "*batch parameter"]:
        return jnp.diagonal(self.covariance, axis1=-2, axis2=-1)

    def _std_along(self, real: Array, imag: Array) -> Float[Array, "*batch harmonic"]:
        n = len(self.harmonic_order)
        mixed = jnp.diagonal(self.covariance[..., :n, n:], axis1=-2, axis2=-1)
        variance = real**2 * self._variance[..., :n] + imag**2 * self._variance[..., n:]
        return safe_root(jnp.maximum(variance + 2 * real * imag * mixed, 0.0))

    def _index(self, order: int) -> int:
        if order not in self.harmonic_order:
            raise ValueError(f"`order` must be one of {self.harmonic_order}, but is {order}.")
        return self.harmonic_order.index(order)


def fit_harmonics(
    time: Shaped[np.ndarray | Array, " sample"],
    signal: Shaped[np.ndarray | Array, "*batch sample"],
    frequency: float | Float[Array, "*batch"],
    harmonic_order: tuple[int, ...],
    *,
    refine_frequency: bool = False,
    reference_time: float | Float[Array, ""] = 0.0,
    max_condition: float = 1e6,
) -> HarmonicFit:
    """Least-squares fit of a mean and of harmonics to time records.

    Minimises Σ_n [x(t_n) − Re Σ_k X_k e^{ikΩ(t_n − t_ref)}]² by QR, in centred time; with
    `refine_frequency` over Ω too, by a scan and Gauss–Newton steps with the X_k eliminated. The
    stated covariance is that of least squares, with the noise taken from the residual.

    Arguments: `time` in s, in any order and spacing; `signal` in any unit, one row a record;
    `frequency` Ω in rad/s, one or one per record; `harmonic_order`, the mean is always fitted
    and listed first as order 0; `reference_time` in s, where the phases count from;
    `max_condition`, above which the harmonics are taken as not separable.
    Returns `HarmonicFit`; `status` is RANK_DEFICIENT for too short or too coarse records,
    FREQUENCY_NOT_FOUND when the refined frequency is farther off than 4π/duration or a quarter,
    or the tone stands out by less than five standard deviations, NOT_FINITE for NaN;
    the status's `message` says what to try.
    Raises `ValueError` for wrong shapes, orders or a frequency that is not positive.
    Differentiable by time, signal and frequency; a record without a fit leaves the derivatives of
    the others as they are. `condition` has no derivative.
    Validity: the standard deviations assume independent errors of equal size from sample to
    sample; correlated noise (filters, oversampling) makes the true ones larger.
    Reference: Kwarta & Allen, section 3.1 (the multi-sine fit named above their Eq. (20)).

    >>> time = np.linspace(0.0, 1.3, 50)
    >>> fit = fit_harmonics(time, 2.0 + 3.0 * np.cos(9.0 * time), 9.0, (1,))
    >>> fit.harmonic_order, fit.amplitude.real.round(9)
    ((0, 1), Array([2., 3.], dtype=float64))
    """
    times, records = jnp.asarray(time, dtype=float), jnp.asarray(signal, dtype=float)
    if times.ndim != 1 or times.size == 0:
        raise ValueError(f"`time` must be a vector of samples, but has shape {times.shape}.")
    if records.ndim == 0 or records.shape[-1] != times.size:
        raise ValueError(
            f"`signal` must end in an axis of {times.size} samples, as many as `time` has, "
            f"but has shape {records.shape}."
        )
    orders = orders_with_mean(harmonic_order)
    omega = checked_frequency(frequency, records.shape[:-1])
    reference, limit = (jnp.asarray(x, dtype=float) for x in (reference_time, max_condition))
    return _fit_batch(times, records, omega, reference, limit, orders, refine_frequency)


@eqx.filter_jit
def _fit_batch(
    time: Float[Array, " sample"],
    records: Float[Array, "*batch sample"],
    frequency: Float[Array, "*batch"],
    reference_time: Float[Array, ""],
    max_condition: Float[Array, ""],
    orders: tuple[int, ...],
    refine: bool,
) -> HarmonicFit:
    def one(record: Float[Array, " sample"], omega: Float[Array, ""]) -> HarmonicFit:
        return _fit_one(time, record, omega, reference_time, max_condition, orders, refine)

    rows = records.reshape(-1, time.size)
    if frequency.ndim == 0 and not refine:
        # One frequency for all: one factorisation serves all records.
        fit = jax.vmap(lambda row: one(row, frequency))(rows)
    else:
        # One after the other: a batch would wait for its slowest record, and large batches of
        # factorisations have been seen to hang in XLA's thread pool on two cores.
        each = jnp.broadcast_to(frequency, records.shape[:-1]).reshape(-1)
        fit = jax.lax.map(lambda pair: one(*pair), (rows, each))
    return jax.tree.map(lambda leaf: leaf.reshape(records.shape[:-1] + leaf.shape[1:]), fit)


def _fit_one(
    time: Float[Array, " sample"],
    record: Float[Array, " sample"],
    frequency: Float[Array, ""],
    reference_time: Float[Array, ""],
    max_condition: Float[Array, ""],
    orders: tuple[int, ...],
    refine: bool,
) -> HarmonicFit:
    centre = jnp.mean(time)
    # Centred: the frequency is then least correlated with the phases, and Ωt keeps its digits.
    centred = time - centre
    duration = jnp.max(time) - jnp.min(time)
    finite = jnp.all(jnp.isfinite(record)) & jnp.all(jnp.isfinite(time))
    finite &= jnp.isfinite(frequency) & (frequency > 0)
    # A record that cannot be fitted is a tone: everything is regular, and masked at the end.
    timed = jnp.isfinite(centred)
    centred = jnp.where(jnp.all(timed), centred, jnp.linspace(-0.5, 0.5, time.size))
    duration = jnp.where(jnp.all(timed), duration, 1.0)
    frequency = jnp.where(jnp.isfinite(frequency) & (frequency > 0), frequency, 1.0 / duration)
    values = jnp.where(finite, record, jnp.cos(frequency * centred))
    omega, converged = frequency, jnp.array(True)
    if refine:
        # Two lobes of the record, but never so far that a harmonic is taken for the fundamental.
        reach = jnp.minimum(4 * jnp.pi / duration, frequency / 4)
        omega, converged = _refined_frequency(centred, values, frequency, reach, orders)
    design = _design(centred, omega, orders)
    upper, coefficients = _least_squares(design, values)
    residual = values - design @ coefficients
    unknown, scale = coefficients, jnp.ones(coefficients.shape)
    if refine:
        slope = jax.jvp(lambda w: _design(centred, w, orders) @ coefficients, (omega,), (1.0,))[1]
        size = jnp.sqrt(jnp.mean((design[:, 1:] @ coefficients[1:]) ** 2)) * duration
        size = jnp.where(size > 0, size, 1.0)
        upper, _ = _least_squares(jnp.column_stack([design, slope / size]), values)
        unknown, scale = jnp.append(coefficients, omega), jnp.append(scale, 1.0 / size)
    singular = jnp.linalg.svd(jax.lax.stop_gradient(upper), compute_uv=False)
    condition = jnp.where(singular[-1] > 0, singular[0] / singular[-1], jnp.inf)
    freedom = record.size - unknown.size
    squares = jnp.sum(residual**2)
    noise_variance = squares / freedom if freedom > 0 else jnp.array(jnp.nan)
    root = scale[:, None] * jax.scipy.linalg.solve_triangular(upper, jnp.eye(unknown.size))
    frequency_std = jnp.array(jnp.nan)
    if refine:
        frequency_std = safe_root(noise_variance) * jnp.linalg.norm(root[-1])
        # Five standard deviations of a tone, and what noise puts into every harmonic. Written so
        # that an unknown (NaN) noise passes.
        explained = jnp.sum((values - jnp.mean(values)) ** 2) - squares
        converged &= ~(explained < noise_variance * (25.0 + 4.0 * (len(orders) - 1)))

    def parts(unknown: Float[Array, " unknown"]) -> Float[Array, " parameter"]:
        final = unknown[-1] if refine else omega
        return _parts_at(unknown, final * (reference_time - centre), orders)

    turned = jax.jacfwd(parts)(unknown) @ root
    real, imag = jnp.split(parts(unknown), 2)
    status = jnp.where(
        converged, int(HarmonicFitStatus.SUCCESSFUL), int(HarmonicFitStatus.FREQUENCY_NOT_FOUND)
    )
    separable = (condition <= max_condition) & (freedom >= 0)
    status = jnp.where(separable, status, int(HarmonicFitStatus.RANK_DEFICIENT))
    status = jnp.where(finite, status, int(HarmonicFitStatus.NOT_FINITE))
    good = status == int(HarmonicFitStatus.SUCCESSFUL)

    def masked(value: Array) -> Array:
        return jnp.where(good, value, jnp.nan)

    return HarmonicFit(
        amplitude=masked(jax.lax.complex(real, imag)),
        covariance=masked(noise_variance * (turned @ turned.T)),
        frequency=masked(omega),
        frequency_std=masked(frequency_std),
        noise_std=masked(safe_root(noise_variance)),
        residual_rms=masked(safe_root(squares / record.size)),
        condition=condition,
        reference_time=reference_time,
        status=status,
        degrees_of_freedom=freedom,
        harmonic_order=orders,
    )


def _design(
    time: Float[Array, " sample"], frequency: Float[Array, ""], orders: tuple[int, ...]
) -> Float[Array, "sample unknown"]:
    """Columns 1, cos kΩt and −sin kΩt, whose coefficients are the mean, Re X_k and Im X_k."""
    turn = jnp.exp(1j * frequency * time)
    powers = jnp.stack([turn**order for order in orders[1:]], axis=1)
    return jnp.concatenate([jnp.ones((time.size, 1)), powers.real, -powers.imag], axis=1)


@jax.custom_jvp
def _least_squares(
    design: Float[Array, "sample unknown"], values: Float[Array, " sample"]
) -> tuple[Float[Array, "unknown unknown"], Float[Array, " unknown"]]:
    """Triangular factor and coefficients; with too few samples the factor is singular."""
    missing = max(design.shape[1] - design.shape[0], 0)
    orthogonal, upper = jnp.linalg.qr(jnp.pad(design, ((0, missing), (0, 0))))
    projected = orthogonal.T @ jnp.pad(values, (0, missing))
    return upper, jax.scipy.linalg.solve_triangular(upper, projected)


@_least_squares.defjvp
def _least_squares_jvp(
    primals: tuple[Array, Array], tangents: tuple[Array, Array]
) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    """By the normal equations, which cost less than the derivative of the QR factorisation."""
    (design, values), (design_dot, values_dot) = primals, tangents
    upper, coefficients = _least_squares(design, values)
    gram_dot = design_dot.T @ design + design.T @ design_dot
    half = jax.scipy.linalg.solve_triangular(upper, gram_dot, trans="T")
    both = jax.scipy.linalg.solve_triangular(upper, half.T, trans="T")
    upper_dot = (jnp.triu(both) - 0.5 * jnp.diag(jnp.diag(both))) @ upper
    right = design_dot.T @ (values - design @ coefficients)
    right += design.T @ (values_dot - design_dot @ coefficients)
    half = jax.scipy.linalg.solve_triangular(upper, right, trans="T")
    return (upper, coefficients), (upper_dot, jax.scipy.linalg.solve_triangular(upper, half))


def _refined_frequency(
    time: Float[Array, " sample"],
    values: Float[Array, " sample"],
    frequency: Float[Array, ""],
    reach: Float[Array, ""],
    orders: tuple[int, ...],
) -> tuple[Float[Array, ""], Bool[Array, ""]]:
    """Frequency within `reach` that leaves the smallest residual, and whether it was found."""
    size = safe_root(jnp.sum((values - jnp.mean(values)) ** 2))
    # Nothing at all has no frequency: what is found for a tone instead is refused.
    moving = size > 0
    tone = jnp.cos(frequency * time)
    scaled = jnp.where(moving, values / jnp.where(moving, size, 1.0), tone)

    def residual(shift: Float[Array, ""], record: tuple[Array, ...]) -> Float[Array, " sample"]:
        # Normal equations: the residual feels an error of the amplitudes in second order only.
        samples, centre, width = record
        design = _design(time, centre + shift * width, orders)
        return samples - design @ jnp.linalg.solve(design.T @ design, design.T @ samples)

    # The misfit has side lobes 2π/duration apart: start from the lowest of a scan.
    record = (scaled, frequency, reach)
    fixed = jax.lax.stop_gradient(record)
    shifts = jnp.linspace(-1.5, 1.5, 25)
    misfits = jax.lax.map(lambda shift: jnp.sum(residual(shift, fixed) ** 2), shifts)
    solution: optx.Solution = optx.least_squares(
        residual,
        optx.GaussNewton(rtol=1e-8, atol=1e-9),
        shifts[jnp.nanargmin(misfits)],
        args=record,
        max_steps=64,
        throw=False,
    )
    found = (solution.result == optx.RESULTS.successful) & (jnp.abs(solution.value) < 1) & moving
    return frequency + solution.value * reach, jnp.asarray(found)


def _parts_at(
    unknown: Float[Array, " unknown"], angle: Float[Array, ""], orders: tuple[int, ...]
) -> Float[Array, " parameter"]:
    """Real, then imaginary parts of the phasors, counted from `angle` of the fundamental on."""
    n = len(orders)
    real = unknown[:n]
    imag = jnp.concatenate([jnp.zeros(1), unknown[n : 2 * n - 1]])
    turn = angle * jnp.asarray(orders, dtype=float)
    cosine, sine = jnp.cos(turn), jnp.sin(turn)
    return jnp.concatenate([real * cosine - imag * sine, real * sine + imag * cosine])


def phasor_relative_to_force(
    response: Complex[Array, "*batch harmonic"],
    force: Complex[Array, "*batch"],
    orders: tuple[int, ...],
) -> Complex[Array, "*batch harmonic"]:
    """Move the origin of time so that the fundamental of the force is real and positive.

    X_k e^{−ik arg F₁}: harmonic k turns k times as far as the fundamental.

    Arguments: `response` in any unit, one column a harmonic of `orders`; `force` the phasor F₁ of
    the force fundamental on the same time axis, in N. Returns the unit of `response`; NaN where
    the force is zero; differentiable. Raises `ValueError` when `orders` does not fit.
    Reference: Kwarta & Allen, section 3.1, below Eq. (20).

    >>> phasor_relative_to_force(jnp.array([1j, 1.0 + 0j]), jnp.array(2j), (1, 2)).real.round(12)
    Array([ 1., -1.], dtype=float64)
    """
    orders = require_orders("orders", orders)
    amplitudes = checked_amplitudes("response", response, orders)
    forces = jnp.asarray(force)
    phase = jnp.where(jnp.abs(forces) > 0, jnp.angle(forces), jnp.nan)
    return amplitudes * jnp.exp(-1j * phase[..., None] * jnp.asarray(orders, dtype=float))


def checked_frequency(
    frequency: float | Float[Array, "*batch"], batch: tuple[int, ...]
) -> Float[Array, "*batch"]:
    """Frequency as an array, or a `ValueError` for a wrong shape or when it is not positive.

    A traced frequency has no sign yet: only its shape is checked.
    """
    omega = jnp.asarray(frequency, dtype=float)
    if omega.shape not in ((), batch):
        shapes = " or ".join(str(shape) for shape in dict.fromkeys(((), batch)))
        raise ValueError(f"`frequency` must have shape {shapes}, but has {omega.shape}.")
    if not isinstance(omega, jax.core.Tracer) and not np.all(np.asarray(omega) > 0):
        raise ValueError(f"`frequency` must be positive, but is {frequency}.")
    return omega


def orders_with_mean(harmonic_order: tuple[int, ...]) -> tuple[int, ...]:
    """Harmonic orders with the mean, 0, first, or a `ValueError` when none is above 0."""
    orders = require_orders("harmonic_order", harmonic_order)
    positive = tuple(order for order in orders if order > 0)
    if not positive:
        raise ValueError(
            f"`harmonic_order` must contain a harmonic above 0, but is {harmonic_order}."
        )
    return (0, *positive)
