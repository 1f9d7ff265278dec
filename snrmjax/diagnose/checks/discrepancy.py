"""What a law outside the library may leave beside an answer: smooth misfits of an unknown size."""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float

from snrmjax.diagnose.checks.patterns import hat_functions
from snrmjax.diagnose.misfit.weighted_misfit import WeightedMisfit

SIZES = (0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0)
"""Root-mean-square sizes of a discrepancy in units of the noise, each as probable."""

_OF_AMPLITUDE, _OF_TEST, _ALONG = 6, 8, 4  # knots of free curves
_STATES = 200  # at most, that differ by themselves


def discrepancies(misfit: WeightedMisfit) -> Iterator[tuple[str, Float[np.ndarray, "row any"]]]:
    """Free curves by name, one column a value of theirs, in units of noise that is independent.

    Stiffness and damping as functions of the amplitude; every harmonic as one; the stiffness as a
    function of the order of the test; any force that is smooth along a level; and a stiffness
    that differs from state to state. With unit normal values a set has the size of the noise.
    """
    chosen, noise = misfit.predictions.chosen, misfit.noise
    velocity = np.asarray(chosen.states.velocity)[:, 0]
    amplitude = hat_functions(np.log(np.abs(velocity)), _OF_AMPLITUDE)[noise.state]
    order = np.argsort(np.argsort(chosen.rows)).astype(float)
    of_test = hat_functions(order, _OF_TEST)[noise.state]
    linear = misfit.by_linear
    of_amplitude = np.concatenate([linear[:, [k]] * amplitude for k in (0, 1)], axis=1)
    yield "amplitude", _scaled(misfit, of_amplitude)
    harmonics = list(_harmonics(misfit, np.angle(velocity), amplitude))
    if harmonics:
        yield "harmonics", _scaled(misfit, np.concatenate(harmonics, axis=1))
    yield "order", _scaled(misfit, linear[:, [0]] * of_test)
    yield "level", _scaled(misfit, _along_levels(misfit, np.angle(velocity)))
    yield "state", _scaled(misfit, linear[:, [0]] * _by_state(order)[noise.state])


def _harmonics(
    misfit: WeightedMisfit, phase: Float[np.ndarray, " state"], amplitude: np.ndarray
) -> Iterator[np.ndarray]:
    """Of every harmonic both parts, at phases that turn with the fundamental."""
    noise, chosen = misfit.noise, misfit.predictions.chosen
    n_sensors = len(chosen.sensors)
    for place, number in enumerate(chosen.orders):
        first = 2 * (n_sensors + place)
        for turn in (1.0, 1j):
            unit = turn * np.exp(1j * number * phase)
            columns = np.zeros(noise.known.shape)
            columns[:, first], columns[:, first + 1] = unit.real, unit.imag
            yield noise.noise_units(columns[None])[0][:, None] * amplitude


def _along_levels(misfit: WeightedMisfit, phase: Float[np.ndarray, " state"]) -> np.ndarray:
    noise, level = misfit.noise, np.asarray(misfit.predictions.chosen.states.level)
    parts = []
    for number in np.unique(level):
        mine = level == number
        curves = np.zeros((len(level), _ALONG))
        curves[mine] = hat_functions(phase[mine], _ALONG)
        parts += [(noise.column == k)[:, None] * curves[noise.state] for k in (0, 1)]
    return np.concatenate(parts, axis=1)


def _by_state(order: Float[np.ndarray, " state"]) -> np.ndarray:
    """A column for every state, or for some that follow each other where there are many."""
    n = min(len(order), _STATES)
    group = (order * n / len(order)).astype(int)
    return (group[:, None] == np.arange(n)).astype(float)


def _scaled(misfit: WeightedMisfit, columns: np.ndarray) -> np.ndarray:
    """Independent columns that together have the size of the noise where they act."""
    size = np.sqrt(np.sum(columns**2, axis=1))
    acts = size > 0
    arms = columns / np.sqrt(np.mean(size[acts] ** 2)) if acts.any() else columns
    return np.asarray(misfit.noise.decorrelated(arms.T).T)
