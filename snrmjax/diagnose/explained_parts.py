"""Naming for a test and a model: the mode's excess over the model, and the laws behind it."""

import dataclasses
from collections.abc import Iterable
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Complex, Float

from snrmjax.diagnose import priors
from snrmjax.diagnose.kinds.registry import hypothesis_of
from snrmjax.diagnose.misfit.predictions import Predictions, predictions_of, scales_of
from snrmjax.diagnose.misfit.reference import test_states_of
from snrmjax.diagnose.naming.columns import Column, parameters_of
from snrmjax.diagnose.naming.hypotheses import best_hypotheses, hypotheses_of, with_rivals
from snrmjax.diagnose.naming.parts import Naming, naming_of
from snrmjax.diagnose.naming.phases import likely_dynamic_stiffness
from snrmjax.diagnose.naming.rows import Cell, Problem, solved
from snrmjax.diagnose.readings import (
    LinearTest,
    ModelMotion,
    MotionOfModel,
    Readings,
    RecordedHarmonics,
    readings_of,
)
from snrmjax.diagnose.verdict import Verdict
from snrmjax.identify.calibrate.calibration_states import ASSUMED_ERROR
from snrmjax.identify.pointwise.snrm import is_single, linear_mode, participation_of, sensed_mode
from snrmjax.measure.states import SteadyStates
from snrmjax.model.effect_base import AbstractAddedMode, AbstractForce
from snrmjax.model.effects import EFFECTS
from snrmjax.model.library.measurement_chain import ModeShapeChange
from snrmjax.model.modes import linear_response, residual_velocity
from snrmjax.model.structures import Structure
from snrmjax.numerics.blocks import padded

_ANY_PHASE = 1.0  # rad, 1σ of an unrecorded phase about its estimate
_PASSES = 2  # of harmonic balance at the strengths
_BALANCED = 30  # columns that are made exact by harmonic balance
_BY_HARMONICS = 0.04  # x³: its third harmonic is 1/24 of the motion per unit of stiffness change


class NamedParts(NamedTuple):
    """A naming and its linear problem."""

    naming: Naming
    problem: Problem


def named_parts(predictions: Predictions, data: SteadyStates, kinds: Iterable[str]) -> NamedParts:
    """The laws behind the change of stiffness, damping and every other harmonic.

    Arguments: `data`: as measured; `kinds`: the effects that may be missing. States without phases
    count by their magnitudes alone.
    """
    unknown = predictions.chosen.phase_unknown[:, 0]
    if unknown.any():
        predictions = _with_likely_phases(predictions, data)
    if unknown.any():
        kinds = [
            k for k in kinds if not issubclass(EFFECTS[k], AbstractAddedMode | ModeShapeChange)
        ]
    elif not (predictions.chosen.orders or predictions.given.potential.monomials):
        kinds = [k for k in kinds if not issubclass(EFFECTS[k], ModeShapeChange)]
    readings = _readings(predictions, data, unknown)
    if readings.posterior.phase_is_controlled:
        kinds = [k for k in kinds if _shows_at_one_phase(k)]
    gain, phase, *_ = readings.posterior.hyper.level_std
    # A gain or phase common to all levels may be the mean of level errors as large as that.
    if gain > priors.OF_LEVELS * priors.GAIN:
        kinds = [k for k in kinds if not _is_gain(k)]
    if phase > priors.OF_LEVELS * priors.INSTRUMENT_PHASE:
        kinds = [k for k in kinds if not hypothesis_of(k).only_phase]
    problem, cells = best_hypotheses(readings, kinds)
    for _ in range(0 if unknown.any() else _PASSES):
        if not _is_strong(problem, cells[0]):
            break
        balanced = _with_balanced_laws(problem, with_rivals(problem, cells), predictions, data)
        problem, cells = balanced, hypotheses_of(balanced)
    return NamedParts(naming_of(problem, cells), problem)


