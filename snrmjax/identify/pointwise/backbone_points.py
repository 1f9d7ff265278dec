"""From measured steady states to points of the backbone and of the damping, with errors."""

from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float, Int

from snrmjax.identify.pointwise.inversion import PointStatus, SnrmPoints, invert_one, invert_phasor
from snrmjax.identify.pointwise.snrm import reference_sensor
from snrmjax.measure.indicators import appropriation_of
from snrmjax.measure.signals import peak_amplitude
from snrmjax.measure.states import SteadyStates, check_force, check_phases, relative_errors
from snrmjax.model.modes import LinearModes, residual_velocity

AmplitudeArgument = Literal["displacement", "velocity"]
AmplitudeMeasure = Literal["fundamental", "peak"]

INPUTS = ("log_force", "log_velocity", "phase")
"""The measured quantities whose errors are carried to the points."""

OFF_RESONANCE = 4.0
"""Error of a point 90° off resonance over that of one at resonance, where no noise is stated."""

OUTPUTS = ("squared_frequency", "modal_damping", "log_amplitude")
"""The quantities whose derivatives `BackbonePoints.sensitivity` holds."""


class BackbonePoints(eqx.Module):
    """One natural frequency and damping ratio from every steady state.

    Amplitudes are those of the nonlinear mode at one sensor, `sensor`. `sensitivity` holds the
    derivatives of `OUTPUTS` (ω̃², 2ζ̃ω̃ and the logarithm of the amplitude) with respect to
    `INPUTS`; `relative_std` the 1σ of those inputs, NaN where nobody stated it.
    """

    level: Int[Array, " state"]
    frequency: Float[Array, " state"]  # rad/s, of the force
    force: Float[Array, " state"]  # N
    velocity: Complex[Array, " state"]  # m/s, of the sensor, residual modes included
    mode_velocity: Complex[Array, " state"]  # m/s, of the nonlinear mode alone
    appropriation: Float[Array, " state"]  # Eq. (20)
    natural_frequency: Float[Array, " state"]  # rad/s
    damping_ratio: Float[Array, " state"]
    amplitude: Float[Array, " state"]  # m or m/s, the argument of the backbone
    backbone_velocity: Float[Array, " state"]  # m/s, where the point lies on the backbone
    natural_frequency_std: Float[Array, " state"]  # rad/s, NaN where no noise is stated
    damping_ratio_std: Float[Array, " state"]
    alternative_natural_frequency: Float[Array, " state"]  # rad/s, the other root or NaN
    alternative_damping_ratio: Float[Array, " state"]
    sensitivity: Float[Array, "state output input"]
    relative_std: Float[Array, "state input"]
    linear_variance: Float[Array, "state output"]  # from the other linear modes' stated errors
    filter_residual: Float[Array, " state"]  # part of the mode's motion that its shape misses
    status: Int[Array, " state"]  # `PointStatus`
    sensor: str = eqx.field(static=True)
    argument: AmplitudeArgument = eqx.field(static=True)

    @property
    def modal_damping(self) -> Float[Array, " state"]:
        """2ζ̃ω̃ in 1/s."""
        return 2 * self.damping_ratio * self.natural_frequency

    @property
    def usable(self) -> Array:
        """Points that enter curves: solved, and solved without doubt."""
        return self.status == int(PointStatus.OK)


def identify_points(
    data: SteadyStates,
    modes: LinearModes,
    *,
    amplitude: AmplitudeArgument = "displacement",
    measure: AmplitudeMeasure = "fundamental",
) -> BackbonePoints:
    """Invert the SNRM function for every steady state.

    The velocities of the residual linear modes and of the rigid-body modes are subtracted; with
    several sensors the remainder is projected on the mode shape by weighted least squares; the
    two equations are solved for ω̃ and ζ̃.

    Arguments: `amplitude` says at which amplitude ω̃ and ζ̃ belong: "displacement" is right for
    a nonlinear stiffness and places the point on the backbone at the velocity vω̃/Ω; "velocity"
    is the paper's choice. `measure` is the amplitude put into Eq. (12): of the fundamental, or
    the peak of the time signal with all measured harmonics.
    Returns `BackbonePoints`; every state has a status and NaN where there is no answer.
    Raises `ValueError` when the peak is asked for without harmonics, when the force or a phase is
    unknown, or when the sensors are not those of the modes.
    Reference: Kwarta & Allen, section 2.2; the displacement argument is this package's own.
    """
    if data.sensors != modes.sensors:
        raise ValueError(
            f"`data` has the sensors {list(data.sensors)}, but `modes` has {list(modes.sensors)}."
        )
    if amplitude not in ("displacement", "velocity"):
        raise ValueError(f'`amplitude` must be "displacement" or "velocity", not {amplitude!r}.')
    if measure not in ("fundamental", "peak"):
        raise ValueError(f'`measure` must be "fundamental" or "peak", not {measure!r}.')
    if data.n_states == 0:
        raise ValueError("`data` has no steady states.")
    check_phases(data, "an identification")
    check_force(data, "an identification point by point")
    if measure == "peak" and not set(data.harmonic_order) - {1}:
        raise ValueError(
            '`measure="peak"` needs harmonics, but the steady states have the fundamental only.'
        )
    return _identify(data, modes, reference_sensor(modes), amplitude, measure)


