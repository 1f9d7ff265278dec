"""The hyperparameters of a test, and where its unknowns stand: sizes of noise, levels, curves."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Int

from snrmjax.identify.test_model import priors
from snrmjax.identify.test_model.curve_basis import LENGTHS, N_FUNCTIONS, N_POWERS, CurveBasis
from snrmjax.identify.test_model.linear_gaussian import LinearRows, Objective
from snrmjax.identify.test_model.states import TestStates

_NOTHING = 1e-4  # over a prior's scale, that a size is at least
_MOST = 0.5  # 1σ of a level's error, relative or rad: beyond it levels are not one structure's
ALONG = 4  # functions of phase of a discrepancy, for each part of a level


class Hyper(NamedTuple):
    """The hyperparameters, by what they are of."""

    noise: float  # over the stated one, or relative where none is
    stiffness_process: tuple[float, float]  # size over the mean stiffness, length over the range
    damping_process: tuple[float, float]  # size over the typical damping
    level_std: tuple[float, float, float, float]  # of `LEVEL_ERRORS`
    discrepancy: tuple[float, float]  # of both parts, over Ωδ


class Places(NamedTuple):
    """Where the unknowns stand, and the squared frequency that stiffness is counted from."""

    stiffness: slice
    damping: slice
    levels: np.ndarray  # (level, error)
    discrepancy: tuple[slice, slice]
    reference: float

    @property
    def processes(self) -> Int[np.ndarray, " function"]:
        """Of both curves what is no parabola."""
        starts = (self.stiffness, self.damping)
        return np.concatenate([np.arange(own.start + N_POWERS, own.stop) for own in starts])


def places_of(n_levels: int, discrepancy: bool, reference: float) -> Places:
    """The places for so many levels, with or without a discrepancy."""
    first = 1 + 2 * N_FUNCTIONS
    levels = first + np.arange(4 * n_levels).reshape(n_levels, 4)
    end, wide = first + 4 * n_levels, ALONG * n_levels * discrepancy
    two = slice(end, end + wide), slice(end + wide, end + 2 * wide)
    middle = 1 + N_FUNCTIONS
    return Places(slice(1, middle), slice(middle, first), levels, two, reference)


# In the order of a point of hyperparameters: noise, two processes, four levels, two discrepancies.
NOISE, STIFFNESS, DAMPING, LEVELS, DISCREPANCY = (
    0,
    slice(1, 3),
    slice(3, 5),
    slice(5, 9),
    slice(9, 11),
)


def hyper_at(point: np.ndarray) -> Hyper:
    """The hyperparameters of a point of their logarithms."""
    noise, *values = np.exp(point).tolist()
    one, two = values[7 + 1 :] or (0.0, 0.0)
    return Hyper(
        noise,
        (values[0], values[1]),
        (values[2], values[3]),
        (values[4], values[5], values[6], values[7]),
        (one, two),
    )


def starting_point(states: TestStates, discrepancy: bool) -> np.ndarray:
    """The point from which the most likely one is looked for."""
    noise = priors.STATED_NOISE if states.stated else priors.UNSTATED_NOISE
    process = [priors.CURVE_PROCESS.median, priors.CURVE_LENGTH.median]
    levels = [
        std if std > 0 else 0.3 * prior.scale
        for std, prior in zip(states.level_std, priors.LEVELS, strict=True)
    ]
    more = [0.3 * priors.DISCREPANCY.scale] * (2 * discrepancy)
    return np.log([noise.median, *process, *process, *levels, *more])


def bounds_of(states: TestStates, point: np.ndarray) -> list[tuple[float, float]]:
    """Between which points lie; what is stated is held."""
    size = (np.log(1e-6), np.log(2.0))
    length = (np.log(LENGTHS[0]), np.log(LENGTHS[1]))
    noise = (np.log(0.02), np.log(1e6)) if states.stated else (np.log(1e-5), np.log(1.0))
    levels = []
    for stated, prior in zip(states.level_std, priors.LEVELS, strict=True):
        held = np.log(stated) if stated > 0 else None
        wide = (np.log(_NOTHING * prior.scale), np.log(_MOST))
        levels.append(wide if held is None else (held, held))
    more = [(np.log(_NOTHING * priors.DISCREPANCY.scale), 0.0)] * (len(point) - 9)
    return [noise, size, length, size, length, *levels, *more]


def prior_variances(
    hyper: Hyper, basis: CurveBasis, places: Places, states: TestStates
) -> tuple[np.ndarray, np.ndarray]:
    """Prior variances of all unknowns, and slopes of their logarithms by the hyperparameters."""
    n = (
        places.levels[-1, -1] + 1
        if not places.discrepancy[1].stop
        else max(places.levels[-1, -1] + 1, places.discrepancy[1].stop)
    )
    with_more = places.discrepancy[0].stop > places.discrepancy[0].start
    variance, slopes = np.zeros(n), np.zeros((n, 11 if with_more else 9))
    variance[0] = states.mass_std**2
    for own, process, at in (
        (places.stiffness, hyper.stiffness_process, STIFFNESS),
        (places.damping, hyper.damping_process, DAMPING),
    ):
        log_variance, by = basis.log_variances(np.log(process[0]), np.log(process[1]))
        variance[own], slopes[own, at] = np.exp(log_variance), by
    for k, std in enumerate(hyper.level_std):
        variance[places.levels[:, k]] = std**2
        slopes[places.levels[:, k], LEVELS.start + k] = 2.0
    if with_more:
        for k, (part, std) in enumerate(zip(places.discrepancy, hyper.discrepancy, strict=True)):
            variance[part], slopes[part, DISCREPANCY.start + k] = std**2, 2.0
    return variance, slopes


def objective_of(
    equations: LinearRows,
    states: TestStates,
    basis: CurveBasis,
    places: Places,
    *,
    flat: bool = False,
) -> Objective:
    """Likelihood times prior; with `flat` that of levels' errors alone is left out."""
    noise = priors.STATED_NOISE if states.stated else priors.UNSTATED_NOISE
    densities = [
        noise,
        priors.CURVE_PROCESS,
        priors.CURVE_LENGTH,
        priors.CURVE_PROCESS,
        priors.CURVE_LENGTH,
        *(
            None if stated > 0 or flat else prior
            for stated, prior in zip(states.level_std, priors.LEVELS, strict=True)
        ),
        priors.DISCREPANCY,
        priors.DISCREPANCY,
    ]

    def value(point: np.ndarray) -> tuple[float, np.ndarray]:
        hyper = hyper_at(point)
        variance, by_hyper = prior_variances(hyper, basis, places, states)
        likelihood, by_noise, by_variance = equations.log_likelihood(hyper.noise, variance)
        slopes = by_variance @ by_hyper
        slopes[NOISE] += by_noise
        for k, (density, at) in enumerate(zip(densities, point, strict=False)):
            if density is not None:
                own, slope = density.log_density(at)
                likelihood, slopes[k] = likelihood + own, slopes[k] + slope
        return likelihood, slopes

    return value
