"""Harmonics of measured time records: their least-squares fit and its errors."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float, Int, Shaped

from snrmjax.measure.signals import checked_amplitudes, require_orders
from snrmjax.numerics.finite_slopes import safe_root
from snrmjax.numerics.result import AbstractResult, Variable, quantity, setting
from snrmjax.numerics.rules import POSITIVE, require
from snrmjax.numerics.status import Status

_LARGEST_CONDITION = 1e6  # above which harmonics are taken as not separable


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


class HarmonicFit(AbstractResult):
    """Harmonics of records, x(t) = Re Σ X_k e^{ikΩ(t − reference_time)}, and their errors.

    `harmonic_order` starts with 0, the (real) mean. The covariance is that of the real parts of
    all harmonics followed by their imaginary parts; it is NaN when no degree of freedom is left.
    What belongs to a record is NaN where its `status` is not `HarmonicFitStatus.SUCCESSFUL`.
    """

    covariance: Float[Array, "*batch parameter parameter"]  # unit of the record, squared
    condition: Float[Array, ""]  # largest over smallest singular value of the fit
    harmonic_order: tuple[int, ...] = eqx.field(static=True)
    amplitude: Complex[Array, "*batch harmonic"] = quantity(
        "record harmonic", "unit of the record", "amplitude"
    )  # peak
    noise_std: Float[Array, "*batch"] = quantity(
        "record", "unit of the record", "noise of a sample"
    )  # from the residual
    residual_rms: Float[Array, "*batch"] = quantity("record", "unit of the record", "residual")
    status: Int[Array, "*batch"] = quantity("record", "", "how the fit ended", of=HarmonicFitStatus)
    frequency: Float[Array, ""] = quantity("", "Hz", "fundamental frequency")
    reference_time: Float[Array, ""] = quantity("", "s", "where phases count from")
    degrees_of_freedom: int = setting()

    def variables(self) -> dict[str, Variable]:
        """All records in one row, with their errors and the harmonics' orders."""
        orders, whole = np.array(self.harmonic_order), ("record", "harmonic")

        def in_a_row(values: Array, *dimensions: int) -> np.ndarray:
            return np.asarray(values).reshape(-1, *dimensions)

        rows = eqx.tree_at(
            lambda fit: (fit.amplitude, fit.noise_std, fit.residual_rms, fit.status),
            self,
            (
                in_a_row(self.amplitude, len(orders)),
                *(in_a_row(fit) for fit in (self.noise_std, self.residual_rms, self.status)),
            ),
        )
        std = in_a_row(self.complex_std, len(orders))
        return {
            **super(HarmonicFit, rows).variables(),
            "harmonic": Variable(whole[1:], orders, "1", "harmonic order"),
            "complex_std": Variable(whole, std, "unit of the record", "rms of the complex error"),
        }

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