@eqx.filter_jit
def _identify(
    data: SteadyStates,
    modes: LinearModes,
    r: int,
    amplitude: AmplitudeArgument,
    measure: AmplitudeMeasure,
) -> BackbonePoints:
    velocity, relative_std = data.velocity, relative_errors(data)
    if measure == "peak":
        velocity = velocity * _peak_ratio(data)
    combined, share, filtered_std, filter_residual = modal_filter(
        data, modes, r, velocity, relative_std
    )
    inputs = jnp.stack(
        [jnp.log(data.force), jnp.log(jnp.abs(combined)), jnp.angle(combined)], axis=1
    )
    solved, mode_velocity, argument, sensitivity, linear_variance = _solve(
        modes, r, amplitude, data.frequency, inputs, share
    )
    natural, damping = solved.natural_frequency, solved.damping_ratio
    covariance = jnp.einsum("soi,si,spi->sop", sensitivity, filtered_std**2, sensitivity)
    covariance = covariance + jax.vmap(jnp.diag)(linear_variance)
    natural_std, damping_std = _ratios_std(natural, damping, covariance)
    on_backbone = jnp.abs(mode_velocity)
    if amplitude == "displacement":
        on_backbone = on_backbone * natural / data.frequency
    return BackbonePoints(
        level=data.level,
        frequency=data.frequency,
        force=data.force,
        velocity=mode_velocity + residual_velocity(modes, data.frequency, data.force)[:, r],
        mode_velocity=mode_velocity,
        appropriation=appropriation_of(data),
        natural_frequency=natural,
        damping_ratio=damping,
        amplitude=jnp.where(jnp.isfinite(natural), argument, jnp.nan),
        backbone_velocity=on_backbone,
        natural_frequency_std=natural_std,
        damping_ratio_std=damping_std,
        alternative_natural_frequency=solved.alternative_natural_frequency,
        alternative_damping_ratio=solved.alternative_damping_ratio,
        sensitivity=sensitivity,
        relative_std=filtered_std,
        linear_variance=linear_variance,
        filter_residual=filter_residual,
        status=solved.status,
        sensor=modes.sensors[r],
        argument=amplitude,
    )


def _ratios_std(
    natural: Array, damping: Array, covariance: Float[Array, "state output output"]
) -> tuple[Array, Array]:
    """1σ of ω̃ and ζ̃ from the covariance of ω̃² and 2ζ̃ω̃."""
    natural_std = jnp.sqrt(covariance[:, 0, 0]) / (2 * natural)
    # ζ̃ = δ/(2ω̃): dζ̃ = dδ/(2ω̃) − ζ̃ dω̃²/(2ω̃²).
    slope = jnp.stack([-damping / (2 * natural**2), 1 / (2 * natural)], axis=1)
    variance = jnp.einsum("so,sop,sp->s", slope, covariance[:, :2, :2], slope)
    return natural_std, jnp.sqrt(variance)


def _peak_ratio(data: SteadyStates) -> Float[Array, "state sensor"]:
    """Peak of the velocity's time signal over the amplitude of its fundamental."""
    orders = tuple(h for h in data.harmonic_order if h != 1)
    keep = [data.harmonic_order.index(h) for h in orders]
    harmonics = jnp.where(jnp.isfinite(data.harmonics.real), data.harmonics, 0.0)[..., keep]
    spectrum = jnp.concatenate([data.velocity[..., None], harmonics], axis=-1)
    flat = spectrum.reshape(-1, len(orders) + 1)
    peak = jax.vmap(lambda row: peak_amplitude(row, (1, *orders)))(flat)
    return peak.reshape(data.velocity.shape) / jnp.abs(data.velocity)