def _is_strong(problem: Problem, cell: Cell) -> bool:
    """Whether describing functions of a hypothesis' laws are less exact than the readings.

    A law excites harmonics of the motion, which change its force at the fundamental: by about
    θ²/25 of the linear stiffness for a law that changes it by θ.
    """
    readings, unit = problem.readings, problem.readings.natural_frequency**2
    strengths = solved(problem, cell).mean[: len(cell.columns)]
    errors = [
        readings.whitened(_BY_HARMONICS * strength**2 * unit * problem.columns[k].change)
        for k, strength in zip(cell.columns, strengths, strict=True)
        if issubclass(EFFECTS[problem.columns[k].kind], AbstractForce)
    ]
    return any(np.linalg.norm(error) > priors.VISIBLE for error in errors)


def _with_balanced_laws(
    problem: Problem, cells: list[Cell], predictions: Predictions, data: SteadyStates
) -> Problem:
    """The problem with laws as harmonic balance has them.

    The columns of the first hypotheses become exact for their strengths.
    """
    readings, unit = problem.readings, problem.readings.natural_frequency**2
    strengths: dict[int, float] = {}
    columns = problem.columns
    for cell in cells:
        own = [k for k in cell.columns if issubclass(EFFECTS[columns[k].kind], AbstractForce)]
        if len(strengths) >= _BALANCED or {*own} <= strengths.keys():
            continue
        mean = solved(problem, cell).mean
        for k in own:
            strengths.setdefault(k, float(mean[cell.columns.index(k)]))
    laws = {k: _law_at(readings, columns[k], strength) for k, strength in strengths.items()}
    laws = {k: law for k, law in laws.items() if law}
    changes = _balanced_changes(readings, predictions, data, list(laws.values()))
    exact = [
        columns[k]._replace(change=change / (strengths[k] * unit))
        for k, change in zip(laws, changes, strict=True)
        if np.isfinite(change).all()
    ]
    kinds = {column.kind for column in exact}
    return problem.with_columns([*exact, *(c for c in columns if c.kind not in kinds)])


def _law_at(readings: Readings, column: Column, strength: float) -> dict[str, float]:
    """Parameters of a column's law by name; none where it cannot have this strength."""
    low, high = column.limits
    parameters = parameters_of(readings, column, strength) if low < strength < high else None
    return {f"{column.kind}.{name}": value for name, value in (parameters or {}).items()}


def _balanced_changes(
    readings: Readings,
    predictions: Predictions,
    data: SteadyStates,
    laws: list[dict[str, float]],
) -> Complex[np.ndarray, "law state"]:
    """Change of the dynamic stiffness (1/s²) by every law, at the measured fundamental motions."""
    motion = _PrescribedMotion.of(predictions, data, readings.velocity, readings.frequency)
    there = motion.predictions({label.split(".")[0] for law in laws for label in law})
    group = there.group
    values = [group.at(tuple(law), np.array(list(law.values()))) for law in laws]
    stiffness = motion.dynamic_stiffness(there.of(np.array([group.values, *values])).columns)
    return stiffness[1:] - stiffness[0]


def _shows_at_one_phase(kind: str) -> bool:
    """Whether states at a controlled phase can show an effect."""
    one = hypothesis_of(kind)
    adds_mode = one.follows_force or issubclass(EFFECTS[kind], AbstractAddedMode)
    return not (adds_mode or one.only_phase or _is_gain(kind))


def _is_gain(kind: str) -> bool:
    """Whether an effect is a gain error of an instrument; an added mass is none."""
    one = hypothesis_of(kind)
    return one.of_instrument and one.like_force_gain


def _with_likely_phases(predictions: Predictions, data: SteadyStates) -> Predictions:
    """Velocities of unknown phase at the phases of smooth curves with the recorded magnitudes."""
    chosen, modes = predictions.chosen, predictions.given.modes
    rows = np.arange(len(chosen.rows))
    states = test_states_of(predictions, rows)
    amplitude = np.abs(states.velocity) / states.frequency
    model = _motion_of_model(predictions, data, ())(states.velocity, states.frequency)
    natural = float(linear_mode(modes)[0])
    z = likely_dynamic_stiffness(
        states.force * states.constant / amplitude, model.dynamic_stiffness[0], amplitude, natural
    )
    shape = modes.mode_shape[chosen.sensors[0], modes.mode_of_interest]
    behind = np.pi if float(shape * participation_of(modes)) < 0 else 0.0
    likely = predictions.with_phases(np.pi / 2 - np.angle(z) + behind)
    error: Any = np.asarray(chosen.states.error).copy()
    error[chosen.phase_unknown[:, 0], 1 + len(chosen.sensors)] = _ANY_PHASE
    states_likely = likely.chosen.states._replace(error=error)
    return dataclasses.replace(likely, chosen=likely.chosen._replace(states=states_likely))


