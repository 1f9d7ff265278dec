"""Points of the backbone and of the damping from measured steady states, with errors."""

import dataclasses
from typing import Any, ClassVar, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float, Int

from snrmjax.identify.curves.family_base import Argument
from snrmjax.identify.pointwise.inversion import PointStatus, SnrmPoints, closed_form, invert_phasor
from snrmjax.identify.pointwise.snrm import (
    SensedMode,
    is_single,
    participation_of,
    reference_sensor,
    sensed_mode,
)
from snrmjax.measure.signals import appropriation_of, peak_amplitude
from snrmjax.measure.states import SteadyStates, check_force, check_phases, relative_errors
from snrmjax.model.modes import LinearModes, residual_velocity
from snrmjax.numerics.blocks import padded
from snrmjax.numerics.compiled import as_numpy, compiled
from snrmjax.numerics.result import AbstractResult, Variable, quantity, setting
from snrmjax.numerics.rules import InputError


class BackbonePoints(AbstractResult):
    """One natural frequency and damping ratio from every steady state.

    Amplitudes are those of the nonlinear mode at one sensor, `sensor`. Standard deviations (1σ)
    are NaN where no noise is stated. `alternative_…` is the second root that
    amplitude and phase alone would allow; NaN where there is none.
    """

    coordinates: ClassVar[tuple[str, ...]] = ("state", "level")

    level: Int[Array, " state"] = quantity("state", "1", "level of the test")
    frequency: Float[Array, " state"] = quantity("state", "Hz", "forcing frequency")  # rad/s
    force: Float[Array, " state"] = quantity("state", "N", "force amplitude")
    velocity: Complex[Array, " state"]  # m/s as measured, residual modes included
    appropriation: Float[Array, " state"] = quantity(
        "state", "1", "appropriation indicator, Eq. (20)", name="nnmai"
    )
    mode_velocity: Complex[Array, " state"]  # m/s, of the nonlinear mode alone
    natural_frequency: Float[Array, " state"] = quantity("state", "Hz", "natural frequency")
    natural_frequency_std: Float[Array, " state"] = quantity("state", "Hz", "its 1σ")
    damping_ratio: Float[Array, " state"] = quantity("state", "1", "damping ratio")
    damping_ratio_std: Float[Array, " state"] = quantity("state", "1", "its 1σ")
    amplitude: Float[Array, " state"]  # m or m/s, the argument of the backbone
    backbone_velocity: Float[Array, " state"] = quantity(
        "state", "m/s", "velocity amplitude where the point lies on the backbone"
    )
    alternative_natural_frequency: Float[Array, " state"]  # rad/s
    alternative_damping_ratio: Float[Array, " state"]
    sensitivity: Float[Array, "state output input"]  # of ω̃², 2ζ̃ω̃, log amplitude
    relative_std: Float[Array, "state input"]  # 1σ of log force, log velocity and phase
    filter_residual: Float[Array, " state"]  # relative residual of the projection on the mode shape
    status: Int[Array, " state"] = quantity("state", "", "outcome", of=PointStatus)
    sensor: str = setting()
    argument: Argument = eqx.field(static=True)

    def variables(self) -> dict[str, Variable]:
        """Those of the fields, with the measured velocity's magnitude and phase."""
        velocity = np.asarray(self.velocity)
        phase = np.degrees(np.angle(velocity))
        return {
            "state": Variable(("state",), np.arange(len(velocity)), "1", "steady state"),
            **super().variables(),
            "velocity_m_s": Variable(("state",), np.abs(velocity), "m/s", "velocity amplitude"),
            "phase_deg": Variable(("state",), phase, "deg", "velocity phase to the force"),
        }

    def attributes(self) -> dict[str, str | float | int]:
        """The sensor, and the kind of amplitude that frequency and damping depend on."""
        return {**super().attributes(), "amplitude": self.argument}

    @property
    def modal_damping(self) -> Float[Array, " state"]:
        """2ζ̃ω̃ in 1/s."""
        return 2 * as_numpy(self.damping_ratio) * as_numpy(self.natural_frequency)

    @property
    def usable(self) -> Array:
        """Points used for curves: solved and unambiguous."""
        return as_numpy(self.status) == int(PointStatus.OK)


AmplitudeMeasure = Literal["fundamental", "peak"]

NOISE_GROWTH = 4.0
"""Error of a point 90° off resonance over that of one at resonance, where no noise is stated."""