@eqx.filter_jit
def modal_filter(
    data: SteadyStates,
    modes: LinearModes,
    r: int,
    velocity: Complex[Array, "state sensor"],
    relative_std: Float[Array, "state sensor input"],
) -> tuple[Array, Array, Array, Array]:
    """The combination of the sensors' velocities that sees the mode of interest best.

    Least squares of Φ_s η = V_s − V_res,s over the sensors, weighted with their stated errors
    when all have them, is Φ_r η = Σ_s share_s (V_s − V_res,s). Returns Σ share_s V_s, the shares,
    the relative errors of the sum and the relative residual of the least squares.
    """
    shape = modes.mode_shape[:, modes.mode_of_interest]
    measured = data.measured & jnp.isfinite(jnp.abs(velocity))
    residual = residual_velocity(modes, data.frequency, data.force)
    own = jnp.where(measured, velocity - residual, 0.0)
    absolute = relative_std[..., 1] * jnp.abs(velocity)
    known = jnp.all(jnp.where(measured, absolute > 0, True), axis=1, keepdims=True)
    weight = jnp.where(measured, jnp.where(known, 1 / absolute**2, 1.0), 0.0)
    norm = jnp.sum(weight * shape**2, axis=1, keepdims=True)
    share = weight * shape * shape[r] / jnp.where(norm > 0, norm, jnp.nan)
    modal = jnp.sum(share * own, axis=1, keepdims=True) / shape[r]
    misfit = jnp.where(measured, own - shape * modal, 0.0)
    size = jnp.sqrt(jnp.sum(weight * jnp.abs(own) ** 2, axis=1))
    relative_misfit = jnp.sqrt(jnp.sum(weight * jnp.abs(misfit) ** 2, axis=1)) / size
    combined = jnp.sum(share * jnp.where(measured, velocity, 0.0), axis=1)

    # Errors of the sensors are independent; amplitude and phase errors lie along and across V.
    def error(component: int) -> Array:
        each = jnp.where(measured, share * relative_std[..., component] * jnp.abs(velocity), 0.0)
        return jnp.sqrt(jnp.sum(each**2, axis=1)) / jnp.abs(combined)

    std = jnp.stack([relative_std[:, 0, 0], error(1), error(2)], axis=1)
    return combined, share, std, relative_misfit


def _solve(
    modes: LinearModes,
    r: int,
    amplitude: AmplitudeArgument,
    frequency: Array,
    inputs: Float[Array, "state input"],
    share: Float[Array, "state sensor"],
) -> tuple[SnrmPoints, Array, Array, Array, Array]:
    """Points, mode's velocity, amplitude, derivatives, the linear modes' share of the variance."""
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

    def measured(inputs: Array, parameters: Array, frequency: Array, share: Array) -> tuple:
        """Modal constant at the reference sensor, velocity and residual of the sensors' sum."""
        force = jnp.exp(inputs[..., 0])
        velocity = jnp.exp(inputs[..., 1]) * jnp.exp(1j * inputs[..., 2])
        everywhere = residual_velocity(with_parameters(parameters), frequency, force)
        residual = jnp.sum(share * everywhere, axis=-1)
        return modes.mode_shape[r, j] * modes.participation[j] * force, velocity, residual

    def argument_of(own: Array, frequency: Array) -> Array:
        return jnp.abs(own) / frequency if amplitude == "displacement" else jnp.abs(own)

    def outputs(
        inputs: Array, parameters: Array, frequency: Array, share: Array, solved: Array
    ) -> Array:
        constant, velocity, residual = measured(inputs, parameters, frequency, share)
        # A singular system would stop the whole batch: unsolved states get a harmless one.
        constant, frequency, velocity, residual = (
            jnp.where(solved, value, stand_in)
            for value, stand_in in zip(
                (constant, frequency, velocity, residual), (1.0, 1.0, 1.0, 0.0), strict=True
            )
        )
        natural, damping = invert_one(constant, frequency, velocity, residual)
        argument = argument_of(velocity - residual, frequency)
        return jnp.stack([natural**2, 2 * damping * natural, jnp.log(argument)])

    constant, velocity, residual = measured(inputs, parameters, frequency, share)
    points = invert_phasor(constant, frequency, velocity, residual)
    solved = jnp.isfinite(points.natural_frequency)
    slopes = jax.vmap(jax.jacfwd(outputs, argnums=(0, 1)), in_axes=(0, None, 0, 0, 0))
    by_input, by_parameter = slopes(inputs, parameters, frequency, share, solved)
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

    √(1 + (4 sin φ)²), φ the phase of the mode's velocity: at resonance a point needs no correction
    for the distance from resonance, and away from it the correction brings its own errors.
    """
    return np.sqrt(1.0 + (OFF_RESONANCE * np.sin(np.angle(mode_velocity))) ** 2)
