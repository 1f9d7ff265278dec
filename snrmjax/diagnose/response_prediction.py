"""Responses predicted at the force levels of a test, and forces for a constant velocity."""

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from itertools import chain
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from snrmjax.diagnose import priors
from snrmjax.diagnose.diagnosis_result import Diagnosis
from snrmjax.diagnose.kinds.registry import idle_effect
from snrmjax.identify.calibrate.inverse_force import inverse_force
from snrmjax.identify.pointwise.missing_resonance import jump_at_resonance
from snrmjax.identify.test_model.priors import ONE_PHASE
from snrmjax.measure.states import SteadyStates, steady_states
from snrmjax.model.structures import Structure
from snrmjax.numerics.compiled import on_numbers
from snrmjax.numerics.names import with_former_attributes
from snrmjax.numerics.rules import InputError
from snrmjax.numerics.units import HERTZ
from snrmjax.simulate.continuation.continuation import CurveStatus
from snrmjax.simulate.continuation.response_curve import Branch, ResponseCurve
from snrmjax.simulate.solutions.forced_response import ResponseSettings, forced_response_batch
from snrmjax.simulate.virtual_test.recording import acting_force, recorded_curves

_MOST_LEVELS = 12  # to be simulated


class PhaseResonance(NamedTuple):
    """Phase resonance: velocity in phase with the force; NaN where there is none."""

    frequency: float  # Hz
    velocity: float  # m/s
    fold: float = np.nan  # Hz, fold nearest to the resonance
    jump: tuple[float, float] | None = None  # Hz, ends of a jump of the measured states past it


_NOWHERE = PhaseResonance(np.nan, np.nan)


@with_former_attributes({"held_out": "withheld"})
class LevelResponse(NamedTuple):
    """A level's measured and predicted resonances.

    `after` is that of the completed model or, for a withheld level (`withheld`), of the model that
    was completed without it; `completed` is that of the completed model in either case.
    """

    level: int
    force: float  # N, at resonance
    measured: PhaseResonance
    before: PhaseResonance
    after: PhaseResonance
    withheld: bool  # the model of `after` was not fitted to the level
    complete: bool = True  # whether both responses were traced to the end of the range
    completed: PhaseResonance = _NOWHERE  # of the model fitted to all levels


class LevelPredictions(NamedTuple):
    """Resonances of every level, and the responses simulated at their forces."""

    levels: list[LevelResponse]
    before: list[ResponseCurve]  # of the given model
    after: list[ResponseCurve]  # of the completed model


@on_numbers("Differentiate the force that a motion needs: `sj.identify.inverse_force`.")
def predict_levels(diagnosis: Diagnosis, model: Structure) -> LevelPredictions:
    """Simulate the response at every level's force with the given and the completed model.

    Arguments: `model`: the one diagnosed. Raises `ValueError` where there is no completed model.
    Not differentiable: differentiate the force that a motion needs:
    `snrmjax.identify.inverse_force`.
    """
    if diagnosis.completed is None:
        raise InputError("there is no completed model to simulate: see the notes of the diagnosis.")
    return predicted_levels(
        model,
        diagnosis.completed,
        diagnosis.data,
        diagnosis.force_misfit.sensor,
        diagnosis.checks.completed_without,
        diagnosis.answer.force_gain,
    )


def predicted_levels(
    model: Structure,
    completed: Structure,
    data: SteadyStates,
    sensor: int,
    without_level: Mapping[int, Structure] = MappingProxyType({}),
    force_gain: float = 1.0,
) -> LevelPredictions:
    """Measured and predicted resonances of every level, at the levels' forces.

    At most 12 levels are simulated, in addition to those of `without_level`: withheld levels, which
    the models completed without them predict. `force_gain` is acting over recorded force for the
    completed models. The given model has the effects at zero strength: one program traces all.
    """
    forces = _spread(level_forces(data, sensor), {*without_level})
    n, chosen = len(forces), [level for level in forces if level in without_level]
    modes, j = model.modes, model.modes.mode_of_interest
    mode = modes.natural_frequency.item(j), modes.damping_ratio.item(j)
    idle = tuple(idle_effect(e, *mode) for e in completed.effects[len(model.effects) :])
    given = dataclasses.replace(model, effects=(*model.effects, *idle))
    models = [given] * n + [completed] * n + [without_level[level] for level in chosen]
    acting = [force_gain * force for force in (*forces.values(), *(forces[k] for k in chosen))]
    simulated = responses(models, data, [*forces.values(), *acting])
    withheld, rows = dict(zip(chosen, simulated[2 * n :], strict=True)), []
    for k, (level, force) in enumerate(forces.items()):
        before, after = simulated[k], simulated[n + k]
        best = withheld.get(level, after)
        rows.append(
            LevelResponse(
                level,
                force,
                measured_resonance(data, level, sensor),
                simulated_resonance(before, sensor),
                simulated_resonance(best, sensor),
                level in withheld,
                _complete(before) and _complete(best),
                simulated_resonance(after, sensor),
            )
        )
    curves = (list(chain(*some)) for some in (simulated[:n], simulated[n : 2 * n]))
    return LevelPredictions(rows, *curves)


