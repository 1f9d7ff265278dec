"""Records corrected for their most likely errors, where a hypothesis is compared with them.

A gain of 15 % moves a stop or a steep curve beyond first order, and so does the error of a single
state on a curve that is steep enough. States are compared as a hypothesis has them without these
errors, and the misfit is carried back to the record by its slopes there, so that errors keep their
priors (orthogonal distance regression: Boggs, Byrd & Schnabel, doi:10.1137/0908085).
"""

import dataclasses
from typing import Any

import jax
import numpy as np
from jaxtyping import Float, Int

from snrmjax.diagnose.misfit.effect_fit import EffectFit, values_of
from snrmjax.diagnose.misfit.predictions import Predictions
from snrmjax.diagnose.misfit.weighted_misfit import WeightedMisfit
from snrmjax.measure.states import SteadyStates


def without_errors(
    misfit: WeightedMisfit,
    fit: EffectFit,
    data: SteadyStates,
    added: Float[np.ndarray, "state input"],
) -> WeightedMisfit:
    """The misfit made straight where records have something added to them, as a fit has it there.

    `data` are the records as they were measured.
    """
    return misfit.about(_at(misfit.predictions, data, added), values_of(misfit, fit))


def at_reference(old: Predictions, data: SteadyStates) -> Predictions:
    """Predictions of the records without the errors that smooth curves find, whatever the law is.

    Fits of effects begin there.
    """
    reference = old.reference
    if reference is None or reference.posterior.states.force_is_free:
        return old
    found, error = reference.posterior, np.asarray(old.chosen.states.error)
    n_sensors = (error.shape[1] - 1) // 2
    added, level = np.zeros_like(error), found.states.level
    own = found.corrections[:, 1:] - found.level_errors[level][:, :2]
    added[reference.rows, 1 : n_sensors + 1] = own[:, [0]]
    added[reference.rows, n_sensors + 1 :] = own[:, [1]]
    return _at(old, data, added)


def with_harmonics(old: Predictions, data: SteadyStates, harmonics: int) -> Predictions:
    """The same predictions by motions with other harmonics."""
    return _at(old, data, already_added(old), harmonics)


def already_added(predictions: Predictions) -> Float[np.ndarray, "state input"]:
    """What is added to the records of some predictions."""
    added = predictions.added
    return np.zeros_like(np.asarray(predictions.chosen.states.error)) if added is None else added


def likely_errors(
    misfit: WeightedMisfit, rows: Float[np.ndarray, " row"]
) -> Float[np.ndarray, "state input"]:
    """What a fit adds to logarithms of velocities and to phases: of levels and of single states."""
    noise, states = misfit.noise, misfit.predictions.chosen.states
    level, error = np.asarray(states.level), np.asarray(states.error)
    n_inputs = error.shape[1]
    n_sensors = (n_inputs - 1) // 2
    pull = np.zeros(noise.known.shape)
    pull[noise.known] = noise.without_shared(rows)
    pull = np.einsum("sij,si->sj", noise.whiten, pull)
    added = -np.einsum("sci,sc->si", misfit.passed_on.by_error, pull) * error**2
    added[:, 0] = 0.0  # of a force: straight as it is
    moved = noise.shared_errors(rows)
    ends = slice(1, 1 + n_sensors), slice(1 + n_sensors, n_inputs)
    for std, kind, own in zip(misfit.predictions.model.level_stds[:2], (0, 1), ends, strict=True):
        shared = moved[noise.shared_kind == kind]
        if shared.size:
            added[:, own] += (std * shared[level])[:, None]
    unknown = np.asarray(misfit.predictions.chosen.phase_unknown)[:, 0]
    added[unknown] = 0.0  # of sizes alone nothing is straight
    return np.where(np.isfinite(added), added, 0.0)


def _at(
    old: Predictions,
    data: SteadyStates,
    added: Float[np.ndarray, "state input"],
    harmonics: int | None = None,
) -> Predictions:
    """Predictions of records with something added to them; it counts once they are weighted."""
    corrected = with_corrected_records(data, old.chosen.rows, old.chosen.sensors, added)
    return old.of_records(corrected, added, harmonics)


def with_corrected_records(
    data: SteadyStates,
    rows: Int[np.ndarray, " state"],
    sensors: tuple[int, ...],
    added: Float[np.ndarray, "state input"],
) -> SteadyStates:
    """The data with errors of velocities and phases taken away, of the states in `rows`."""
    told: Any = jax.tree.map(np.asarray, data)
    n = len(sensors)
    size, turn = np.ones((data.n_states, n)), np.zeros((data.n_states, n))
    size[rows], turn[rows] = np.exp(added[:, 1 : n + 1]), added[:, n + 1 :]
    back = np.argsort(sensors)
    size, turn = size[:, back], turn[:, back]
    orders = np.array(data.harmonic_order, dtype=int)
    found: SteadyStates = dataclasses.replace(
        told,
        velocity=told.velocity * (size * np.exp(1j * turn)),
        velocity_std=told.velocity_std * size,
        harmonics=told.harmonics * size[:, :, None] * np.exp(1j * turn[:, :, None] * orders),
        harmonic_std=told.harmonic_std * size,
    )
    return found
