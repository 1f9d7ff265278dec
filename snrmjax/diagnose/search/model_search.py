"""Which effects the data ask for, and which others they cannot tell from them."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from snrmjax.diagnose.misfit.candidates import CLOSE, LIKE_A_MODE, Candidate, Scales, candidate
from snrmjax.diagnose.misfit.effect_fit import Bench, Fit, unlikely
from snrmjax.diagnose.search.screening import foretold, foretold_pairs
from snrmjax.numerics.blocks import over_cores

DETECTED = 10.0  # of the criterion: what an effect must gain to be believed
AS_GOOD = 6.0  # of the criterion: what separates an effect from those it may be
_PROMISING = 40.0  # of the criterion: within it a candidate is weighed anew
_DOUBTFUL = 0.05  # probability of a fit below which pairs without the best one are fitted too
_REFUTED = 1e-3  # probability of a pair below which a third effect is looked for
_PAIRS = 8  # that are fitted from their own starts
_ONE = 2  # parameters of one effect; one with more is weighed against two effects
# Candidates are fitted when a start of theirs would lower χ² by so much, beyond the first few by
# such a share of what the best would.
_TRIED, _WORTH, _SHARE = 8, 4.0, 0.25
_MOST = 3  # effects of an answer
_SHARE_OF_SIZES = 0.02  # where sizes alone are compared, which are not linear in an effect


class Row(NamedTuple):
    """A candidate of one step, as a report shows it."""

    kind: str
    gain: float  # of the criterion over what was there before
    chi_square: float
    parameters: dict[str, float]


class Named(NamedTuple):
    """What the data ask for."""

    bench: Bench  # weighed with the answer
    fit: Fit
    nothing: Fit
    classes: tuple[tuple[str, ...], ...]  # of every effect, itself first
    table: tuple[tuple[Row, ...], ...]  # of every step

    @property
    def p_value(self) -> float:
        """Of the misfit that is left."""
        freedom = self.bench.n_rows - len(self.fit.values)
        return unlikely(self.fit.chi_square, freedom)


def named(bench: Bench, scales: Scales, kinds: tuple[str, ...]) -> Named:
    """Add effects one after the other while the criterion asks for them, three at most.

    A linear mode close by has three numbers of its own and would follow a part of most laws: it
    is no candidate, but what it may have caused is compared with it.
    """
    every = {kind: candidate(kind, scales) for kind in kinds}
    close = every.pop(CLOSE, None)
    found = _searched(bench, every)
    return found if close is None else _questioned(found, close, every)


def _questioned(found: Named, close: Candidate, every: dict[str, Candidate]) -> Named:
    """The answer, unless a close mode is a better one; where it is as good, it is another reading.

    It is asked in place of all that was found, in place of what acts like it, and beside what does
    not fit. Nothing is asked where nothing was found, nor of a single nonlinearity that fits: a
    linear mode does the same at every level.
    """
    bench, fit = found.bench, found.fit
    alike = [kind for kind in fit.kinds if kind in LIKE_A_MODE]
    others = [kind for kind in fit.kinds if kind not in LIKE_A_MODE]
    refuted = _is_below(bench, fit, _REFUTED)
    fits_by_itself = len(others) == len(fit.kinds) == 1 and not refuted
    if not fit.kinds or fits_by_itself or bench.predictions.sizes.alone.any():
        return found
    jobs = [(close, found.nothing)]
    if alike and others:
        jobs.append((close, _only(bench, every, fit, others)))
    if refuted and len(fit.kinds) < _MOST:
        jobs.append((close, fit))
    fits = [one for one in bench.all_fitted(jobs) if np.isfinite(one.chi_square)]
    if not fits:
        return found
    best = _simplest(bench, fits)
    gain, table = _gain(bench, fit, best), (*found.table, _table(bench, found.nothing, [best]))
    if gain > AS_GOOD:
        return _replaced(found._replace(table=table), close, every, best)
    found = found._replace(table=table)
    if gain < -AS_GOOD or set(fit.kinds) <= set(best.kinds):
        return found
    place = fit.kinds.index(alike[0]) if alike else 0
    wider = (*found.classes[place], close.kind)
    classes = tuple(wider if k == place else own for k, own in enumerate(found.classes))
    return found._replace(classes=classes)


def _replaced(found: Named, close: Candidate, every: dict[str, Candidate], best: Fit) -> Named:
    """The answer with a close mode, weighed with it; each class of what stays is tried beside it.

    The one before where the new one's own way of passing on errors refutes it.
    """
    bench, pool = found.bench.reweighed(best), every | {close.kind: close}
    beside = _only(bench, pool, best, best.kinds[:-1])
    mine = bench.fitted(_where(pool, best, close.kind), beside)
    if _is_below(bench, mine, _REFUTED) and found.p_value > _REFUTED:
        return found
    classes, table = [], list(found.table)
    for kind in best.kinds[:-1]:
        rivals = found.classes[found.fit.kinds.index(kind)][1:]
        rest = _only(bench, pool, mine, [other for other in mine.kinds if other != kind])
        jobs = [(_where(pool, mine, kind), rest)]
        jobs += [(every[name], rest) for name in rivals if name not in rest.kinds]
        fits = bench.all_fitted(jobs) if rivals else []
        classes.append(_class(bench, fits, kind, at=-1) if rivals else (kind,))
        if rivals:
            table.append(_table(bench, rest, fits))
    return Named(bench, mine, bench.nothing(), (*classes, (close.kind,)), tuple(table))


def _only(bench: Bench, every: dict[str, Candidate], fit: Fit, kinds: Sequence[str]) -> Fit:
    """Some of the effects of a fit by themselves."""
    found = bench.nothing()
    for kind in kinds:
        found = bench.fitted(_where(every, fit, kind), found)
    return found


def _searched(bench: Bench, every: dict[str, Candidate]) -> Named:
    before = bench.nothing()
    bench, singles, rows = _tried(bench, every, before)
    nothing = bench.nothing()
    table = [rows]
    best = _simplest(bench, singles) if singles else nothing
    if _gain(bench, nothing, best) <= DETECTED:
        return Named(bench, nothing, nothing, (), tuple(table))
    pairs = bench.all_fitted([(c, best) for c in _promising(bench, every, best)])
    twins: list[Fit] = []
    if len(best.values) > _ONE:  # two simple effects may do what one with many parameters does
        twins = _pairs(bench, every, most=len(best.values))
    if _is_below(bench, best, _DOUBTFUL):
        pairs += _pairs(bench, every)
    lowest = min(singles, key=lambda fit: fit.criterion(bench.n_rows))
    pair = min(pairs, key=lambda fit: fit.criterion(bench.n_rows), default=lowest)
    single = _gain(bench, lowest, pair) <= DETECTED
    of_one = Named(bench, best, nothing, (_class(bench, singles, best.kinds[0]),), tuple(table))
    if single:
        as_simple = _simplest(bench, [best, *twins])
        if as_simple is best:
            return of_one
        pair = as_simple
    bench = bench.reweighed(pair)
    nothing = bench.nothing()
    alone = [_alone(bench, every, kind, pair) for kind in pair.kinds]
    simple = min(alone, key=lambda fit: fit.criterion(bench.n_rows))
    if _gain(bench, simple, bench.fitted(*_rest(every, simple, pair))) <= DETECTED:
        # What two seemed to be is one that no start had come near to.
        others = [f for f in singles if f.kinds != simple.kinds]
        fits = bench.all_fitted([(_from(every, f), nothing) for f in others])
        one = _simplest(bench, [simple, *fits])
        answers = (_class(bench, [simple, *fits], one.kinds[0]),)
        return Named(bench, one, nothing, answers, tuple(table))
    # Each is chosen anew beside the other: the first one beside the second, then the reverse.
    classes: list[tuple[str, ...]] = []
    kind, other = pair.kinds[0], alone[1]
    for place in range(2):
        rivals = [c for c in _promising(bench, every, other) if c.kind != kind]
        fits = bench.all_fitted([(c, other) for c in rivals])
        # Beside the other one fitted alone the pair itself may be far away.
        begun = bench.at_start(_where(every, pair, other.kinds[0]))
        own = bench.all_fitted([(_where(every, pair, kind), start) for start in (begun, other)])
        fits.append(min(own, key=lambda fit: fit.criterion(bench.n_rows)))
        table.append(_table(bench, other, fits))
        pair = _simplest(bench, fits)
        classes.append(_class(bench, fits, pair.kinds[1], at=1))
        if place == 0:
            kind, chosen = pair.kinds
            other = alone[0] if chosen == alone[0].kinds[0] else _alone(bench, every, chosen, pair)
    if single:  # one effect with more parameters is another reading of both
        best = bench.fitted(_from(every, best))
        if _gain(bench, best, pair) < AS_GOOD and best.kinds[0] not in classes[0]:
            classes[0] = (*classes[0], *best.kinds)
    if _is_below(bench, pair, _REFUTED) and of_one.p_value > _REFUTED:
        return of_one  # weighed with its own way of passing on errors the pair is worse
    if _is_below(bench, pair, _REFUTED):
        thirds = bench.all_fitted([(c, pair) for c in _promising(bench, every, pair)])
        third = min(thirds, key=lambda fit: fit.criterion(bench.n_rows), default=pair)
        if _gain(bench, pair, third) > DETECTED:
            table.append(_table(bench, pair, thirds))
            pair = _simplest(bench, thirds)
            classes.append(_class(bench, thirds, pair.kinds[2], at=2))
    return Named(bench, pair, nothing, tuple(classes), tuple(table))


def _pairs(bench: Bench, every: dict[str, Candidate], most: int | None = None) -> list[Fit]:
    """Fits of the two kinds each that promise most, from starts of their own.

    With at most so many parameters.
    """
    promised = [
        (one, two)
        for _, one, two in foretold_pairs(bench, list(every.values()))
        if most is None or len(one.unit) + len(two.unit) <= most
    ]
    return bench.all_fitted([(two, bench.at_start(one)) for one, two in promised[:_PAIRS]])


def _is_below(bench: Bench, fit: Fit, probability: float) -> bool:
    return unlikely(fit.chi_square, bench.n_rows - len(fit.values)) < probability


def _promising(bench: Bench, every: dict[str, Candidate], before: Fit) -> list[Candidate]:
    """The candidates of which one start, scaled, would explain most of what is left.

    Starts are coarse: what explains a quarter of what the best one explains may yet win.
    """
    others = [c for kind, c in every.items() if kind not in before.kinds]
    over_cores(bench.started, others)  # many short programs
    changes = [foretold(bench, c, before) for c in others]
    changes.sort(key=lambda pair: -pair[0])
    share = _SHARE_OF_SIZES if bench.predictions.sizes.alone.any() else _SHARE
    least = max(_WORTH, share * max((gain for gain, _ in changes), default=0.0))
    worth = [_WORTH if n < _TRIED else least for n in range(len(changes))]
    return [c for (gain, c), need in zip(changes, worth, strict=True) if gain > need]


def _tried(
    bench: Bench, every: dict[str, Candidate], before: Fit
) -> tuple[Bench, list[Fit], tuple[Row, ...]]:
    """Candidates, the promising ones weighed with the best one's way of passing on errors.

    Returns all of them as rows for a report too, in the weighing that all share.
    """
    fits = bench.all_fitted([(c, before) for c in _promising(bench, every, before)])
    fits = [fit for fit in fits if np.isfinite(fit.chi_square)]
    rows = _table(bench, before, fits)
    if not fits:
        return bench, [], rows
    best = min(fits, key=lambda fit: fit.criterion(bench.n_rows))
    if _gain(bench, before, best) <= DETECTED:
        return bench, fits, rows
    least = best.criterion(bench.n_rows)
    again = bench.reweighed(best)
    reach = least + max(_PROMISING, 0.5 * best.chi_square)
    near = [fit for fit in fits if fit.criterion(bench.n_rows) < reach]
    nothing = again.nothing()
    return again, again.all_fitted([(_from(every, fit), nothing) for fit in near]), rows


def _also_from(one: Candidate, pair: Fit) -> Candidate:
    """A candidate that also begins where it stands in a pair."""
    return one._replace(starts=(*one.starts, pair.of_kind(one.kind)))


def _where(every: dict[str, Candidate], pair: Fit, kind: str) -> Candidate:
    """A candidate that begins where it stands in a pair."""
    return every[kind]._replace(starts=(pair.of_kind(kind),))


def _alone(bench: Bench, every: dict[str, Candidate], kind: str, pair: Fit) -> Fit:
    return bench.fitted(_also_from(every[kind], pair))


def _rest(every: dict[str, Candidate], first: Fit, pair: Fit) -> tuple[Candidate, Fit]:
    """The other one of a pair, and what it is fitted beside."""
    (kind,) = set(pair.kinds) - set(first.kinds)
    return _also_from(every[kind], pair), first


def _from(every: dict[str, Candidate], fit: Fit) -> Candidate:
    """A candidate that begins where a fit to it ended."""
    return every[fit.kinds[-1]]._replace(starts=(tuple(fit.values.tolist()),))


def _gain(bench: Bench, before: Fit, after: Fit) -> float:
    return before.criterion(bench.n_rows) - after.criterion(bench.n_rows)


def _simplest(bench: Bench, fits: list[Fit]) -> Fit:
    """Of the fits that are about as good as the best, one with the fewest parameters.

    A further mode or a threshold can be laid where chance bends the data; no criterion that
    counts parameters charges for the choice of place.
    """
    least = min(fit.criterion(bench.n_rows) for fit in fits)
    near = [fit for fit in fits if fit.criterion(bench.n_rows) < least + AS_GOOD]
    return min(near, key=lambda fit: (len(fit.values), fit.criterion(bench.n_rows)))


def _class(bench: Bench, fits: list[Fit], kind: str, at: int = 0) -> tuple[str, ...]:
    """The kinds that cannot be told from one, itself first."""
    order = sorted(fits, key=lambda fit: fit.criterion(bench.n_rows))
    least = order[0].criterion(bench.n_rows)
    near = [f.kinds[at] for f in order if f.criterion(bench.n_rows) < least + AS_GOOD]
    return (kind, *(name for name in near if name != kind))


def _table(bench: Bench, before: Fit, fits: list[Fit]) -> tuple[Row, ...]:
    rows = [
        Row(
            fit.kinds[-1],
            _gain(bench, before, fit),
            fit.chi_square,
            dict(zip(fit.labels, fit.values.tolist(), strict=True)),
        )
        for fit in fits
    ]
    return tuple(sorted(rows, key=lambda row: -row.gain))
