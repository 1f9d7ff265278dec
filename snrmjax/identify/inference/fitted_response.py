"""What a joint fit says: curves with bands, and responses, resonances and folds with bands."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float

from snrmjax.identify.inference.fitted_curves import (
    beyond_estimation,
    open_choice,
    values_at_displacement,
)
from snrmjax.identify.joint.force_balance import BalanceData, Spread, Unknowns, with_deviations
from snrmjax.identify.joint.free_unknowns import Restore
from snrmjax.identify.joint.joint_fit import JointFit
from snrmjax.identify.pointwise.backbone import Backbone
from snrmjax.identify.pointwise.curve_fit import PchipCurve
from snrmjax.identify.pointwise.prediction import (
    LARGEST_AMPLITUDE_RATIO,
    predict_response,
    resonances,
)
from snrmjax.model.modes import LinearModes, residual_velocity
from snrmjax.numerics.compiled import compiled

_KNOTS = 120
_ONTO_THE_CURVE = 4  # steps
_ITERATIONS = 12


class FittedPoint(NamedTuple):
    """A resonance or a fold, with 1σ."""

    force: float  # N
    frequency: float  # rad/s
    frequency_std: float
    velocity: float  # m/s at the fit's sensor, residual modes included
    velocity_std: float
    continued: bool  # beyond the measured amplitudes


class FittedResponse(NamedTuple):
    """A response curve along rising and falling amplitude, with 1σ at fixed frequency."""

    force: float  # N
    frequency: Float[np.ndarray, " point"]  # rad/s
    frequency_std: Float[np.ndarray, " point"]  # at fixed amplitude
    velocity: Complex[np.ndarray, " point"]  # m/s
    velocity_std: Float[np.ndarray, " point"]  # of the magnitude at fixed frequency; large at folds
    stable: Bool[np.ndarray, " point"]
    continued: Bool[np.ndarray, " point"]
    resonances: tuple[FittedPoint, ...]
    folds: tuple[FittedPoint, ...]
    note: str  # where the curve extrapolates the fit; empty where it nowhere does


def as_backbone(
    fit: JointFit, *, largest_amplitude_ratio: float = LARGEST_AMPLITUDE_RATIO
) -> Backbone:
    """The fitted curves against displacement, through many knots: for what takes a `Backbone`.

    Damping that belongs to the velocity is taken where it lies on the backbone. The knots reach up
    to `largest_amplitude_ratio` times the largest measured amplitude.
    """
    displacement = largest_amplitude_ratio * fit.largest[0] * np.linspace(0.0, 1.0, _KNOTS)
    sampled = values_at_displacement(fit, displacement)
    # A polynomial may fall below zero beyond the data: there is no motion there.
    sound = np.append(sampled[0][:, 0] > 0, False).argmin()
    if sound < _KNOTS:
        displacement = displacement[sound - 1] * np.linspace(0.0, 1.0, _KNOTS)
        sampled = values_at_displacement(fit, displacement)
    values, slopes = (jnp.asarray(part) for part in sampled[:2])
    shifts = jnp.asarray(open_choice(fit, displacement=displacement))
    covariance = [
        slopes[:, k] @ fit.covariance @ slopes[:, k].T + shifts[:, :, k].T @ shifts[:, :, k]
        for k in range(2)
    ]
    measured = np.asarray(fit.motion().displacement)
    j, r = fit.modes.mode_of_interest, fit.data.sensor
    # Dry friction has no finite damping at rest: there the next knot's value stands.
    damping = (
        values[:, 1].at[0].set(jnp.where(jnp.isfinite(values[0, 1]), values[0, 1], values[1, 1]))
    )
    return Backbone(
        squared_frequency=PchipCurve(jnp.asarray(displacement), values[:, 0]),
        modal_damping=PchipCurve(jnp.asarray(displacement), damping),
        squared_frequency_covariance=covariance[0],
        modal_damping_covariance=jnp.nan_to_num(covariance[1]),
        modal_constant=fit.modes.mode_shape[r, j] * fit.modes.participation[j],
        smallest=jnp.asarray(measured.min()),
        largest=jnp.asarray(measured.max()),
        argument="displacement",
        sensor=fit.modes.sensors[r],
    )


def fitted_response(
    fit: JointFit,
    force: float,
    *,
    from_frequency: float = 0.0,
    to_frequency: float = np.inf,
    points_per_side: int = 200,
    largest_amplitude_ratio: float = LARGEST_AMPLITUDE_RATIO,
) -> list[FittedResponse]:
    """Response curves under a force with bands, and its resonances and folds with theirs.

    Bands come from the implicit function theorem on the curve's own equation
    |(ω̃² − Ω²) + iΩδ| X = |A|F: at fixed amplitude for the frequency, at fixed frequency for the
    velocity, along both equations of a resonance and of a fold. They include what the choice among
    families leaves open: what rivals say of the same points.

    Arguments: `force` in N, frequencies in rad/s; curves end at `largest_amplitude_ratio` times
    the largest measured amplitude, beyond which the fitted curves are extrapolated.
    Returns the connected curves, the main one first; resonances and folds with the first curve
    that has them; the `note` of each says where it extrapolates.
    Raises `ValueError` for a force or a ratio that is not positive.
    """
    ratio = {"largest_amplitude_ratio": largest_amplitude_ratio}
    rough = as_backbone(fit, **ratio)
    load = abs(float(rough.modal_constant)) * force
    settings = {"from_frequency": from_frequency, "to_frequency": to_frequency, **ratio}
    curves = predict_response(rough, fit.modes, force, points_per_side=points_per_side, **settings)
    tips = [
        (r.amplitude, r.frequency)
        for r in resonances(rough, fit.modes, force, **ratio)
        if from_frequency <= r.frequency <= to_frequency
    ]
    found = [_located(fit, force, load, "resonance", *tip, largest_amplitude_ratio) for tip in tips]
    answer = []
    for number, curve in enumerate(curves):
        moved = _banded(fit, force, load, curve.amplitude, curve.frequency)
        turns = _turns(curve.frequency, curve.amplitude)
        folds = [
            _located(fit, force, load, "fold", *turn, largest_amplitude_ratio) for turn in turns
        ]
        answer.append(
            FittedResponse(
                force=force,
                frequency=moved[0],
                frequency_std=moved[1],
                velocity=moved[2],
                velocity_std=moved[3],
                stable=curve.stable,
                continued=curve.continued,
                resonances=tuple(p for p in found if p is not None) if number == 0 else (),
                folds=tuple(p for p in folds if p is not None),
                note=curve.note,
            )
        )
    return answer


def _turns(frequency: np.ndarray, amplitude: np.ndarray) -> list[tuple[float, float]]:
    """Amplitude and frequency of the points where a curve turns back in frequency."""
    steps = np.sign(np.diff(frequency))
    at = np.flatnonzero(steps[:-1] * steps[1:] < 0) + 1
    return [(float(amplitude[k]), float(frequency[k])) for k in at]


def _excess(unknowns: Unknowns, load: Array, x: Array, omega: Array) -> Float[Array, "*batch"]:
    """|(ω̃² − Ω²) + iΩδ|² X²/load² − 1."""
    squared, damping = _curves_at(unknowns, x, omega)
    return ((squared - omega**2) ** 2 + (omega * damping) ** 2) * (x / load) ** 2 - 1.0


def _curves_at(unknowns: Unknowns, x: Array, omega: Array) -> tuple[Array, Array]:
    squared, damping = unknowns.squared_frequency, unknowns.modal_damping
    speed = x * omega
    return (
        squared(squared.amplitude(x, speed)),
        damping(damping.amplitude(x, speed)),
    )


def _velocity_at(
    unknowns: Unknowns,
    modes: LinearModes,
    spread: Spread,
    data: BalanceData,
    force: Array,
    x: Array,
    omega: Array,
) -> Complex[Array, "*batch"]:
    squared, damping = _curves_at(unknowns, x, omega)
    j, r = modes.mode_of_interest, data.sensor
    constant = modes.mode_shape[r, j] * modes.participation[j]
    own = 1j * omega * constant * force / (squared - omega**2 + 1j * omega * damping)
    linear = with_deviations(modes, unknowns.linear, spread.linear)
    return own + residual_velocity(linear, omega, jnp.broadcast_to(force, omega.shape))[..., r]


class _Banded(NamedTuple):
    amplitude: np.ndarray
    frequency: np.ndarray
    frequency_std: np.ndarray
    velocity: np.ndarray
    velocity_std: np.ndarray
    excess: np.ndarray  # of the curve's equation
    by_amplitude: np.ndarray  # its slopes
    by_frequency: np.ndarray
    through: np.ndarray  # slope of the speed by the amplitude


def _banded(
    fit: JointFit, force: float, load: float, amplitude: np.ndarray, frequency: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Frequency and complex velocity of a curve's points, each with 1σ."""

    def banded(one: JointFit, x: Array, omega: Array, steps: int) -> _Banded:
        program = one.programmed()
        settings = (program.vector, program.restore, one.modes, one.spread, one.data)
        covariance = jnp.asarray(program.spread_out(one.covariance))
        given = (covariance, jnp.asarray(force), jnp.asarray(load))
        return _Banded(*map(np.asarray, _bands(*settings, *given, x, omega, np.array(steps))))

    # The points come from curves drawn anew through knots: steps put them on the fit's own.
    own = banded(fit, jnp.asarray(amplitude), jnp.asarray(frequency), _ONTO_THE_CURVE)
    values = own.frequency, np.abs(own.velocity)
    variances = own.frequency_std**2, own.velocity_std**2
    added = [np.zeros_like(one) for one in variances]
    for rival in fit.rivals:
        other = banded(rival.fit, jnp.asarray(own.amplitude), jnp.asarray(own.frequency), 0)
        # Where the rival's curve would be, to first order, by the slopes of the fit's own.
        frequency = own.frequency - other.excess / own.by_frequency
        there = np.abs(other.velocity) - own.through / own.by_amplitude * other.excess
        answers = ((frequency, other.frequency_std), (there, other.velocity_std))
        for k, (answer, std) in enumerate(answers):
            given = (values[k], variances[k], answer, std**2)
            added[k] += beyond_estimation(rival.weight, *given) ** 2
    wide = [np.sqrt(one + more) for one, more in zip(variances, added, strict=True)]
    return own.frequency, wide[0], own.velocity, wide[1]