def identify_points(
    data: SteadyStates,
    modes: LinearModes,
    *,
    amplitude: Argument = "displacement",
    measure: AmplitudeMeasure = "fundamental",
) -> BackbonePoints:
    """Invert the SNRM function for every steady state: one point of the backbone from each.

    The velocities of the residual linear modes and of the rigid-body modes are subtracted; with
    several sensors the remainder is projected on the mode shape by weighted least squares; the
    two equations are solved for ω̃ and ζ̃.

    Arguments: `amplitude` is the argument of ω̃ and ζ̃: "displacement" suits a nonlinear stiffness
    and puts the point on the backbone at the velocity vω̃/Ω; "velocity" is the paper's choice.
    `measure` is the amplitude used in Eq. (12): that of the fundamental, or the peak of the time
    signal with all measured harmonics.
    Returns `BackbonePoints`; every state has a status, and NaN where there is no solution.
    Raises `ValueError` when the peak is asked for without harmonics, when the force or a phase is
    unknown, or when the sensors are not those of the modes.
    Differentiable with respect to velocities, forces, frequencies, stated errors and the modes, in
    forward and reverse mode; a state without a solution has derivatives zero or NaN and does not
    affect the others. So is the second root where there is one.
    Reference: Kwarta & Allen, section 2.2; the displacement argument is this package's own.
    """
    if data.sensors != modes.sensors:
        raise InputError(
            f"`data` has the sensors {list(data.sensors)}, but `modes` has {list(modes.sensors)}."
        )
    if amplitude not in ("displacement", "velocity"):
        raise InputError(f'`amplitude` must be "displacement" or "velocity", not {amplitude!r}.')
    if measure not in ("fundamental", "peak"):
        raise InputError(f'`measure` must be "fundamental" or "peak", not {measure!r}.')
    if data.n_states == 0:
        raise InputError("`data` has no steady states.")
    check_phases(data, "an identification")
    check_force(data, "an identification point by point")
    if measure == "peak" and not set(data.harmonic_order) - {1}:
        raise InputError(
            '`measure="peak"` needs harmonics, but the steady states have the fundamental only.'
        )
    bare, settings = (
        dataclasses.replace(data, notes=()),
        (reference_sensor(modes), amplitude, measure),
    )
    if any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves((data, modes))):
        return _identify(bare, modes, *settings)
    # With copies of the last state up to a power of two: few numbers of states compile.
    n = data.n_states
    points = _identify(bare.select(padded(np.arange(n))), modes, *settings)
    return jax.tree.map(lambda column: jnp.asarray(np.asarray(column)[:n]), points)


@compiled
def _identify(
    data: SteadyStates, modes: LinearModes, r: int, amplitude: Argument, measure: AmplitudeMeasure
) -> BackbonePoints:
    # States without a force or a frequency are solved with placeholder values and masked
    # afterwards: in a derivative `where` does not stop a NaN.
    forced = jnp.isfinite(data.force) & (data.force > 0)
    timed = jnp.isfinite(data.frequency) & (data.frequency > 0)
    sound = forced & timed
    raw, data = (
        data,
        dataclasses.replace(
            data,
            force=jnp.where(sound, data.force, 1.0),
            frequency=jnp.where(sound, data.frequency, 1.0),
        ),
    )
    velocity, relative_std = data.velocity, relative_errors(raw)
    if measure == "peak":
        velocity = velocity * peak_ratio(data)
    combined, fraction, filtered_std, filter_residual = modal_filter(
        data, modes, r, velocity, relative_std
    )
    moving = jnp.isfinite(combined) & (combined != 0)
    usable = sound & moving
    phasor = jnp.where(moving, combined, 1.0)
    inputs = jnp.stack([jnp.log(data.force), jnp.log(jnp.abs(phasor)), jnp.angle(phasor)], axis=1)
    sensed = sensed_mode(modes, data.frequency)
    solved, mode_velocity, argument, sensitivity, linear_variance = _solve(
        modes, r, amplitude, data.frequency, inputs, fraction, usable, sensed
    )
    natural, damping = solved.natural_frequency, solved.damping_ratio
    solved_well = jnp.isfinite(natural)
    natural_std, damping_std = _ratios_std(
        natural, damping, sensitivity, filtered_std, linear_variance
    )
    if modes.own_modal_mass_std is not None:
        moved = moved_by_modal_mass(natural, damping, data.frequency)
        natural_std, damping_std = (
            _hypotenuse(std, by_mass * modes.own_modal_mass_std)
            for std, by_mass in zip((natural_std, damping_std), moved, strict=True)
        )
    on_backbone = jnp.abs(mode_velocity)
    if amplitude == "displacement":
        on_backbone = on_backbone * jnp.where(solved_well, natural, 1.0) / data.frequency
    of_mode = mode_velocity if is_single(modes) else mode_velocity / sensed.to_mode(r)
    measured = of_mode + residual_velocity(modes, data.frequency, data.force)[:, r]
    # Nothing is subtracted where nothing drives the other modes, or nothing moves.
    bare = jnp.where(sound | (raw.force == 0), combined, jnp.nan)
    status = jnp.where(
        (raw.force == 0) & moving & timed, int(PointStatus.ZERO_FORCE), int(PointStatus.NOT_FINITE)
    )
    return BackbonePoints(
        level=data.level,
        frequency=raw.frequency,
        force=raw.force,
        velocity=jnp.where(usable, measured, bare),
        appropriation=appropriation_of(raw),
        mode_velocity=jnp.where(usable, mode_velocity, bare),
        natural_frequency=natural,
        natural_frequency_std=natural_std,
        damping_ratio=damping,
        damping_ratio_std=damping_std,
        amplitude=jnp.where(solved_well, argument, jnp.nan),
        backbone_velocity=jnp.where(solved_well, on_backbone, jnp.nan),
        alternative_natural_frequency=solved.alternative_natural_frequency,
        alternative_damping_ratio=solved.alternative_damping_ratio,
        sensitivity=sensitivity,
        relative_std=filtered_std,
        filter_residual=jnp.where(sound, filter_residual, jnp.nan),
        status=jnp.where(usable, solved.status, status),
        sensor=modes.sensors[r],
        argument=amplitude,
    )


