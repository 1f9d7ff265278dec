"""Stepwise search for the effects that explain a misfit, and how large others would have to be.

What is worth a fit is seen from the gain that is expected if its starts are scaled to fit best.
"""

from collections.abc import Collection, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from snrmjax.diagnose import priors
from snrmjax.diagnose.misfit.candidates import EffectCandidate, candidate
from snrmjax.diagnose.misfit.effect_fit import (
    EffectFit,
    baseline_fit,
    fit_effect,
    fit_effects,
    started,
    unfitted,
    with_errors_passed_on,
)
from snrmjax.diagnose.misfit.weighted_misfit import WeightedMisfit
from snrmjax.model.effect_base import AbstractEffect
from snrmjax.model.effect_metadata import VISIBLE_CHANGE, MotionScales
from snrmjax.model.effect_shape import shape_of, starts_of
from snrmjax.model.effects import EFFECTS, effect_parameters, is_own
from snrmjax.numerics.blocks import over_cores
from snrmjax.numerics.levenberg_marquardt import MinimisationStatus


class TriedEffect(NamedTuple):
    """A candidate that one step of the search compared."""

    kind: str
    gain: float  # fall of Schwarz's criterion from what was there before
    chi_square: float
    parameters: dict[str, float]
    status: MinimisationStatus


class FoundEffects(NamedTuple):
    """The effects that a search found: the best by Schwarz's criterion, until evidence is known."""

    misfit: WeightedMisfit  # with errors passed on as the answer passes them
    fit: EffectFit
    baseline: EffectFit
    table: tuple[tuple[TriedEffect, ...], ...]  # of every step
    considered: tuple[EffectFit, ...] = ()  # all fits under the errors of `misfit`
    classes: tuple[tuple[str, ...], ...] = ()  # of every effect: itself, then those as probable

    @property
    def p_value(self) -> float:
        """Probability by chance of at least the misfit that is left."""
        return self.fit.p_value


def find_effects(
    misfit: WeightedMisfit,
    scales: MotionScales,
    kinds: tuple[str, ...],
    further_starts: Mapping[str, tuple[float, ...]] | None = None,
) -> FoundEffects:
    """Fit effects one by one, in pairs, and a third where no pair explains the misfit.

    A close linear mode has three parameters of its own and could follow a part of most laws: it
    is not searched for, but an answer that it could have caused is compared with it.
    `further_starts` are parameters, by kind, from which fits begin too.
    """
    candidates = {kind: candidate(kind, scales) for kind in kinds}
    for kind, start in (further_starts or {}).items():
        if kind in candidates and len(start) == len(candidates[kind].unit):
            candidates[kind] = candidates[kind]._replace(starts=(*candidates[kind].starts, start))
    alternatives = [candidates.pop(kind) for kind in kinds if not EFFECTS[kind].searched]
    found = _searched(misfit, candidates)
    for alternative in alternatives:
        found = _compared_with(found, alternative, candidates)
    return found


def _searched(misfit: WeightedMisfit, candidates: dict[str, EffectCandidate]) -> FoundEffects:
    misfit, singles, rows = _tried(misfit, candidates)
    nothing, table = baseline_fit(misfit), [rows]
    best = _best([nothing, *singles])
    considered = [nothing, *singles]
    if not _gains(nothing, best):
        return FoundEffects(misfit, nothing, nothing, tuple(table), tuple(considered))
    jobs = [(c, best) for c in _promising(misfit, candidates, best)]
    unexplained = best.p_value < 0.05
    # Two simple effects may do what one with many parameters does.
    if unexplained or len(best.values) > priors.SIMPLE:
        jobs += _pairs(misfit, candidates, best, unexplained=unexplained)
    pairs = fit_effects(misfit, jobs, _hopeless(best))
    pair = _best([best, *pairs])
    considered += pairs
    if not _gains(best, pair):
        return FoundEffects(misfit, best, nothing, tuple(table), tuple(considered))
    # Errors are passed on as by both. Each is chosen again beside the other one.
    misfit = with_errors_passed_on(misfit, pair)
    nothing = baseline_fit(misfit)
    alone = []
    for kind in pair.kinds:
        starts = (*candidates[kind].starts, pair.of_kind(kind))
        alone.append(fit_effect(misfit, candidates[kind]._replace(starts=starts)))
    others = [fit for fit in singles if fit.kinds[0] not in pair.kinds]
    one, two = (_where(candidates, pair, kind) for kind in pair.kinds)
    together = fit_effect(misfit, two, started(one))
    considered = [nothing, *alone, together]
    again = [(_where(candidates, fit, fit.kinds[0]), nothing) for fit in others]
    considered += fit_effects(misfit, again, _hopeless(together))
    for kind, other in zip(pair.kinds, reversed(alone), strict=True):
        rivals = [c for c in _promising(misfit, candidates, other) if c.kind != kind]
        fits = fit_effects(misfit, [(c, other) for c in rivals], _hopeless(together))
        table.append(_table(other, [*fits, together]))
        considered += fits
    best = _best(considered)
    if best.p_value < priors.REJECTED and len(best.kinds) < priors.MOST_EFFECTS:
        thirds = fit_effects(misfit, [(c, best) for c in _promising(misfit, candidates, best)])
        table.append(_table(best, thirds))
        considered += thirds
        third = _best([best, *thirds])
        best = third if _gains(best, third) else best
    return FoundEffects(misfit, best, nothing, tuple(table), tuple(considered))