def fit_harmonics(
    time: Shaped[np.ndarray | Array, " sample"],
    signal: Shaped[np.ndarray | Array, "*batch sample"],
    frequency: float | Float[Array, ""],
    harmonic_order: tuple[int, ...],
    *,
    reference_time: float | Float[Array, ""] = 0.0,
) -> HarmonicFit:
    """Least-squares fit of a mean and of harmonics to time records.

    Minimises Σ_n [x(t_n) − Re Σ_k X_k e^{ikΩ(t_n − t_ref)}]² by QR, in centred time. The stated
    covariance is that of least squares, with the noise taken from the residual.

    Arguments: `time` in s, in any order and spacing; `signal` in any unit, one row a record;
    `frequency` Ω in rad/s (`stepped_sine_states` finds that of a record by itself);
    `harmonic_order`, the mean is always fitted and listed first as order 0; `reference_time` in s,
    where the phases count from.
    Returns `HarmonicFit`; `status` is RANK_DEFICIENT for too short or too coarse records,
    NOT_FINITE for NaN; the status's `message` says what to try.
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
    orders = require_orders("harmonic_order", harmonic_order)
    if not any(orders):
        raise ValueError(
            f"`harmonic_order` must contain a harmonic above 0, but is {harmonic_order}."
        )
    omega = jnp.asarray(frequency, dtype=float)
    if omega.ndim:
        raise ValueError(f"`frequency` must be one number, but has shape {omega.shape}.")
    require("`frequency`", omega, POSITIVE)
    reference = jnp.asarray(reference_time, dtype=float)
    return _fitted(times, records, omega, reference, (0, *(k for k in orders if k)))


@eqx.filter_jit
def _fitted(
    time: Float[Array, " sample"],
    records: Float[Array, "*batch sample"],
    frequency: Float[Array, ""],
    reference_time: Float[Array, ""],
    orders: tuple[int, ...],
) -> HarmonicFit:
    timed = jnp.all(jnp.isfinite(time)) & jnp.isfinite(frequency) & (frequency > 0)
    finite = timed & jnp.all(jnp.isfinite(records), axis=-1)
    # What cannot be fitted is zero over one period: everything is regular, and masked at the end.
    safe_time = jnp.where(timed, time, jnp.linspace(0.0, 1.0, time.size))
    omega = jnp.where(timed, frequency, 2 * jnp.pi)
    values = jnp.where(finite[..., None], records, 0.0)
    # Centred: Ωt keeps its digits however late the clock.
    centre = jnp.mean(safe_time)
    turns = jnp.exp(1j * omega * (safe_time - centre))
    powers = jnp.stack([turns**order for order in orders[1:]], axis=1)
    # The coefficients of 1, cos kΩt and −sin kΩt are the mean, Re X_k and Im X_k.
    design = jnp.concatenate([jnp.ones((time.size, 1)), powers.real, -powers.imag], axis=1)
    n_unknowns = design.shape[1]
    missing = max(n_unknowns - time.size, 0)  # with too few samples the factor is singular
    orthogonal, upper = jnp.linalg.qr(jnp.pad(design, ((0, missing), (0, 0))))
    inverse = jax.scipy.linalg.solve_triangular(upper, jnp.eye(n_unknowns))
    coefficients = values @ orthogonal[: time.size] @ inverse.T
    squares = jnp.sum((values - coefficients @ design.T) ** 2, axis=-1)
    freedom = time.size - n_unknowns
    noise_variance = squares / freedom if freedom > 0 else jnp.full_like(squares, jnp.nan)
    angle = omega * (reference_time - centre) * jnp.asarray(orders, dtype=float)
    cosine, sine = jnp.diag(jnp.cos(angle)), jnp.diag(jnp.sin(angle))
    to_parts = jnp.block([[cosine, -sine[:, 1:]], [sine, cosine[:, 1:]]])
    parts, root = coefficients @ to_parts.T, to_parts @ inverse
    singular = jnp.linalg.svd(jax.lax.stop_gradient(upper), compute_uv=False)
    condition = jnp.where(singular[-1] > 0, singular[0] / singular[-1], jnp.inf)
    separable = (condition <= _LARGEST_CONDITION) & (freedom >= 0)
    status = jnp.where(
        separable, int(HarmonicFitStatus.SUCCESSFUL), int(HarmonicFitStatus.RANK_DEFICIENT)
    )
    status = jnp.where(finite, status, int(HarmonicFitStatus.NOT_FINITE))
    good = status == int(HarmonicFitStatus.SUCCESSFUL)

    def masked(value: Array) -> Array:
        return jnp.where(good.reshape(good.shape + (1,) * (value.ndim - good.ndim)), value, jnp.nan)

    return HarmonicFit(
        amplitude=masked(jax.lax.complex(*jnp.split(parts, 2, axis=-1))),
        covariance=masked(noise_variance[..., None, None] * (root @ root.T)),
        noise_std=masked(safe_root(noise_variance)),
        residual_rms=masked(safe_root(squares / time.size)),
        status=status,
        frequency=frequency,
        condition=condition,
        reference_time=reference_time,
        degrees_of_freedom=freedom,
        harmonic_order=orders,
    )


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
