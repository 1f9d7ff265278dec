"""The complex force balance of all measured states: the residual that a joint fit minimises.

With V the velocity of the nonlinear mode and X = V/(iΩ), a state balances when
((ω̃² − Ω²) + iΩ·2ζ̃ω̃) X/A = F. Evaluated at the measured motion the residual is single-valued,
however the response folds.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float, Int, Shaped

from snrmjax.identify.curves.family_base import AbstractFamily, PackedCurve
from snrmjax.identify.pointwise.backbone_points import modal_filter, off_resonance_error_factor
from snrmjax.identify.pointwise.snrm import participation_of, reference_sensor, sensed_mode
from snrmjax.identify.test_model.priors import FORCE_TO_VELOCITY, OFF_RESONANCE
from snrmjax.identify.test_model.states import LEVEL_ERRORS
from snrmjax.measure.states import SteadyStates, check_phases, relative_errors
from snrmjax.model.modes import UNSTATED_MODAL_MASS_STD, LinearModes, residual_velocity
from snrmjax.model.structures import Structure
from snrmjax.numerics.compiled import as_numpy, compiled
from snrmjax.numerics.rules import InputError

STATE_ERRORS = ("force", "velocity", "phase", "stiffness")
"""Random errors of every state, relative or in rad; that of the stiffness is never stated."""

EXPONENTS = slice(-3, -1)
"""The frequency exponents among `Unknowns.linear`."""

_FEWEST_STATES = 48  # smallest padded number of states


class BalanceData(eqx.Module):
    """Measured states reduced to one velocity each."""

    level: Int[Array, " state"]  # counted from zero
    frequency: Float[Array, " state"]  # rad/s
    force: Float[Array, " state"]  # N, or V where only the drive is known
    velocity: Complex[Array, " state"]  # m/s at `sensor`, estimated from all sensors
    fraction: Shaped[Array, "state sensor"]  # weights of the sensors in it, by `modal_filter`
    participation: Float[Array, " state"]  # over that of the single mode: `SensedMode.ratio`
    std: Float[Array, "state input"]  # of `STATE_ERRORS`
    weight: Float[Array, " state"]  # 1, or less for an outlier under the robust loss
    correction: Float[Array, "state input"]  # of `STATE_ERRORS`: added to every record by the fit
    detuning: Float[Array, " state"]  # ln(Ω/ω̃) from the record
    n_levels: int = eqx.field(static=True)
    sensor: int = eqx.field(static=True)  # reference sensor


class Unknowns(eqx.Module):
    """All unknowns of a joint fit.

    Deviations of levels and linear parameters are in units of their own 1σ.
    """

    squared_frequency: AbstractFamily  # ω̃², rad²/s²
    modal_damping: AbstractFamily  # 2ζ̃ω̃, 1/s
    log_force_gain: Float[Array, ""]
    force_offset: Float[Array, ""]  # relative to the smallest force
    instrument_phase: Float[Array, ""]  # rad
    level: Float[Array, "level error"]
    linear: Float[Array, " deviation"]  # as `PriorStd.linear`


class PriorStd(eqx.Module):
    """Prior standard deviations (1σ) of the unknowns."""

    level: Float[Array, " error"]  # of `LEVEL_ERRORS`, stated or estimated
    # Of the residual modes' natural frequencies (rad/s) and damping ratios, then of both curves'
    # exponents in the forcing frequency (`priors.OFF_RESONANCE`), and, relative, of the modal mass
    # of the mode of interest.
    linear: Float[Array, " deviation"]
    # 1 where the force gain is free: level gains then scale the force, not the measured velocities;
    # 0 where the force is known.
    gain_of_force: Float[Array, ""] = eqx.field(default_factory=lambda: jnp.asarray(0.0))
    # Both over those used for the mean: 1σ from few levels is uncertain, and the covariance uses a
    # wider one (Student's t).
    level_ratio: Float[Array, " error"] = eqx.field(default_factory=lambda: jnp.ones(4))
    linear_ratio: Float[Array, "*deviation"] = eqx.field(default_factory=lambda: jnp.ones(()))
    # Of a new level.
    new_level: Float[Array, " error"] = eqx.field(default_factory=lambda: jnp.zeros(4))


class BalanceProblem(eqx.Module):
    """Measured states, the linear modes and the priors."""

    data: BalanceData
    modes: LinearModes
    prior: PriorStd

    def with_data(self, **fields: Any) -> "BalanceProblem":
        """The problem with these fields of its data replaced."""
        return dataclasses.replace(self, data=dataclasses.replace(self.data, **fields))

    @property
    def modal_constant(self) -> Float[Array, ""]:
        """A = Φ_r Φᵀb in 1/kg of the model; 1/|A| is its modal mass, seen from force and sensor."""
        r, j = self.data.sensor, self.modes.mode_of_interest
        return as_numpy(self.modes.mode_shape)[r, j] * as_numpy(participation_of(self.modes))

    def modal_mass_of(self, unknowns: Unknowns) -> float:
        """The fitted modal mass in kg, seen from force and sensor."""
        return 1 / abs(float(self.constant_of(unknowns)))

    def constant_of(self, unknowns: Unknowns) -> Float[Array, ""]:
        """`modal_constant` with the fitted modal mass."""
        logarithm = log_modal_mass(unknowns, self.prior.linear)
        exp: Any = jnp.exp if isinstance(logarithm, jax.Array) else np.exp
        return self.modal_constant * exp(-logarithm)


def log_modal_mass(unknowns: Unknowns, linear_std: Float[Array, " deviation"]) -> Float[Array, ""]:
    """ln of the fitted modal mass over the model's: the last of the deviations."""
    return as_numpy(unknowns.linear)[-1] * as_numpy(linear_std)[-1]