def _hypotenuse(std: Array, other: Array) -> Array:
    """√(std² + other²), NaN where `std` is, with finite derivatives there."""
    known = jnp.isfinite(std)
    both = jnp.where(known, std, 1.0) ** 2 + jnp.where(known, other, 0.0) ** 2
    return jnp.where(known, _root(both), jnp.nan)


def moved_by_modal_mass(
    natural: Float[Array, " state"] | Float[np.ndarray, " state"],
    damping: Float[Array, " state"] | Float[np.ndarray, " state"],
    frequency: Float[Array, " state"] | Float[np.ndarray, " state"],
) -> tuple[Any, Any]:
    """Derivatives of ω̃ and ζ̃ with respect to the logarithm of the model's modal mass.

    ω̃² − Ω² and 2ζ̃ω̃ are proportional to the force over the modal mass: at resonance a relative
    error of it appears in the damping alone, equally large.
    """
    by_squares = -(natural**2 - frequency**2) / (2 * natural)
    return by_squares, -damping * (1 + by_squares / natural)


def _ratios_std(
    natural: Array,
    damping: Array,
    sensitivity: Float[Array, "state output input"],
    relative_std: Float[Array, "state input"],
    linear_variance: Float[Array, "state output"],
) -> tuple[Array, Array]:
    """1σ of ω̃ and ζ̃, propagated from the errors of the inputs and of the linear modes."""
    known = jnp.isfinite(natural) & jnp.all(jnp.isfinite(relative_std), axis=1)

    def safe(value: Array, stand_in: float) -> Array:
        return jnp.where(known.reshape(-1, *(1,) * (value.ndim - 1)), value, stand_in)

    natural, damping = safe(natural, 1.0), safe(damping, 0.0)
    slopes, variance = safe(sensitivity, 0.0), safe(relative_std, 0.0) ** 2
    covariance = jnp.einsum("soi,si,spi->sop", slopes, variance, slopes)
    covariance = covariance + jax.vmap(jnp.diag)(safe(linear_variance, 0.0))
    natural_std = _root(covariance[:, 0, 0]) / (2 * natural)
    # ζ̃ = δ/(2ω̃): dζ̃ = dδ/(2ω̃) − ζ̃ dω̃²/(2ω̃²).
    slope = jnp.stack([-damping / (2 * natural**2), 1 / (2 * natural)], axis=1)
    of_damping = jnp.einsum("so,sop,sp->s", slope, covariance[:, :2, :2], slope)
    return (jnp.where(known, natural_std, jnp.nan), jnp.where(known, _root(of_damping), jnp.nan))