def _spread(forces: dict[int, float], kept: set[int]) -> dict[int, float]:
    """At most 12 levels, evenly spaced in rank of force, and those in `kept`."""
    ranked = sorted(forces, key=forces.__getitem__)
    ranks = np.linspace(0, len(ranked) - 1, min(len(ranked), _MOST_LEVELS)).round().astype(int)
    some = {ranked[rank] for rank in ranks} | kept
    return {level: force for level, force in forces.items() if level in some}


def level_forces(data: SteadyStates, sensor: int = 0) -> dict[int, float]:
    """Force of every level where known, N: at resonance, if its states bracket it, else the mean.

    It varies along a level of a response-controlled test. Where states jump past the resonance it
    is that of the last state before the jump; without phases, that of the state with the largest
    velocity over force.
    """
    level, force = np.asarray(data.level), np.asarray(data.force)
    velocity = np.asarray(data.velocity)[:, sensor]
    good = np.isfinite(force) & np.isfinite(np.abs(velocity))
    forces = {}
    for number in np.unique(level[good]).tolist():
        rows = good & (level == number)
        if np.asarray(data.phase_unknown)[rows, sensor].any():
            forces[number] = float(force[_largest(data, rows, sensor)])
            continue
        phase, of_level = np.angle(velocity[rows]), force[rows]
        if not phase.min() <= 0 <= phase.max():
            at = np.mean(of_level)
        elif measured_resonance(data, number, sensor).jump is not None:
            at = of_level[np.argmin(np.abs(phase))]
        else:
            order = np.argsort(phase)
            at = np.interp(0.0, phase[order], of_level[order])
        forces[number] = float(at)
    return forces


def measured_resonance(data: SteadyStates, level: int, sensor: int) -> PhaseResonance:
    """Interpolated between states on both sides; NaN if one side is empty or at a jump.

    Interpolates frequency over tan φ and |V|/cos φ over φ, both smooth along a resonance. Without
    phases it is the state with the largest velocity over force, if others bracket it.
    """
    velocity, frequency = np.asarray(data.velocity)[:, sensor], np.asarray(data.frequency)
    rows = (np.asarray(data.level) == level) & np.isfinite(np.abs(velocity))
    if np.asarray(data.phase_unknown)[rows, sensor].any():
        top = _largest(data, rows, sensor)
        if frequency[top] in (frequency[rows].min(), frequency[rows].max()):
            return _NOWHERE
        return PhaseResonance(float(frequency[top]) / HERTZ, float(abs(velocity[top])))
    if np.sum(rows) > 2 and np.max(np.abs(np.angle(velocity[rows]))) < ONE_PHASE:
        return _NOWHERE  # the phase was controlled: every state is a resonance
    rows = np.flatnonzero(rows & (velocity.real > 0))
    rows = rows[np.argsort(np.angle(velocity[rows]), kind="stable")]
    phase, speed, frequency = np.angle(velocity[rows]), np.abs(velocity[rows]), frequency[rows]
    if not rows.size or phase[0] > 0 or phase[-1] < 0:
        return _NOWHERE
    jump = jump_at_resonance(np.tan(phase), frequency)
    if jump is not None:
        return _NOWHERE._replace(jump=(jump[0] / HERTZ, jump[1] / HERTZ))
    at = np.interp(0.0, np.tan(phase), frequency)
    tip = np.interp(0.0, phase, speed / np.cos(phase))
    return PhaseResonance(float(at) / HERTZ, float(tip))


def _largest(data: SteadyStates, rows: np.ndarray, sensor: int) -> int:
    """Row, among some, with the largest velocity over force."""
    ratio = np.abs(np.asarray(data.velocity)[:, sensor]) / np.asarray(data.force)
    return int(np.argmax(np.where(rows & np.isfinite(ratio), ratio, -np.inf)))


def simulated_resonance(curves: Sequence[ResponseCurve], sensor: int) -> PhaseResonance:
    """The phase resonance with the largest velocity at a sensor."""
    crossings = [(*crossing, curve) for curve in curves for crossing in _in_phase(curve, sensor)]
    if not crossings:
        return _NOWHERE
    speed, frequency, curve = max(crossings, key=lambda crossing: crossing[0])
    folds, fold = curve.at_events("fold"), np.nan
    if folds.size:
        tips = np.abs(curve.velocity[folds, 1, sensor])
        fold = float(curve.frequency[folds[np.argmax(tips)]]) / HERTZ
    return PhaseResonance(frequency / HERTZ, speed, fold)