def stated_level_std(model: Structure | LinearModes) -> Float[np.ndarray, " error"]:
    """Stated 1σ of `LEVEL_ERRORS`, zero where none is stated, as for linear modes alone.

    1σ of σ rad/s of the natural frequency is 2σ/ω of the stiffness; the damping ratio's 1σ is
    relative to the linear one.
    Raises `ValueError` for a stated 1σ of the damping ratio of a mode without damping.
    """
    if isinstance(model, LinearModes):
        return np.zeros(len(LEVEL_ERRORS))
    gain, phase, frequency, damping = model.level_stds
    j = model.modes.mode_of_interest
    natural, ratio = model.modes.natural_frequency.item(j), model.modes.damping_ratio.item(j)
    if damping > 0 and ratio <= 0:
        raise InputError(
            "`level_damping_std` is stated, but the linear damping ratio that it is relative to "
            "is 0: state a damping ratio."
        )
    return np.array([gain, phase, 2 * frequency / natural, damping / ratio if damping > 0 else 0.0])


def stated_prior(
    modes: LinearModes, level_std: Float[np.ndarray, " error"], free: Sequence[str]
) -> PriorStd:
    """Stated priors, with a default for a modal mass of unstated 1σ.

    A `free` force gain is indistinguishable from the modal mass, which is then the model's.
    """
    keep = np.asarray(modes.residual_modes, dtype=int)
    stated = modes.modal_mass_std
    mass = UNSTATED_MODAL_MASS_STD if stated is None else stated.item(modes.mode_of_interest)
    each = (modes.natural_frequency_std, modes.damping_ratio_std)
    own = [*OFF_RESONANCE, 0.0 if "force_gain" in free else mass]
    linear = [*(np.asarray(std)[keep] for std in each), own]
    of_force = float("force_gain" in free)
    values = map(np.asarray, (level_std, np.concatenate(linear), of_force))
    return PriorStd(*jax.device_put(list(values)))


