"""Screening of candidates: the gain that is expected if their starts are scaled to fit best."""

from collections.abc import Sequence

import numpy as np

from snrmjax.diagnose.misfit.candidates import EffectCandidate
from snrmjax.diagnose.misfit.effect_fit import EffectFit
from snrmjax.diagnose.misfit.weighted_misfit import WeightedMisfit

_KEPT = 2  # starts of a candidate
_SCALED = (0.1, 10.0)  # times its own strength, that a start is taken
_TIMES = 3  # that a kind may be in pairs
_ALIKE = 1e-3  # 1 − cos² between changes, less than which is not relied upon


def screened(
    misfit: WeightedMisfit, candidate: EffectCandidate, beside: EffectFit
) -> tuple[float, EffectCandidate]:
    """The expected fall of χ² if the best start is scaled to fit best, and the best starts.

    Returns the fall and the candidate with its best starts so scaled.
    """
    changes = misfit.noise.noise_units(misfit.start_changes(candidate))
    if beside.slopes.shape[1]:
        basis = np.linalg.qr(misfit.noise.decorrelated(beside.slopes.T).T)[0]
    else:
        basis = np.zeros((misfit.n_rows, 0))
    left = misfit.noise.decorrelated(beside.rows)
    moves = np.flatnonzero(np.isfinite(changes).all(axis=1))
    if not moves.size:
        return 0.0, candidate  # no start has a motion
    arms = misfit.noise.decorrelated(changes[moves])
    arms = arms - (arms @ basis) @ basis.T
    size = np.sum(arms**2, axis=1)
    factor = -(arms @ left) / np.where(size > 0, size, np.inf)
    factor = np.where((factor < 0) & (candidate.lower[0] >= 0), 0.0, factor)
    gains = factor**2 * size
    best = np.argsort(gains)[::-1][:_KEPT]
    starts = tuple(_scaled(candidate, int(moves[k]), float(factor[k])) for k in best)
    return float(np.max(gains)), candidate._replace(starts=starts)


def screened_pairs(
    misfit: WeightedMisfit, candidates: Sequence[EffectCandidate]
) -> list[tuple[float, EffectCandidate, EffectCandidate]]:
    """The expected fall of Schwarz's criterion if starts of two effects are scaled to fit best.

    Of every two effects the best starts, so scaled; the best pair first. No effect is in more
    than a few pairs: a strong one would be in all of them.
    """
    rows = [misfit.noise.noise_units(misfit.start_changes(c)) for c in candidates]
    whose = np.repeat(np.arange(len(candidates)), [len(some) for some in rows])
    which = np.concatenate([np.arange(len(some)) for some in rows])
    arms = misfit.noise.decorrelated(np.concatenate(rows))
    size = np.linalg.norm(arms, axis=1)
    moves = np.isfinite(size) & (size > 0)
    whose, which, arms, size = whose[moves], which[moves], arms[moves], size[moves]
    arms = arms / size[:, None]
    along, across = -arms @ misfit.noise.decorrelated(misfit.base), arms @ arms.T
    left = np.maximum(1 - across**2, _ALIKE)
    factor = (along[:, None] - across * along) / left / size[:, None]  # of one beside another
    least = [-np.inf if c.strength_order == 1 and c.lower[0] < 0 else 0.0 for c in candidates]
    good = factor > np.array(least)[whose][:, None]
    good = good & good.T & (whose[:, None] < whose)
    gain = (along[:, None] ** 2 + along**2 - 2 * across * np.outer(along, along)) / left
    cost = np.array([len(c.unit) for c in candidates])[whose] * np.log(misfit.n_rows)
    gain = np.where(good, gain - cost[:, None] - cost, -np.inf)
    found, seen, times = [], set(), np.zeros(len(candidates), dtype=int)
    for place in np.argsort(-gain, axis=None)[: int(np.isfinite(gain).sum())]:
        i, j = divmod(int(place), len(whose))
        kinds = (int(whose[i]), int(whose[j]))
        if kinds in seen or times[list(kinds)].max() >= _TIMES:
            continue
        seen.add(kinds)
        times[list(kinds)] += 1
        one, two = (
            mine._replace(starts=(_scaled(mine, int(which[k]), float(factor[k, other])),))
            for mine, k, other in ((candidates[kinds[0]], i, j), (candidates[kinds[1]], j, i))
        )
        found.append((float(gain[i, j]), one, two))
    return found


def _scaled(candidate: EffectCandidate, start: int, factor: float) -> tuple[float, ...]:
    """A start scaled so that its change has a factor."""
    strength, *shape = candidate.starts[start]
    # Those of second order change as the square of their strength, whatever its sign.
    times = float(np.sqrt(abs(factor))) if candidate.strength_order > 1 else factor
    times = float(np.clip(abs(times), *_SCALED)) * (-1.0 if times < 0 else 1.0)
    return (strength * times, *shape)
