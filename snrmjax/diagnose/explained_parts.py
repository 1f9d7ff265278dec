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
from snrmjax.diagnose.naming.hypotheses import best_hypotheses
from snrmjax.diagnose.naming.parts import Naming, naming_of
from snrmjax.diagnose.naming.phases import likely_dynamic_stiffness
from snrmjax.diagnose.naming.rows import Problem
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
from snrmjax.model.effect_base import AbstractAddedMode
from snrmjax.model.effects import EFFECTS
from snrmjax.model.library.measurement_chain import ModeShapeChange
from snrmjax.model.modes import linear_response, residual_velocity
from snrmjax.numerics.blocks import padded

_ANY_PHASE = 1.0  # rad, 1σ of an unrecorded phase about its estimate


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
        kinds = [k for k in kinds if not issubclass(EFFECTS[k], AbstractAddedMode | ModeShapeChange)]
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
    return NamedParts(naming_of(problem, cells), problem)


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
    model = _motion_of_model(predictions, data, rows, ())(states.velocity, states.frequency)
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
    model = _motion_of_model(predictions, data, rows, recorded.order)
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


def _motion_of_model(
    predictions: Predictions, data: SteadyStates, rows: np.ndarray, orders: tuple[int, ...]
) -> MotionOfModel:
    """The model's motion: in closed form for a linear mode, else by harmonic balance."""
    model = predictions.given
    modes, sensor = model.modes, predictions.chosen.sensors[0]
    j = modes.mode_of_interest
    natural, ratio = map(float, linear_mode(modes))
    if not (model.effects or model.potential.monomials):

        def linear(velocity: Complex[np.ndarray, " state"], omega: np.ndarray) -> ModelMotion:
            none = np.zeros((1, len(omega), len(orders)), complex)
            return ModelMotion((natural**2 - omega**2 + 2j * ratio * natural * omega)[None], none)

        return linear
    constant = modes.mode_shape.item(sensor, j) * float(participation_of(modes))
    used = predictions.chosen.rows[rows]
    # Errors of linear parameters have columns of their own.
    names = [name for name in predictions.stated if not name.startswith("mode_")]
    stds = np.array([predictions.stated[name][1] for name in names])

    def balanced(
        velocity: Complex[np.ndarray, " state"], omega: Float[np.ndarray, " state"]
    ) -> ModelMotion:
        sensed = sensed_mode(modes, omega)
        to_mode, driven = np.asarray(sensed.to_mode(sensor)), constant * np.asarray(sensed.ratio)
        own = np.sign(constant) * velocity / to_mode
        force = np.asarray(data.force)[used]
        rest = np.asarray(residual_velocity(modes, *map(jnp.asarray, (omega, np.ones_like(force)))))
        recorded = np.asarray(data.velocity).copy()
        recorded[used, sensor] = own + rest[:, sensor] * force
        known = jnp.asarray(recorded), jnp.zeros_like(data.phase_std)
        prescribed = eqx.tree_at(lambda d: (d.velocity, d.phase_std), data, known)
        there = predictions_of(model, prescribed, kinds=())
        predicted = there.of(there.group.values[None], names)
        columns = np.moveaxis(predicted.slopes[0] * stds, 2, 0) + predicted.columns[0]
        parts = np.concatenate([predicted.columns, columns])
        parts = parts[..., 0::2] + 1j * parts[..., 1::2]
        chosen = there.chosen
        speed, n = np.abs(np.asarray(chosen.states.velocity)[:, :1]), len(chosen.sensors)
        measured = np.asarray(chosen.states.harmonics)[:, 0]
        higher = (measured + parts[:, :, n : n + len(chosen.orders)] * speed)[..., : len(orders)]
        needed = force * (1 + parts[:, :, 0])
        # Residual modes respond to the force that the model needs, not to the measured one.
        mode = own + rest[:, sensor] * (force - needed)
        with np.errstate(invalid="ignore"):  # NaN where the model has no such motion
            return ModelMotion(1j * omega * driven * needed / (mode * to_mode), higher)

    return balanced