def refitted(misfit: WeightedMisfit, scales: MotionScales, fit: EffectFit) -> EffectFit:
    """The same effects fitted to another misfit, all together from where they were."""
    if not fit.kinds:
        return baseline_fit(misfit)
    *others, last = fit.kinds
    n = len(fit.values) - len(fit.of_kind(last))
    before = fit._replace(
        kinds=tuple(others),
        labels=fit.labels[:n],
        values=fit.values[:n],
        lower=fit.lower[:n],
        upper=fit.upper[:n],
    )
    begun = candidate(last, scales)._replace(starts=(fit.of_kind(last),))
    return fit_effect(misfit, begun, before)


def _compared_with(
    found: FoundEffects, close: EffectCandidate, candidates: dict[str, EffectCandidate]
) -> FoundEffects:
    """The answer beside others with a close mode.

    The mode is fitted in place of all effects, in place of the linear ones, and beside an answer
    that does not fit. It is not compared where nothing was found, nor with a single nonlinearity
    that fits: a linear mode does the same at every level.
    """
    misfit, fit = found.misfit, found.fit
    alike = [kind for kind in fit.kinds if EFFECTS[kind].is_linear]
    others = [kind for kind in fit.kinds if not EFFECTS[kind].is_linear]
    refuted = fit.p_value < priors.REJECTED
    fits_by_itself = len(others) == len(fit.kinds) == 1 and not refuted
    if not fit.kinds or fits_by_itself or misfit.predictions.sizes.alone.any():
        return found
    jobs = [(close, found.baseline)]
    if alike and others:
        only = found.baseline
        for kind in others:
            only = fit_effect(misfit, _where(candidates, fit, kind), only)
        jobs.append((close, only))
    if refuted and len(fit.kinds) < priors.MOST_EFFECTS:
        jobs.append((close, fit))
    fits = fit_effects(misfit, jobs, _hopeless(fit))
    fits = [fit for fit in fits if np.isfinite(fit.chi_square)]
    if not fits:
        return found
    best = _best([fit, *fits])
    table = (*found.table, _table(found.baseline, fits))
    if len(best.kinds) == 2 and close.kind in best.kinds:
        # What is kept beside the mode is chosen anew.
        mode = _where({close.kind: close}, best, close.kind)
        alone = unfitted(misfit, mode)
        rivals = [c for c in _promising(misfit, candidates, alone) if c.kind not in best.kinds]
        again = fit_effects(misfit, [(mode, started(one)) for one in rivals], _hopeless(best))
        table, fits = (*table, _table(alone, [best, *again])), [*fits, *again]
        best = _best([best, *again])
    return found._replace(fit=best, table=table, considered=(*found.considered, *fits))


def _pairs(
    misfit: WeightedMisfit,
    candidates: dict[str, EffectCandidate],
    best: EffectFit,
    *,
    unexplained: bool,
) -> list[tuple[EffectCandidate, EffectFit]]:
    """Fits, to be done, of the pairs with the largest expected gain, from their own starts.

    Those with no more parameters than the best effect alone; and, where that leaves something
    `unexplained`, those with any number.
    """
    pairs = [(one, two) for _, one, two in screened_pairs(misfit, list(candidates.values()))]
    most = len(best.values)
    simple = [(one, two) for one, two in pairs if len(one.unit) + len(two.unit) <= most]
    chosen = simple[: priors.PAIRS] if most > priors.SIMPLE else []
    chosen += [pair for pair in pairs[: priors.PAIRS] if pair not in chosen] if unexplained else []
    return [(two, started(one)) for one, two in chosen]