def balance_data(
    data: SteadyStates, modes: LinearModes
) -> tuple[BalanceData, bool, tuple[int, ...]]:
    """The states with a measured velocity, whether their noise is stated, and the level numbers.

    Without stated noise, force, amplitude and phase get the same relative error, larger off
    resonance (`off_resonance_error_factor`), which the fit scales. Near a fold, amplitude and phase
    errors move the balance in one direction only: a force without stated error gets a tenth of the
    velocity's, so that the covariance stays regular.
    Raises `ValueError` where phases are unknown.
    """
    check_phases(data, "a joint fit")
    r = reference_sensor(modes)
    relative = relative_errors(jax.tree.map(np.asarray, data))
    filtered = _one_sensor(data, modes, r, data.velocity, relative)
    velocity, fraction, errors, _ = map(np.asarray, filtered)
    # The force in N, or the drive in V where only that is known.
    driven = not np.any(np.isfinite(np.asarray(data.force)))
    force = np.asarray(data.drive if driven else data.force)
    keep = np.isfinite(np.abs(velocity)) & (np.abs(velocity) > 0) & np.isfinite(force) & (force > 0)
    known = bool(np.all(np.isfinite(errors[keep]))) and bool(np.all(errors[keep][:, 1:3] > 0))
    if not known:
        far = off_resonance_error_factor(velocity)
        errors = np.stack([far, far, far], axis=1)
    of_force = np.where(errors[:, 0] > 0, errors[:, 0], FORCE_TO_VELOCITY * errors[:, 1])
    errors = np.column_stack([of_force, errors[:, 1:], np.zeros(len(errors))])  # no stiffness yet
    levels, index = np.unique(np.asarray(data.level)[keep], return_inverse=True)
    frequency = np.asarray(data.frequency)[keep]
    columns: dict[str, Any] = {
        "level": index,
        "frequency": frequency,
        "force": force[keep],
        "velocity": velocity[keep],
        "fraction": fraction[keep],
        "participation": relative_participation(modes, frequency),
        "std": errors[keep],
        "weight": np.ones(int(keep.sum())),
        "correction": no_errors(int(keep.sum())),
        "detuning": np.zeros(int(keep.sum())),
    }
    # All at once: one by one they compile, a copy of every shape.
    measured = BalanceData(**jax.device_put(columns), n_levels=len(levels), sensor=r)
    return measured, known, tuple(levels.tolist())


_one_sensor = compiled(modal_filter)


def relative_participation(
    modes: LinearModes, frequency: Float[np.ndarray, " state"]
) -> Float[np.ndarray, " state"]:
    """`SensedMode.ratio` at each frequency in rad/s."""
    return np.broadcast_to(np.asarray(sensed_mode(modes, frequency).ratio), frequency.shape)


def with_deviations(modes: LinearModes, deviation: Array, spread: Array) -> LinearModes:
    """The modes, residual ones with frequency and damping changed by deviation·1σ."""
    keep = np.asarray(modes.residual_modes, dtype=int)
    change = deviation * spread
    return eqx.tree_at(
        lambda m: (m.natural_frequency, m.damping_ratio),
        modes,
        (
            modes.natural_frequency.at[keep].add(change[: keep.size]),
            modes.damping_ratio.at[keep].add(change[keep.size : 2 * keep.size]),
        ),
    )


class Motion(eqx.Module):
    """The nonlinear mode's motion in every state, and the force on it."""

    velocity: Complex[Array, " state"]  # m/s at the reference sensor
    displacement: Float[Array, " state"]  # m
    force: Float[Array, " state"]  # N

    def amplitude(self, curve: AbstractFamily | PackedCurve) -> Float[Array, " state"]:
        """The amplitude that a curve is a function of."""
        return curve.amplitude(self.displacement, jnp.abs(self.velocity))


@compiled
def _velocity_of_others(
    modes: LinearModes, change: tuple[Array, Array], frequency: Array, load: Array, fraction: Array
) -> Array:
    modes = with_deviations(modes, *change)
    return jnp.sum(fraction * residual_velocity(modes, frequency, load), axis=1)


def velocity_of_others(
    problem: BalanceProblem,
    deviation: Float[np.ndarray | Array, " deviation"],
    force: Float[np.ndarray, " state"],
) -> Complex[np.ndarray, " state"]:
    """Velocity of all but the mode of interest under forces in N, weighted over the sensors.

    `deviation` of the linear modes is in their 1σ. States are padded, so that few sizes compile.
    """
    data, change = problem.data, (deviation, problem.prior.linear)
    n, size = len(force), with_room(len(force))
    rows = (filled(rows, size, None) for rows in (data.frequency, force, data.fraction))
    return np.asarray(_velocity_of_others(problem.modes, change, *rows))[:n]


