"""Smooth curves through the measured states: error propagation and error levels without a law.

The posterior of a test (`identify.test_model`) follows any smooth law. Its slopes weight the misfit
of all candidates alike: none is favoured by its own error propagation, and a model that lacks most
of the stiffness does not distort the weights. For a force known as a drive voltage the posterior
gives a first value of the gain.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex

from snrmjax.diagnose import priors
from snrmjax.diagnose.misfit.predictions import Predictions, predictions_of
from snrmjax.diagnose.misfit.weighted_misfit import weighted_misfit
from snrmjax.identify.checks.instruments import force_gain_undetermined
from snrmjax.identify.pointwise.snrm import participation_of, sensed_mode
from snrmjax.identify.test_model.posterior import TestPosterior, fit_test
from snrmjax.identify.test_model.priors import INSTRUMENT_PHASE
from snrmjax.identify.test_model.states import TestStates, state_errors
from snrmjax.measure.states import SteadyStates
from snrmjax.model.modes import residual_velocity
from snrmjax.model.structures import Structure
from snrmjax.numerics.blocks import padded
from snrmjax.numerics.facts import Fact
from snrmjax.numerics.rules import InputError

_FEWEST = 6  # least number of states with a phase


class Reference(NamedTuple):
    """Smooth curves through the states with phases, and their error propagation."""

    posterior: TestPosterior
    rows: np.ndarray  # compared states with a phase
    by_velocity: Complex[np.ndarray, " state"]  # relative change of the required force by log |V|
    by_phase: Complex[np.ndarray, " state"]  # likewise by phase


def reference_of(predictions: Predictions) -> Reference | None:
    """Smooth curves through the compared states; None where too few have phases."""
    chosen = predictions.chosen
    rows = np.flatnonzero(~chosen.phase_unknown[:, 0])
    if len(rows) < _FEWEST:
        return None
    states = test_states_of(predictions, rows)
    # The misfit has one relative noise; parts are only separated where phases may be controlled,
    # since their scatter is then that of the frequency.
    posterior = fit_test(states, robust=None, parts_of_noise=states.near_one_phase)
    # Evaluate slopes at the actual motion: the records less all estimated errors.
    levels = posterior.level_errors[states.level]
    errors = posterior.corrections[:, 1] - (0.0 if states.force_is_free else levels[:, 0])
    rotation = posterior.corrections[:, 2] - levels[:, 1] - posterior.instrument_phase
    velocity = states.velocity * np.exp(errors + 1j * rotation)
    omega = states.frequency
    curves = posterior.curves(np.abs(velocity) / omega)
    slope = posterior.modal_mass[0] * (curves.slopes[:, 0] + 1j * omega * curves.slopes[:, 1])
    z = 1j * omega * states.constant * states.force / velocity
    ones = np.ones(len(rows), dtype=complex)
    return Reference(posterior, rows, ones + slope / z, 1j * ones)


def test_states_of(predictions: Predictions, rows: np.ndarray) -> TestStates:
    """Some of the compared states as input to the model of a test."""
    chosen, model = predictions.chosen, predictions.model
    modes, sensor = model.modes, chosen.sensors[0]
    j = modes.mode_of_interest
    columns = [np.asarray(a)[rows] for a in chosen.states]
    states = type(chosen.states)(*columns)
    # Padded: JAX operations recompile for every array size.
    load: list[Any] = [padded(np.asarray(a)) for a in (states.frequency, states.force)]
    residual_modes: Array = residual_velocity(modes, *load)
    sensed = sensed_mode(modes, load[0])
    to_mode, ratio_of_drive = (
        np.broadcast_to(np.asarray(part), len(load[0]))[: len(rows)]
        for part in (sensed.to_mode(sensor), sensed.ratio)
    )
    constant = modes.mode_shape.item(sensor, j) * float(participation_of(modes))
    n_sensors = states.velocity.shape[1]
    stated = np.asarray(states.error)[:, [0, 1, 1 + n_sensors]]
    errors, _ = state_errors(stated)
    if not chosen.noise_stated:
        errors = np.tile([errors[0, 0] / errors[0, 1], 1.0, 1.0], (len(rows), 1))
    gain, phase, frequency, damping = predictions.given.level_stds
    natural = modes.natural_frequency.item(j)
    ratio = modes.damping_ratio.item(j)
    mass_std = 0.0 if modes.modal_mass_std is None else modes.modal_mass_std.item(j)
    test = TestStates(
        level=np.asarray(states.level),
        frequency=np.asarray(states.frequency),
        force=np.asarray(states.force),
        velocity=np.sign(constant)
        * to_mode
        * (np.asarray(states.velocity)[:, 0] - np.asarray(residual_modes)[: len(rows), sensor]),
        errors=errors,
        stated=chosen.noise_stated,
        constant=abs(constant) * ratio_of_drive,
        level_std=(gain, phase, 2 * frequency / natural, damping / ratio if ratio > 0 else 0.0),
        mass_std=float(np.hypot(mass_std or 0.05, predictions.force_gain_std)),
        force_is_free=predictions.force_gain_std > 0,
        # A common phase is a separate hypothesis: it must not count as level errors.
        phase_std=INSTRUMENT_PHASE,
    )
    if test.of_one_phase and modes.modal_mass_std is None:
        return test._replace(mass_std=0.0)  # these states do not determine it
    return test


def with_reference(predictions: Predictions) -> Predictions:
    """The predictions weighted by the smooth curves through the states.

    Levels that deviate significantly from these get level errors of the estimated 1σ.
    """
    reference = reference_of(predictions)
    if reference is None:
        return predictions
    posterior = reference.posterior
    stds = [
        std if differs else 0.0
        for std, differs in zip(posterior.hyper.level_std, posterior.differing, strict=True)
    ]
    return _with_levels(dataclasses.replace(predictions, reference=reference), stds)


def _with_levels(predictions: Predictions, stds: Sequence[float]) -> Predictions:
    """Predictions with level errors of these 1σ (`LEVEL_ERRORS`), where none is stated."""
    posterior, model = predictions.reference.posterior, predictions.given
    curves = posterior.curves(posterior.states.amplitude)
    omega = float(np.sqrt(np.median(np.abs(curves.squared_frequency))))
    damping = float(np.median(np.abs(curves.modal_damping))) / (2 * omega)
    gain, phase, stiffness, dissipation = stds
    fields = {
        "level_gain_std": gain,
        "level_phase_std": phase,
        "level_frequency_std": 0.5 * stiffness * omega,
        "level_damping_std": dissipation * damping,
    }
    free = tuple(
        not stated > 0 and std > 0 for stated, std in zip(model.level_stds, stds, strict=True)
    )
    new: dict[str, Any] = {
        name: jnp.asarray(fields[name]) for name, on in zip(fields, free, strict=True) if on
    }
    return dataclasses.replace(
        predictions,
        model=dataclasses.replace(model, **new),
        level_error_std=tuple(stds),
        unstated_levels=free,
    )


def driven_by_voltage(data: SteadyStates) -> bool:
    """Whether the force is only known as a drive voltage."""
    force, drive = np.asarray(data.force), np.asarray(data.drive)
    return bool(not np.any(np.isfinite(force)) and np.any(np.isfinite(drive)))


def with_first_gain(
    model: Structure, data: SteadyStates
) -> tuple[SteadyStates, float, tuple[Fact | str, ...]]:
    """The states with forces from a first value (N/V) of the unknown gain, that value, and notes.

    The gain must stay free. It is the median over the states of the force that the model requires
    for the measured motion, over the drive voltage. Where phases are known it is refined by smooth
    curves of amplitude: a gain scales all of the dynamic stiffness, and the modal mass is known.

    Raises `ValueError` where the model has no such motions.
    """

    def driven(gain: float) -> SteadyStates:
        return eqx.tree_at(lambda d: d.force, data, gain * data.drive)

    predictions = predictions_of(model, driven(1.0), priors.FREE_GAIN_STD, kinds=())
    needed, unknown = weighted_misfit(predictions).baseline.force, predictions.chosen.phase_unknown
    phase = np.angle(np.asarray(predictions.chosen.states.velocity)[:, 0])
    # With known phases use the part against damping, independent of stiffness errors.
    part = np.real(needed * np.exp(-1j * phase)) / np.maximum(np.cos(phase), 0.5)
    gains = np.abs(needed if unknown.any() else part)
    if not np.any(np.isfinite(gains)):
        raise InputError("the model has no motion of the measured amplitude for any state.")
    gain, caveat, from_curves = float(np.median(gains[np.isfinite(gains)])), None, False
    # Twice: the prior of the first curves is centred on the given model's forces.
    for _ in range(0 if unknown.any() else 2):
        reference = reference_of(
            predictions_of(model, driven(gain), priors.FREE_GAIN_STD, kinds=())
        )
        if reference is None:
            break
        mass, std = reference.posterior.modal_mass
        if not mass > 0:  # not physical: keep the first value
            caveat = force_gain_undetermined(np.inf, 0.0)
            break
        gain, from_curves = gain / mass, True
        caveat = force_gain_undetermined(std / mass, float(np.max(np.abs(phase))))
    note = Fact("gain_of_drive", gain=gain, from_curves=from_curves)
    return driven(gain), gain, (note, caveat) if caveat else (note,)