def _hopeless(best: EffectFit) -> float:
    """χ² that a fit must fall below, or promise to, to be continued beside the best one so far."""
    return priors.HOPELESS * max(best.chi_square, float(len(best.rows)))


def _promising(
    misfit: WeightedMisfit, candidates: dict[str, EffectCandidate], before: EffectFit
) -> list[EffectCandidate]:
    """The candidates of which one start, scaled, is expected to explain most of what is left.

    Starts are coarse: a candidate with a quarter of the largest expected gain may still win, and
    whoever brings an effect wants it fitted.
    """
    others = [c for kind, c in candidates.items() if kind not in before.kinds]
    over_cores(misfit.start_changes, others)  # many short programs
    changes = [screened(misfit, c, before) for c in others]
    changes.sort(key=lambda pair: -pair[0])
    # Sizes alone are not linear in an effect.
    share = 0.02 if misfit.predictions.sizes.alone.any() else 0.25
    few = 4.0  # of χ², that is worth a fit; beyond the first eight such a share of the largest
    least = max(few, share * max((gain for gain, _ in changes), default=0.0))
    worth = [*[few] * 8, *[least] * len(changes)][: len(changes)]
    judged = zip(changes, worth, strict=True)
    return [c for (gain, c), need in judged if gain > need or is_own(c.kind)]


def _tried(
    misfit: WeightedMisfit, candidates: dict[str, EffectCandidate]
) -> tuple[WeightedMisfit, list[EffectFit], tuple[TriedEffect, ...]]:
    """Fits of candidates, those near the best again with errors passed on as the best one does.

    Returns the misfit so weighted, these fits, and all first fits as rows of the table.
    """
    nothing = baseline_fit(misfit)
    fits = fit_effects(misfit, [(c, nothing) for c in _promising(misfit, candidates, nothing)])
    rows = _table(nothing, fits)
    fits = [fit for fit in fits if np.isfinite(fit.chi_square)]
    best = min(fits, key=lambda fit: fit.criterion, default=nothing)
    if not _gains(nothing, best):
        return misfit, fits, rows
    again = with_errors_passed_on(misfit, best)
    reach = best.criterion + max(40.0, 0.5 * best.chi_square)
    near = [fit for fit in fits if fit.criterion < reach]
    jobs = [(_where(candidates, fit, fit.kinds[0]), baseline_fit(again)) for fit in near]
    return again, fit_effects(again, jobs), rows


def _where(candidates: dict[str, EffectCandidate], fit: EffectFit, kind: str) -> EffectCandidate:
    """A candidate that begins where a fit of it, or of it beside others, ended."""
    return candidates[kind]._replace(starts=(fit.of_kind(kind),))


def _gains(before: EffectFit, after: EffectFit) -> bool:
    """Whether an effect counts as detected."""
    return before.criterion - after.criterion > priors.DETECTED


def _best(fits: Sequence[EffectFit]) -> EffectFit:
    """The fit with the smallest criterion."""
    finite = [fit for fit in fits if np.isfinite(fit.criterion)]
    if not finite:
        raise ValueError(
            "no trial fit of an effect has a finite misfit: the model is too far from the data to "
            "be compared."
        )
    return min(finite, key=lambda fit: fit.criterion)


def _table(before: EffectFit, fits: list[EffectFit]) -> tuple[TriedEffect, ...]:
    rows = [
        TriedEffect(
            next(kind for kind in fit.kinds if kind not in before.kinds),
            before.criterion - fit.criterion,
            fit.chi_square,
            dict(zip(fit.labels, fit.values.tolist(), strict=True)),
            fit.status,
        )
        for fit in fits
    ]
    return tuple(sorted(rows, key=lambda row: -row.gain))