def peak_ratio(data: SteadyStates) -> Float[Array, "state sensor"]:
    """Peak of the velocity's time signal over the amplitude of its fundamental."""
    orders = tuple(h for h in data.harmonic_order if h != 1)
    keep = [data.harmonic_order.index(h) for h in orders]
    harmonics = jnp.where(jnp.isfinite(data.harmonics.real), data.harmonics, 0.0)[..., keep]
    moving = jnp.isfinite(data.velocity) & (data.velocity != 0)
    velocity = jnp.where(moving, data.velocity, 1.0)
    spectrum = jnp.concatenate([velocity[..., None], harmonics], axis=-1)
    flat = spectrum.reshape(-1, len(orders) + 1)
    peak = jax.vmap(lambda row: peak_amplitude(row, (1, *orders)))(flat)
    return jnp.where(moving, peak.reshape(velocity.shape) / jnp.abs(velocity), jnp.nan)


@compiled
def modal_filter(
    data: SteadyStates,
    modes: LinearModes,
    r: int,
    velocity: Complex[Array, "state sensor"],
    relative_std: Float[Array, "state sensor input"],
) -> tuple[Array, Array, Array, Array]:
    """The combination of the sensors' velocities that best observes the mode of interest.

    Least squares of Φ_s η = V_s − V_res,s over the sensors, weighted with their stated errors
    when all have them, is Φ_r η = Σ_s w_s (V_s − V_res,s). Where damping couples modes, Φ_s is the
    mode's effective shape; for a force with phases the sum is relative to the phase of the mode's
    own force (`SensedMode`). Returns Σ w_s V_s, the weights w_s, the relative errors of the sum and
    the relative residual of the least squares.
    """
    sensed, shape = sensed_mode(modes, data.frequency), modes.mode_shape[:, modes.mode_of_interest]
    own = shape[r]
    if not is_single(modes):
        shape = shape * sensed.seen
    measured = data.measured & jnp.isfinite(velocity)
    velocity = jnp.where(measured, velocity, 0.0)
    residual = residual_velocity(modes, data.frequency, data.force)
    of_mode = jnp.where(measured, velocity - residual, 0.0)
    errors = relative_std[..., 1:]
    stated = jnp.isfinite(errors)
    absolute = jnp.where(stated, errors, 0.0) * jnp.abs(velocity)[..., None]
    # 1σ of every measured amplitude, used as weights where all are stated.
    along = jnp.where(measured, absolute[..., 0], 1.0)
    known = jnp.all(stated[..., 0] & (along > 0) | ~measured, axis=1, keepdims=True)
    weight = jnp.where(measured, 1 / jnp.where(known, along, 1.0) ** 2, 0.0)
    norm = jnp.sum(weight * (shape.real**2 + shape.imag**2), axis=1, keepdims=True)
    seen = norm > 0
    fraction = jnp.where(seen, weight * shape.conj() * own / jnp.where(seen, norm, 1.0), 0.0)
    modal = jnp.sum(fraction * of_mode, axis=1, keepdims=True) / own
    misfit = jnp.where(measured, of_mode - shape * modal, 0.0)

    def weighted_norm(parts: Complex[Array, "state sensor"]) -> Float[Array, " state"]:
        return _root(jnp.sum(weight * (parts.real**2 + parts.imag**2), axis=1))

    relative_misfit = _ratio(weighted_norm(misfit), weighted_norm(of_mode))
    if not is_single(modes):
        fraction = fraction * sensed.phase_factor[:, None]
    combined = jnp.sum(fraction * velocity, axis=1)
    magnitude = jnp.abs(combined)

    # Sensor errors are independent; amplitude errors lie along V, phase errors across it.
    def error(component: int) -> Array:
        each = jnp.where(measured, fraction * absolute[..., component], 0.0)
        known_all = jnp.all(stated[..., component] | ~measured, axis=1)
        square = jnp.sum(each.real**2 + each.imag**2, axis=1)
        return jnp.where(known_all, _ratio(_root(square), magnitude), jnp.nan)

    std = jnp.stack([relative_std[:, 0, 0], error(0), error(1)], axis=1)
    return jnp.where(seen[:, 0], combined, jnp.nan), fraction, std, relative_misfit


def _ratio(part: Float[Array, " state"], whole: Float[Array, " state"]) -> Float[Array, " state"]:
    """part/whole, NaN where the whole is zero."""
    nonzero = whole > 0
    return jnp.where(nonzero, part / jnp.where(nonzero, whole, 1.0), jnp.nan)