def overall(naming: Naming) -> Verdict:
    """The verdict on all parts: the weakest among those with a significant change."""
    verdicts = [Verdict(part.verdict) for part in naming.parts]
    order = (Verdict.DRAWN, Verdict.AMBIGUOUS, Verdict.NAMED)
    return next((one for one in order if one in verdicts), Verdict.NOTHING_MISSING)


def _readings(predictions: Predictions, data: SteadyStates, unknown: np.ndarray) -> Readings:
    rows = np.arange(len(unknown))
    states, modes = test_states_of(predictions, rows), predictions.given.modes
    if unknown.any():
        errors = states.errors.copy()
        if not states.stated:  # over those of magnitudes, taken as `ASSUMED_ERROR`
            errors[unknown, 2] = _ANY_PHASE / ASSUMED_ERROR
        states = states._replace(errors=errors, phase_std=0.0)
    j = modes.mode_of_interest
    order = np.asarray(data.order)[predictions.chosen.rows[rows]]
    order = np.where(np.isfinite(order), order, np.linspace(0.0, 1.0, len(rows)))
    natural, ratio = map(float, linear_mode(modes))
    linear = LinearTest(
        natural,
        ratio,
        modes.natural_frequency_std.item(j),
        modes.damping_ratio_std.item(j),
        states.mass_std,
        modes.mode_shape.item(predictions.chosen.sensors[0], j),
        float(
            np.sign(modes.mode_shape[predictions.chosen.sensors[0], j] * participation_of(modes))
        ),
        scales_of(predictions),
    )
    # The phases of harmonics are relative to the fundamental, whose phase must be known.
    no_harmonics = bool(unknown.any()) or not is_single(modes)
    recorded = _recorded_harmonics(predictions, rows, none=no_harmonics)
    model = _motion_of_model(predictions, data, recorded.order)
    return readings_of(states, order, model, linear, recorded, phases_known=not unknown.any())


def _recorded_harmonics(
    predictions: Predictions, rows: np.ndarray, *, none: bool
) -> RecordedHarmonics:
    """Harmonics at the reference sensor, and its response to harmonics of the exciter force."""
    chosen, modes = predictions.chosen, predictions.given.modes
    sensor, orders = chosen.sensors[0], () if none else chosen.orders
    states, n = chosen.states, len(chosen.sensors)
    first = 2 * n  # column of the reference sensor's harmonics
    speed = np.abs(np.asarray(states.velocity)[rows, 0])[:, None]
    std = np.asarray(states.own_std)[rows, first : first + 2 * len(orders) : 2] * speed
    known = np.asarray(states.known)[rows, first : first + 2 * len(orders) : 2]
    forced = np.zeros((len(rows), len(orders)), complex)
    for index, order in enumerate(orders):
        load: list[Any] = [
            padded(order * np.asarray(states.frequency)[rows]),
            padded(np.asarray(states.force)[rows]),
        ]
        forced[:, index] = np.asarray(linear_response(modes, *load))[: len(rows), sensor]
    velocity = np.asarray(states.harmonics)[rows, 0, : len(orders)]
    return RecordedHarmonics(orders, velocity, np.where(known, std, np.nan), forced)


