"""Levels whose records are off by more than a straight line follows: corrected before a fit.

A gain of 15 % moves a stop or a steep curve beyond first order. The states are compared at the most
likely errors of their levels, and the misfit is carried back to the record by its slopes there, so
that the errors keep their priors.
"""

import dataclasses

import numpy as np
from jaxtyping import Float, Int

from snrmjax.diagnose.misfit.predictions import Predictions, predictions_of
from snrmjax.diagnose.misfit.reference import as_weighed, reference_of
from snrmjax.diagnose.misfit.weighted_misfit import WeightedMisfit, weighted_misfit
from snrmjax.measure.states import SteadyStates

_SMALL = 0.03  # relative or rad, up to which errors of levels are linear


def at_level_errors(
    misfit: WeightedMisfit, rows: Float[np.ndarray, " row"], data: SteadyStates
) -> Predictions | None:
    """Predictions at the levels' most likely errors; None where these are small.

    Arguments: `rows` are the misfits that a fit leaves; `data` as it was measured.
    """
    gain, phase = _added(misfit, rows)
    if max(np.max(np.abs(gain)), np.max(np.abs(phase))) < _SMALL:
        return None
    old = misfit.predictions
    return _at(old, data, (gain, phase), old.compared.harmonic_order)


def with_harmonics(old: Predictions, data: SteadyStates, harmonics: int) -> Predictions:
    """The same predictions by motions with other harmonics."""
    none = np.zeros(len(old.chosen.rows))
    return _at(old, data, old.added or (none, none), harmonics)


def _at(
    old: Predictions, data: SteadyStates, added: tuple[np.ndarray, np.ndarray], harmonics: int
) -> Predictions:
    gain, phase = added
    corrected = with_corrected_levels(data, old.chosen.rows, gain, phase)
    new = predictions_of(old.given, corrected, old.force_gain_std, harmonics=harmonics)
    new = as_weighed(new, old)
    if not np.any(gain) and not np.any(phase):
        return new
    new = dataclasses.replace(new, reference=reference_of(new))
    by_error = weighted_misfit(new).passed_on.by_error
    n = np.asarray(new.chosen.states.velocity).shape[1]
    of_gain, of_phase = by_error[:, :, 1 : n + 1].sum(axis=2), by_error[:, :, n + 1 :].sum(axis=2)
    offset = -(of_gain * gain[:, None] + of_phase * phase[:, None])
    return dataclasses.replace(new, offset=offset, added=added)


def _added(
    misfit: WeightedMisfit, rows: Float[np.ndarray, " row"]
) -> tuple[Float[np.ndarray, " state"], Float[np.ndarray, " state"]]:
    """What a fit adds to the logarithm of the velocity and to the phase (rad) of every state."""
    noise = misfit.noise
    moved = noise.shared_errors(rows)
    level = np.asarray(misfit.predictions.chosen.states.level)
    found = []
    for std, kind in zip(misfit.predictions.model.level_stds[:2], (0, 1), strict=True):
        own = moved[noise.shared_kind == kind]
        found.append(std * own[level] if own.size else np.zeros(len(level)))
    return found[0], found[1]


def with_corrected_levels(
    data: SteadyStates,
    rows: Int[np.ndarray, " state"],
    gain: Float[np.ndarray, " state"],
    phase: Float[np.ndarray, " state"],
) -> SteadyStates:
    """The data with errors of their levels taken away, of the states in `rows`."""
    size, turn = np.ones(data.n_states), np.zeros(data.n_states)
    size[rows], turn[rows] = np.exp(gain), phase
    orders = np.array(data.harmonic_order, dtype=int)
    by_order = np.exp(1j * turn[:, None] * orders)[:, None, :]
    return dataclasses.replace(
        data,
        velocity=data.velocity * (size * np.exp(1j * turn))[:, None],
        velocity_std=data.velocity_std * size[:, None],
        harmonics=data.harmonics * size[:, None, None] * by_order,
        harmonic_std=data.harmonic_std * size[:, None],
    )