def _solve(
    modes: LinearModes,
    r: int,
    amplitude: Argument,
    frequency: Array,
    inputs: Float[Array, "state input"],
    fraction: Float[Array, "state sensor"],
    sound: Bool[Array, " state"],
    sensed: SensedMode,
) -> tuple[SnrmPoints, Array, Array, Array, Array]:
    """Points, modal velocity, amplitude, derivatives, variance due to the linear modes."""
    j = modes.mode_of_interest
    keep = np.asarray(modes.residual_modes, dtype=int)
    half = keep.size
    parameters = jnp.concatenate([modes.natural_frequency[keep], modes.damping_ratio[keep]])

    def with_parameters(parameters: Array) -> LinearModes:
        changed = (
            modes.natural_frequency.at[keep].set(parameters[:half]),
            modes.damping_ratio.at[keep].set(parameters[half:]),
        )
        return eqx.tree_at(lambda m: (m.natural_frequency, m.damping_ratio), modes, changed)

    ratio = jnp.broadcast_to(sensed.ratio, frequency.shape)

    def measured(
        inputs: Array, parameters: Array, frequency: Array, fraction: Array, ratio: Array
    ) -> tuple:
        """Modal constant at the reference sensor, velocity and residual of the sensors' sum."""
        force = jnp.exp(inputs[..., 0])
        velocity = jnp.exp(inputs[..., 1]) * jnp.exp(1j * inputs[..., 2])
        everywhere = residual_velocity(with_parameters(parameters), frequency, force)
        residual = jnp.sum(fraction * everywhere, axis=-1)
        constant = modes.mode_shape[r, j] * participation_of(modes) * ratio * force
        return constant, velocity, residual

    def argument_of(own: Array, frequency: Array) -> Array:
        return jnp.abs(own) / frequency if amplitude == "displacement" else jnp.abs(own)

    def outputs(
        inputs: Array,
        parameters: Array,
        frequency: Array,
        fraction: Array,
        ratio: Array,
        solved: Array,
    ) -> Array:
        constant, velocity, residual = measured(inputs, parameters, frequency, fraction, ratio)
        # Non-finite values would spread over the whole batch: unsolved states get placeholders.
        constant, frequency, velocity, residual = (
            jnp.where(solved, value, stand_in)
            for value, stand_in in zip(
                (constant, frequency, velocity, residual), (1.0, 1.0, 1.0, 0.0), strict=True
            )
        )
        # `invert_phasor` has the roots of the closed form, hence also its derivatives.
        own = velocity - residual
        natural, damping = closed_form(constant, frequency, own)
        argument = argument_of(own, frequency)
        return jnp.stack([natural**2, 2 * damping * natural, jnp.log(argument)])

    constant, velocity, residual = measured(inputs, parameters, frequency, fraction, ratio)
    points = invert_phasor(constant, frequency, velocity, residual)
    points = jax.tree.map(
        lambda value: jnp.where(sound, value, jnp.nan) if value.dtype.kind == "f" else value, points
    )
    solved = jnp.isfinite(points.natural_frequency)
    slopes = jax.vmap(jax.jacfwd(outputs, argnums=(0, 1)), in_axes=(0, None, 0, 0, 0, 0))
    by_input, by_parameter = slopes(inputs, parameters, frequency, fraction, ratio, solved)
    spread = jnp.concatenate([modes.natural_frequency_std[keep], modes.damping_ratio_std[keep]])
    variance = jnp.sum((by_parameter * spread) ** 2, axis=-1)
    by_input = jnp.where(solved[:, None, None], by_input, jnp.nan)
    variance = jnp.where(solved[:, None], variance, jnp.nan)
    own = velocity - residual
    return points, own, argument_of(own, frequency), by_input, variance


def off_resonance_error_factor(
    mode_velocity: Complex[np.ndarray, " state"],
) -> Float[np.ndarray, " state"]:
    """Error of each point relative to that of a point at resonance, where no noise is stated.

    √(1 + (4 sin φ)²), φ the phase of the mode's velocity: off resonance a point is extrapolated to
    the backbone, which adds errors.
    """
    return np.sqrt(1.0 + (NOISE_GROWTH * np.sin(np.angle(mode_velocity))) ** 2)


def _root(square: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
    """Square root with derivative zero at zero: 0 · ∞ would make other derivatives NaN."""
    nonzero = square != 0
    return jnp.where(nonzero, jnp.sqrt(jnp.where(nonzero, square, 1.0)), 0.0)