@compiled
def _bands(
    vector: Array,
    restore: Restore,
    modes: LinearModes,
    spread: Spread,
    data: BalanceData,
    covariance: Array,
    force: Array,
    load: Array,
    x: Array,
    omega: Array,
    steps: Array,
) -> tuple[Array, ...]:
    """The fields of `_Banded`, after so many steps onto the curve."""
    ones = jnp.ones_like(x)

    def excess(vector: Array, x: Array, omega: Array) -> Array:
        return _excess(restore(vector), load, x, omega)

    def by(position: int, x: Array, omega: Array) -> Array:
        direction = [jnp.zeros_like(vector), 0 * ones, 0 * ones]
        direction[position] = ones
        return jax.jvp(excess, (vector, x, omega), tuple(direction))[1]

    def step(_: int, point: tuple[Array, Array]) -> tuple[Array, Array]:
        x, omega = point
        first, second = by(1, x, omega) * x, by(2, x, omega) * omega
        share = excess(vector, x, omega) / (first**2 + second**2)
        return x - share * first * x, omega - share * second * omega

    x, omega = jax.lax.fori_loop(0, steps, step, (x, omega))
    by_x, by_omega = by(1, x, omega), by(2, x, omega)
    by_vector = jax.jacfwd(excess)(vector, x, omega)

    def speed(vector: Array, x: Array) -> Array:
        return jnp.abs(_velocity_at(restore(vector), modes, spread, data, force, x, omega))

    direct = jax.jacfwd(speed)(vector, x)
    through = jax.jvp(lambda x: speed(vector, x), (x,), (ones,))[1]
    moved = direct - (through / by_x)[:, None] * by_vector
    frequency_std = jnp.sqrt(jnp.einsum("op,pq,oq->o", by_vector, covariance, by_vector))
    velocity_std = jnp.sqrt(jnp.einsum("op,pq,oq->o", moved, covariance, moved))
    velocity = _velocity_at(restore(vector), modes, spread, data, force, x, omega)
    known = (x, omega, frequency_std / jnp.abs(by_omega), velocity, velocity_std)
    return *known, excess(vector, x, omega), by_x, by_omega, through