def screened(
    misfit: WeightedMisfit, candidate: EffectCandidate, beside: EffectFit
) -> tuple[float, EffectCandidate]:
    """The expected fall of χ² if the best start is scaled to fit best, and the best starts.

    Returns the fall and the candidate with its best starts so scaled.
    """
    changes = misfit.noise.noise_units(misfit.start_changes(candidate))
    basis = np.linalg.qr(misfit.noise.decorrelated(beside.slopes.T).T)[0]
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
    best = np.argsort(gains)[::-1][:2]
    starts = tuple(_scaled(candidate, int(moves[k]), float(factor[k])) for k in best)
    return float(np.max(gains)), candidate._replace(starts=starts)


def screened_pairs(
    misfit: WeightedMisfit, candidates: Sequence[EffectCandidate]
) -> list[tuple[float, EffectCandidate, EffectCandidate]]:
    """The expected fall of Schwarz's criterion if starts of two effects are scaled to fit best.

    Of every two effects the best starts, so scaled; the best pair first. No effect is in more
    than three pairs: a strong one would be in all of them.
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
    left = np.maximum(1 - across**2, 1e-3)  # of changes that are less alike
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
        if kinds in seen or times[list(kinds)].max() >= 3:
            continue
        seen.add(kinds)
        times[list(kinds)] += 1
        one, two = (
            effect._replace(starts=(_scaled(effect, int(which[k]), float(factor[k, other])),))
            for effect, k, other in ((candidates[kinds[0]], i, j), (candidates[kinds[1]], j, i))
        )
        found.append((float(gain[i, j]), one, two))
    return found


def _scaled(candidate: EffectCandidate, start: int, factor: float) -> tuple[float, ...]:
    """A start scaled so that its change has a factor."""
    strength, *shape = candidate.starts[start]
    # Those of second order change as the square of their strength, whatever its sign.
    times = float(np.sqrt(abs(factor))) if candidate.strength_order > 1 else factor
    times = float(np.clip(abs(times), 0.1, 10.0)) * (-1.0 if times < 0 else 1.0)
    return (strength * times, *shape)


def detection_limits(
    misfit: WeightedMisfit, fit: EffectFit, scales: MotionScales, excluded: Collection[str]
) -> dict[str, float]:
    """The least strength of every further effect that would have been detected.

    By parameter, in its own unit. Not given for the effects of the answer, for those `excluded`
    from the search, and for what the data do not show at all.
    """
    limits = {}
    for kind in EFFECTS:
        if kind in excluded or kind in fit.kinds or not EFFECTS[kind].searched:
            continue
        tried = candidate(kind, scales)
        change = misfit.first_change(tried)
        square = misfit.chi_square(change)
        if not square > 0:
            continue
        need = priors.DETECTED + len(tried.unit) * np.log(misfit.n_rows)
        power = 2 if misfit.predictions.chosen.orders else 2 * tried.strength_order
        name = f"{kind}.{effect_parameters(kind)[0]}"
        limit = float(abs(tried.starts[0][0]) * (need / square) ** (1 / power))
        limits[name] = _corrected(misfit, tried, limit, need)
    return limits


def _corrected(misfit: WeightedMisfit, one: EffectCandidate, limit: float, need: float) -> float:
    """A limit corrected by trials at it where sizes are compared: they are not linear in it."""
    if not misfit.predictions.sizes.alone.any():
        return limit
    first, *shape = one.starts[0]
    for _ in range(4):
        start = (float(np.copysign(limit, first)), *shape)
        rows = unfitted(misfit, one._replace(starts=(start,))).rows
        square = misfit.chi_square(rows - misfit.base)
        if not 0 < square < np.inf:
            break
        # χ² grows with a power between the second and the fourth.
        limit *= float(np.clip(need / square, 0.01, 100.0)) ** (1 / 3)
    return limit


def beyond_data(effect: type[AbstractEffect], limit: float, scales: MotionScales | None) -> bool:
    """Whether an effect at its detection limit would exceed all that was measured ten times.

    Arguments: `limit` of its strength, in its own unit; `scales` of the measured motions, without
    which relative strengths alone are judged.
    """
    unit = next(iter(effect.parameters().values())).unit
    if not np.isfinite(limit) or (unit == "1" and limit > priors.BEYOND_DATA):
        return True
    starts = [] if scales is None else starts_of(effect, scales)
    if not starts or not starts[0][0]:
        return False
    shape = shape_of(effect)
    order = 1 if shape is None else shape.strength_order
    return bool(VISIBLE_CHANGE * (limit / abs(starts[0][0])) ** order > priors.BEYOND_DATA)