def _corrected(unknowns: Unknowns, problem: BalanceProblem, error: Any, xp: Any) -> tuple[Any, Any]:
    """Force in N and velocity in m/s of every state, corrected for level and instrument errors.

    `xp` is NumPy or JAX's. `error` adds to the logarithms of force and velocity and to the phase.
    """
    data, prior = problem.data, problem.prior
    level = (unknowns.level * prior.level)[data.level]
    of_force = prior.gain_of_force * level[:, 0]
    force = data.force * xp.exp(unknowns.log_force_gain + of_force + error[:, 0])
    force = force + unknowns.force_offset * xp.min(data.force)
    phase = error[:, 2] - level[:, 1] - unknowns.instrument_phase
    log_factor = error[:, 1] - level[:, 0] + of_force + 1j * phase
    return force, data.velocity * xp.exp(log_factor)


def recorded_motion(unknowns: Unknowns, problem: BalanceProblem) -> Motion:
    """The mode's motion in the recorded states, computed on the host."""
    host_unknowns, host_problem = jax.tree.map(np.asarray, (unknowns, problem))
    force, velocity = _corrected(
        host_unknowns, host_problem, no_errors(len(host_problem.data.level)), np
    )
    of_mode = velocity - velocity_of_others(problem, unknowns.linear, force)
    return Motion(of_mode, np.abs(of_mode) / host_problem.data.frequency, force)


@compiled
def force_balance(
    unknowns: Unknowns, problem: BalanceProblem, error: Float[Array, "state input"]
) -> Float[Array, "state part"]:
    """(Force required for the measured motion − force) / force: real and imaginary part."""
    data, prior = problem.data, problem.prior
    force, velocity = _corrected(unknowns, problem, error, jnp)
    linear = with_deviations(problem.modes, unknowns.linear, prior.linear)
    others = residual_velocity(linear, jnp.asarray(data.frequency), force)
    of_mode = velocity - jnp.sum(data.fraction * others, axis=1)
    motion = Motion(of_mode, jnp.abs(of_mode) / data.frequency, force)
    level = (unknowns.level * prior.level)[data.level]
    squared = unknowns.squared_frequency(motion.amplitude(unknowns.squared_frequency))
    damping = unknowns.modal_damping(motion.amplitude(unknowns.modal_damping))
    stiffness_exponent, damping_exponent = (unknowns.linear * prior.linear)[EXPONENTS]
    at_rest = unknowns.squared_frequency(jnp.zeros(()))
    added = jnp.where(jnp.isfinite(at_rest), squared - at_rest, squared)
    squared = squared * (1 + level[:, 2] + error[:, 3]) + stiffness_exponent * data.detuning * added
    damping = damping * (1 + level[:, 3] + damping_exponent * data.detuning)
    omega = data.frequency
    stiffness = squared - omega**2 + 1j * omega * damping
    constant = problem.constant_of(unknowns) * data.participation
    needed = stiffness * motion.velocity / (1j * omega * constant)
    # Relative to the force, without a derivative by its gain: a large gain must not pay.
    unit = jax.lax.stop_gradient(motion.force * jnp.exp(-error[:, 0])) * jnp.exp(error[:, 0])
    excess = (needed - motion.force) / unit
    return jnp.stack([excess.real, excess.imag], axis=1)


def with_room(n_states: int) -> int:
    """Padded number of states, so that few sizes compile."""
    power = 1 << (n_states - 1).bit_length()
    return max(n_states, _FEWEST_STATES, 3 * power // 4 if n_states <= 3 * power // 4 else power)


def filled(rows: Array | np.ndarray, size: int, spare: float | None) -> np.ndarray:
    """Rows padded to `size` with `spare`, or with copies of the last row."""
    known = np.asarray(rows)
    missing = np.repeat(known[-1:], size - len(known), axis=0)
    return np.concatenate([known, missing if spare is None else np.full_like(missing, spare)])


def no_errors(n_states: int) -> Float[np.ndarray, "state input"]:
    """Zero errors: the states as recorded."""
    return np.zeros((n_states, len(STATE_ERRORS)))