def _located(
    fit: JointFit,
    force: float,
    load: float,
    kind: str,
    amplitude: float,
    frequency: float,
    ratio: float,
) -> FittedPoint | None:
    """A resonance or a fold near a point, or None where Newton's method finds none."""
    found = _values_and_slopes(fit, force, load, kind, amplitude, frequency)
    if found is None:
        return None
    values, slopes = found
    variance = np.einsum("op,pq,oq->o", slopes, fit.covariance, slopes)
    widened = variance
    for rival in fit.rivals:
        answer = _of_a_rival(
            rival.fit, force, load, kind, float(values[2]), float(values[0]), ratio
        )
        if answer is None:
            continue  # a fold that the rival does not have moves no band
        own = np.einsum("op,pq,oq->o", answer[1], rival.fit.covariance, answer[1])
        shift = beyond_estimation(rival.weight, values, variance, answer[0], own)
        widened = widened + shift**2
    (omega, speed, x), std = values, np.sqrt(widened)
    return FittedPoint(
        *(force, float(omega), float(std[0]), float(speed), float(std[1])),
        bool(x > fit.largest[0] * (1 + 1e-9)),
    )


def _of_a_rival(
    rival: JointFit,
    force: float,
    load: float,
    kind: str,
    amplitude: float,
    frequency: float,
    ratio: float,
) -> tuple[np.ndarray, np.ndarray] | None:
    """A rival's resonance or fold that corresponds to one of the fit, and its slopes."""
    near = _values_and_slopes(rival, force, load, kind, amplitude, frequency)
    if near is not None:
        return near
    rough = as_backbone(rival, largest_amplitude_ratio=ratio)
    if kind == "resonance":
        tips = resonances(rough, rival.modes, force, largest_amplitude_ratio=ratio)
        starts = [(tip.amplitude, tip.frequency) for tip in tips]
    else:
        curves = predict_response(rough, rival.modes, force, largest_amplitude_ratio=ratio)
        starts = [turn for c in curves for turn in _turns(c.frequency, c.amplitude)]
    for start in sorted(starts, key=lambda one: abs(np.log(one[0] / amplitude))):
        found = _values_and_slopes(rival, force, load, kind, *start)
        if found is not None:
            return found
    return None