def _in_phase(curve: ResponseCurve, sensor: int) -> list[tuple[float, float]]:
    """Velocities (m/s) and frequencies (rad/s) where a sensor is in phase with the force."""
    velocity, frequency = np.asarray(curve.velocity)[:, 1, sensor], np.asarray(curve.frequency)
    real, imag = velocity.real, velocity.imag
    sign_change = (imag[:-1] * imag[1:] <= 0) & (imag[:-1] != imag[1:])
    k = np.flatnonzero(sign_change & (real[:-1] > 0) & (real[1:] > 0))
    fraction = imag[k] / (imag[k] - imag[k + 1])
    columns = ((1 - fraction) * of[k] + fraction * of[k + 1] for of in (real, frequency))
    return list(zip(*(column.tolist() for column in columns), strict=True))


def _complete(curves: Sequence[ResponseCurve]) -> bool:
    """Whether the main branch of a response was traced to the upper end of the range."""
    return any(
        curve.branch == Branch.MAIN and curve.status == CurveStatus.UPPER_END for curve in curves
    )


def responses(
    models: Structure | Sequence[Structure], data: SteadyStates, forces: Sequence[float]
) -> list[list[ResponseCurve]]:
    """Simulated responses around the measured frequencies at each force (N), as recorded.

    `models`: one for all forces, or one for each with the same kinds of effects.
    """
    frequency = np.asarray(data.frequency)
    reach = 0.3 * (frequency.max() - frequency.min())
    ends = (float(frequency.min() - reach), float(frequency.max() + reach))
    each = [models] * len(forces) if isinstance(models, Structure) else list(models)
    loads = [acting_force(model, force) for model, force in zip(each, forces, strict=True)]
    settings = ResponseSettings(harmonic_order=5, stability=False)
    batch = forced_response_batch(models, loads, *ends, settings=settings)
    return [recorded_curves(*pair) for pair in zip(each, batch.curves, strict=True)]


class ControlledVelocityCurve(NamedTuple):
    """The force at a constant velocity amplitude, over frequency."""

    level: int
    velocity: float  # m/s
    frequency: np.ndarray  # rad/s
    force: np.ndarray  # N; NaN without convergence


def controlled_velocity_curves(
    model: Structure, data: SteadyStates, sensor: int, force_gain: float = 1.0
) -> list[ControlledVelocityCurve]:
    """Recorded forces for every level's median velocity, by inverse harmonic balance.

    Arguments: `sensor`: whose velocity is controlled; `force_gain`: acting over recorded force.
    """
    level, omega = np.asarray(data.level), np.asarray(data.frequency)
    speed, force = np.abs(np.asarray(data.velocity))[:, sensor], np.asarray(data.force)
    good = np.asarray(data.measured)[:, sensor] & np.isfinite(force) & (speed > 0)
    parts, n = [], 81
    for number in np.unique(level[good]):
        rows = good & (level == number)
        at = np.linspace(omega[rows].min(), omega[rows].max(), n)
        columns = (number, at, np.median(force[rows]), np.median(speed[rows]))
        parts.append(np.broadcast_arrays(*columns))
    levels, at, load, constant = (np.concatenate(column) for column in zip(*parts, strict=True))
    mask = np.arange(len(data.sensors)) == sensor
    states = steady_states(
        levels,
        at,
        load,
        constant[:, None] * mask + 0j,
        sensors=data.sensors,
        measured=np.tile(mask, (len(levels), 1)),
        base=data.base,
    )
    needed = np.abs(np.asarray(inverse_force(model, states, harmonic_order=5).force)) / force_gain
    return [
        ControlledVelocityCurve(
            int(levels[k]), float(constant[k]), at[k : k + n], needed[k : k + n]
        )
        for k in range(0, len(levels), n)
    ]


def at_curve_force(data: SteadyStates, forces: Iterable[float]) -> np.ndarray:
    """Mask of states within 5 % of one of some forces (N), or of unknown force."""
    force, each = np.asarray(data.force), np.asarray(list(forces))
    distance = np.min(np.abs(force[:, None] / each - 1.0), axis=1)
    return ~(distance > priors.SAME_FORCE)


def is_response_controlled(data: SteadyStates, predicted: Sequence[LevelResponse]) -> bool:
    """Whether a test is response-controlled: its force varies more than its velocity.

    A shaker's force drop at resonance also varies the force, but the velocity far more.
    """
    if not predicted:
        return False
    same = at_curve_force(data, [one.force for one in predicted])
    if not np.mean(~same) > priors.RESPONSE_CONTROLLED:
        return False
    # Ranges of the logarithm from the 10 to the 90 % quantile, at the sensor with most motion.
    speeds = np.abs(np.asarray(data.velocity)) * np.asarray(data.measured)
    speed, force = speeds[:, int(np.argmax(speeds.mean(axis=0)))], np.asarray(data.force)
    good, level = (speed > 0) & (force > 0), np.asarray(data.level)

    def spread(of: np.ndarray, rows: np.ndarray) -> float:
        return float(np.ptp(np.quantile(np.log(of[rows]), (0.1, 0.9))))

    levels = [good & (level == number) for number in np.unique(level[good])]
    # Where both vary, as in phase-resonance tests, neither is controlled.
    return bool(np.median([2 * spread(speed, rows) - spread(force, rows) for rows in levels]) < 0)