class _PrescribedMotion(NamedTuple):
    """Measured states with other motions of the mode at the reference sensor."""

    model: Structure
    data: SteadyStates
    mode: Complex[np.ndarray, " state"]  # velocity of the mode at the sensor, m/s
    frequency: Float[np.ndarray, " state"]  # rad/s
    force: Float[np.ndarray, " state"]  # N
    residual: Complex[np.ndarray, " state"]  # velocity of residual modes per unit of force
    driven: Complex[np.ndarray, " state"]  # velocity of the mode per unit of force and iΩ/Z

    @classmethod
    def of(
        cls,
        predictions: Predictions,
        data: SteadyStates,
        velocity: Complex[np.ndarray, " state"],
        omega: Float[np.ndarray, " state"],
    ) -> "_PrescribedMotion":
        """For velocities (m/s) of the mode alone."""
        model, chosen = predictions.given, predictions.chosen
        modes, sensor, used = model.modes, chosen.sensors[0], chosen.rows
        constant = modes.mode_shape.item(sensor, modes.mode_of_interest)
        constant = constant * float(participation_of(modes))
        sensed = sensed_mode(modes, omega)
        to_mode = np.asarray(sensed.to_mode(sensor))
        own = np.sign(constant) * velocity / to_mode
        force = np.asarray(data.force)[used]
        rest = np.asarray(residual_velocity(modes, *map(jnp.asarray, (omega, np.ones_like(force)))))
        recorded = np.asarray(data.velocity).copy()
        recorded[used, sensor] = own + rest[:, sensor] * force
        known = jnp.asarray(recorded), jnp.zeros_like(data.phase_std)
        prescribed = eqx.tree_at(lambda d: (d.velocity, d.phase_std), data, known)
        driven = constant * np.asarray(sensed.ratio) / to_mode
        return cls(model, prescribed, own, omega, force, rest[:, sensor], driven)

    def predictions(self, kinds: Iterable[str]) -> Predictions:
        """Force and harmonics that these motions need, with further effects."""
        return predictions_of(self.model, self.data, kinds=[k for k in EFFECTS if k in {*kinds}])

    def dynamic_stiffness(
        self, columns: Float[np.ndarray, "*trial state column"]
    ) -> Complex[np.ndarray, "*trial state"]:
        """Z = FA/X of the mode, 1/s², for the force that the motions need."""
        needed = self.force * (1 + columns[..., 0] + 1j * columns[..., 1])
        # Residual modes respond to the force that the model needs, not to the measured one.
        mode = self.mode + self.residual * (self.force - needed)
        with np.errstate(invalid="ignore"):  # NaN where the model has no such motion
            return 1j * self.frequency * self.driven * needed / mode


def _motion_of_model(
    predictions: Predictions, data: SteadyStates, orders: tuple[int, ...]
) -> MotionOfModel:
    """The model's motion: in closed form for a linear mode, else by harmonic balance."""
    model = predictions.given
    natural, ratio = map(float, linear_mode(model.modes))
    if not (model.effects or model.potential.monomials):

        def linear(velocity: Complex[np.ndarray, " state"], omega: np.ndarray) -> ModelMotion:
            none = np.zeros((1, len(omega), len(orders)), complex)
            return ModelMotion((natural**2 - omega**2 + 2j * ratio * natural * omega)[None], none)

        return linear
    # Errors of linear parameters have columns of their own.
    names = [name for name in predictions.stated if not name.startswith("mode_")]
    stds = np.array([predictions.stated[name][1] for name in names])

    def balanced(
        velocity: Complex[np.ndarray, " state"], omega: Float[np.ndarray, " state"]
    ) -> ModelMotion:
        motion = _PrescribedMotion.of(predictions, data, velocity, omega)
        there = motion.predictions(())
        predicted = there.of(there.group.values[None], names)
        shifted = np.moveaxis(predicted.slopes[0] * stds, 2, 0) + predicted.columns[0]
        columns = np.concatenate([predicted.columns, shifted])
        chosen = there.chosen
        speed, n = np.abs(np.asarray(chosen.states.velocity)[:, :1]), len(chosen.sensors)
        measured = np.asarray(chosen.states.harmonics)[:, 0]
        parts = columns[..., 0::2] + 1j * columns[..., 1::2]
        higher = (measured + parts[:, :, n : n + len(chosen.orders)] * speed)[..., : len(orders)]
        return ModelMotion(motion.dynamic_stiffness(columns), higher)

    return balanced