def point_slopes(
    fit: JointFit, force: float, kind: str, point: FittedPoint
) -> Float[np.ndarray, "output unknown"]:
    """Derivatives of a resonance's or fold's frequency and velocity by the free unknowns.

    Raises `ValueError` when there is no such point there.
    """
    j, r = fit.modes.mode_of_interest, fit.data.sensor
    load = abs(float(fit.modes.mode_shape[r, j] * fit.modes.participation[j])) * force
    start = point.velocity / point.frequency
    found = _values_and_slopes(fit, force, load, kind, start, point.frequency)
    if found is None:
        raise ValueError(f"there is no {kind} near {point.frequency / (2 * np.pi):.4g} Hz.")
    return found[1][:2]


def _values_and_slopes(
    fit: JointFit, force: float, load: float, kind: str, amplitude: float, frequency: float
) -> tuple[np.ndarray, np.ndarray] | None:
    """Frequency, velocity and displacement of a point, and their slopes by the unknowns."""
    vector, restore, own = fit.programmed()
    unit = jnp.array([amplitude, frequency])
    given = (jnp.asarray(force), jnp.asarray(load), jnp.ones(2), unit)
    settings = (vector, restore, fit.modes, fit.spread, fit.data)
    values, slopes, good = _point_with_slopes(*settings, *given, np.array(kind == "fold"))
    return (np.asarray(values), np.asarray(slopes)[:, own]) if bool(good) else None


@compiled
def _point_with_slopes(
    vector: Array,
    restore: Restore,
    modes: LinearModes,
    spread: Spread,
    data: BalanceData,
    force: Array,
    load: Array,
    start: Array,
    unit: Array,
    is_fold: Array,
) -> tuple[Array, Array, Array]:
    def equations(point: Array, vector: Array) -> Array:
        x, omega = point * unit
        unknowns = restore(vector)
        excess, slope = jax.jvp(
            lambda x: _excess(unknowns, load, x, omega), (x,), (jnp.ones_like(x),)
        )
        squared, damping = _curves_at(unknowns, x, omega)
        resonance = [squared / omega**2 - 1, omega * damping * x / load - 1]
        return jnp.where(is_fold, jnp.stack([excess, slope * x]), jnp.stack(resonance))

    def step(_: int, point: Array) -> Array:
        jacobian = jax.jacfwd(equations)(point, vector)
        return point - jnp.linalg.solve(jacobian, equations(point, vector))

    point = jax.lax.fori_loop(0, _ITERATIONS, step, start)
    left = jnp.max(jnp.abs(equations(point, vector)))
    good = (left < 1e-9) & jnp.all(jnp.abs(point - 1.0) < 0.2)
    by_vector = jax.jacfwd(equations, argnums=1)(point, vector)
    along = -jnp.linalg.solve(jax.jacfwd(equations)(point, vector), by_vector)

    def outputs(point: Array, vector: Array) -> Array:
        x, omega = point * unit
        velocity = _velocity_at(restore(vector), modes, spread, data, force, x, omega)
        return jnp.stack([omega, jnp.abs(velocity), x])

    by_point, direct = jax.jacfwd(outputs, argnums=(0, 1))(point, vector)
    return outputs(point, vector), by_point @ along + direct, good
