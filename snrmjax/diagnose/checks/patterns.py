"""Patterns in the misfit that a fit leaves: noise has none; and how large that noise is."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.special import fdtrc, ndtr

from snrmjax.diagnose import priors
from snrmjax.diagnose.evidence import hat_functions
from snrmjax.diagnose.misfit.effect_fit import EffectFit
from snrmjax.diagnose.misfit.weighted_misfit import WeightedMisfit

UNLIKELY = priors.REJECTED
_OF_AMPLITUDE, _OF_TEST = 6, 8  # knots of free curves
_RESOLUTION = 1e-6  # of singular values: directions that an answer has already
_TOLERATED = 1.7  # variance over the stated one that neighbouring states may show


def pattern(misfit: WeightedMisfit, fit: EffectFit) -> str | None:
    """Why the misfit that is left cannot be noise of any one size; None where it can."""
    left = misfit.noise.without_shared(fit.rows)
    for reason in (
        _by_level(misfit, left),
        _by_direction(misfit, left),
        _of_neighbours(misfit, left),
    ):
        if reason is not None:
            return reason
    return left_curve(misfit, fit)


def left_curve(misfit: WeightedMisfit, fit: EffectFit) -> str | None:
    """Which free curve still explains a part of the misfit beside an answer; None if none does.

    Stiffness and damping are free functions of amplitude, and the stiffness one of the order of
    the test: a law that is nearly right, or a drift that is not linear, leaves little of χ² and
    all of it in such a curve. The answer's own parameters stay free. Fisher's ratio does not
    depend on the size of the noise.
    """
    chosen, noise = misfit.predictions.chosen, misfit.noise
    if chosen.phase_unknown.any():
        return None  # sizes are not linear in a curve
    speed = np.abs(np.asarray(chosen.states.velocity)[:, 0])
    amplitude = hat_functions(np.log(speed), _OF_AMPLITUDE)
    order = np.argsort(np.argsort(chosen.rows)).astype(float)
    of_test = hat_functions(order, _OF_TEST)
    curves = (
        ("the stiffness as a free function of the amplitude", 0, amplitude),
        ("the damping as a free function of the amplitude", 1, amplitude),
        ("a natural frequency that moves freely in the order of the test", 0, of_test),
    )
    left = noise.decorrelated(fit.rows)
    own = _basis(noise.decorrelated(fit.slopes.T).T)
    found = []
    for name, part, hats in curves:
        arms = noise.decorrelated((misfit.by_linear[:, [part]] * hats[noise.state]).T).T
        basis = _basis(np.concatenate([own, arms], axis=1))
        n_free = misfit.n_rows - basis.shape[1]
        n_own = basis.shape[1] - own.shape[1]
        rest = float(left @ left - np.sum((left @ basis) ** 2))
        gain = float(np.sum((left @ basis) ** 2) - np.sum((left @ own) ** 2))
        if n_own > 0 and n_free > 0:
            ratio = max(gain, 0.0) / n_own / (rest / n_free)
            found.append((float(fdtrc(n_own, n_free, ratio)), name))
    chance, name = min(found, default=(1.0, ""))
    if chance * len(curves) >= UNLIKELY:
        return None
    return (
        f"{name} still explains a part of the misfit that is left (probability by chance "
        f"{chance:.0e}): the law is not the true one."
    )


def _by_level(misfit: WeightedMisfit, left: Float[np.ndarray, " row"]) -> str | None:
    """Misfits of one level, of the force or the harmonics, that are larger than elsewhere."""
    level = np.asarray(misfit.predictions.chosen.states.level)[misfit.noise.state]
    of_force = misfit.noise.column < 2
    groups = [
        (level == k) & (of_force == force) for k in np.unique(level) for force in (True, False)
    ]
    groups = [mine for mine in groups if mine.any() and not mine.all()]
    for mine in groups:
        ratio = np.mean(left[mine] ** 2) / np.mean(left[~mine] ** 2)
        if fdtrc(mine.sum(), (~mine).sum(), ratio) < UNLIKELY / len(groups):
            name = misfit.level_numbers[int(level[mine][0])]
            force = bool(of_force[mine][0])
            what = f"level {name} is" if force else f"the harmonics of level {name} are"
            return (
                f"{what} fitted {np.sqrt(ratio):.2g} times worse than the others: something is "
                "missing there."
            )
    return None


def _by_direction(misfit: WeightedMisfit, left: Float[np.ndarray, " row"]) -> str | None:
    """Misfits of the force in the direction of a frequency change, larger than those across it.

    Noise of one size is the same in every direction of whitened parts; a natural frequency that
    differs from state to state, with temperature for example, has one direction.
    """
    noise = misfit.noise
    force = np.full((len(noise.known), 2), np.nan)
    unit = np.full_like(force, np.nan)
    mine = noise.column < 2
    force[noise.state[mine], noise.column[mine]] = left[mine]
    unit[noise.state[mine], noise.column[mine]] = misfit.by_linear[mine, 0]
    size = np.linalg.norm(unit, axis=1)
    whole = np.isfinite(force).all(axis=1) & (size > 0)
    if not whole.any() or misfit.predictions.chosen.phase_unknown.any():
        return None
    force, unit = force[whole], unit[whole] / size[whole, None]
    with_it = np.sum(force * unit, axis=1)
    across = force[:, 1] * unit[:, 0] - force[:, 0] * unit[:, 1]
    ratio = float(np.sum(with_it**2) / np.sum(across**2))
    if not fdtrc(len(with_it), len(with_it), ratio) < UNLIKELY:
        return None
    return (
        f"the misfit that is left is {np.sqrt(ratio):.2g} times as large in the direction of a "
        "change of the natural frequency as across it, which noise is not: were the states of a "
        "level measured at different temperatures?"
    )


def _of_neighbours(misfit: WeightedMisfit, left: Float[np.ndarray, " row"]) -> str | None:
    """Misfits that are correlated between neighbouring states of a level."""
    for of_test in (True, False):
        parts = list(along(misfit, left, of_test=of_test))
        number = sum(max(len(some) - 1, 0) for some in parts)
        if not number:
            continue
        square = np.mean(np.concatenate(parts) ** 2)
        common = sum(float(some[:-1] @ some[1:]) for some in parts) / number / square
        if ndtr(-common * np.sqrt(number)) < UNLIKELY / 2:
            order = "in the order of the test" if of_test else "along the resonance"
            return (
                f"the misfits of neighbouring states {order} are correlated ({common:.2f}): those "
                "of noise are not."
            )
    return None


def along(
    misfit: WeightedMisfit, rows: Float[np.ndarray, " row"], *, of_test: bool = False
) -> Iterator[Float[np.ndarray, " state"]]:
    """Rows of the force, level by level, along the resonance or in the order of the test.

    Along the resonance states are ordered by the phase of the velocity, which is monotonic even
    where a resonance bends over.
    """
    noise, chosen = misfit.noise, misfit.predictions.chosen
    level = np.asarray(chosen.states.level)
    phase = np.angle(np.asarray(chosen.states.velocity)[:, 0])
    for column in range(2):
        mine = noise.column == column
        values, states = rows[mine], noise.state[mine]
        for number in range(chosen.n_levels):
            some: Int[np.ndarray, " state"] = np.flatnonzero(level[states] == number)
            keys: Sequence[float] = chosen.rows[states[some]] if of_test else phase[states[some]]
            yield values[some[np.argsort(keys, kind="stable")]]


def _basis(columns: Float[np.ndarray, "row column"]) -> Float[np.ndarray, "row any"]:
    """Orthonormal columns with the same span."""
    size = np.linalg.norm(columns, axis=0)
    scaled = columns / np.where(size > 0, size, 1.0)
    if not columns.shape[1]:
        return scaled
    left, values, _ = np.linalg.svd(scaled, full_matrices=False)
    return np.asarray(left[:, values > _RESOLUTION * values[0]])


class NeighbourNoise(NamedTuple):
    """Noise that neighbouring states show."""

    variance: float  # over the stated one
    std: float  # 1σ of the variance


def neighbour_noise(misfit: WeightedMisfit, fit: EffectFit) -> NeighbourNoise:
    """Variance of the force's misfit by second differences along every level.

    What varies smoothly from state to state, explained or not, does not enter; errors that states
    share are taken out first. Where phases are those of the fit, which may be wrong, the order of
    the test counts too: noise is smooth in neither.
    """
    left = misfit.noise.without_shared(fit.rows)
    unsure = misfit.predictions.chosen.phase_unknown.any()
    return min(_scatter(misfit, left, of_test=k) for k in ((False, True) if unsure else (False,)))


def _scatter(
    misfit: WeightedMisfit, left: Float[np.ndarray, " row"], *, of_test: bool
) -> NeighbourNoise:
    """Variance by second differences in one order of the states."""
    squares = [
        (some[:-2] - 2 * some[1:-1] + some[2:]) ** 2 / 6
        for some in along(misfit, left, of_test=of_test)
        if len(some) > 2
    ]
    if not squares:
        return NeighbourNoise(1.0, np.inf)
    every = np.concatenate(squares)
    # Jumps and kinks are not noise: beyond four times the median's 1σ they are cut off.
    limit = 16 * np.median(every) / 0.4549
    # Neighbouring differences share states: about half as many are independent.
    value = float(np.mean(np.minimum(every, limit)))
    return NeighbourNoise(value, value * float(np.sqrt(2 / (0.51 * len(every)))))


def tolerated(noise: float) -> float:
    """Variance that counts as noise: stated a little too small it is no sign of further physics."""
    return float(np.clip(noise, 1.0, _TOLERATED))
