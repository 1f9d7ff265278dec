"""Search of hypotheses: laws alone, in pairs and more, over a grid of remainders.

Pairs whose bound ½ bᵀS⁻¹b is below the best answer are left out; sets of three and more laws are
grown from the best smaller ones.
"""

import functools
import itertools
from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool
from scipy.optimize import minimize
from scipy.special import logsumexp

from snrmjax.diagnose import priors
from snrmjax.diagnose.kinds.registry import hypothesis_of
from snrmjax.diagnose.naming.columns import Column, hypothesis_columns
from snrmjax.diagnose.naming.evidence import HarmonicSums, LawSums, remainder_stds
from snrmjax.diagnose.naming.rows import (
    WITHOUT_LAWS,
    Cell,
    LevelStds,
    Problem,
    RemainderStds,
    RowBlock,
    problem_of,
    solved,
)
from snrmjax.diagnose.readings import Readings
from snrmjax.identify.test_model.priors import LEVELS

_ROUNDS = 3  # of refined shapes and of strengths
_COARSE = 40.0  # nats that a coarse shape may be below the best
_REACH = 16.0  # nats below the best within which a column is kept while shapes are refined
_RIVAL = 25.0  # nats by which an inexact describing function may lower a law's evidence
_TRIED = 3  # columns of a kind that are made exact for their strengths
_COUNTS = 0.02  # probability from which on a shape is refined
_EXTENDED = 4  # sets of laws that are extended by one more
_LEAST = 8.0  # nats below the most probable answer within which hypotheses are kept
_REFITTED = 4  # sets of laws with which level errors are estimated again
_WORTH = 1.0  # nats gained, from which on hypotheses are compared with these as well
_SMALLEST = np.log(0.05)  # ln of the factor by which level errors may become smaller
_UNSEEN = 1e6  # nats lost where one of the laws is not significant next to the others


def best_hypotheses(readings: Readings, kinds: Iterable[str]) -> tuple[Problem, list[Cell]]:
    """All relevant hypotheses, the most probable first, with refined shapes."""
    problem = _with_likeliest_length(readings, hypothesis_columns(readings, kinds))
    for _ in range(_ROUNDS):
        cells, alone = _compared(problem, 2)
        near = [cell for cell in alone if cell.log_evidence > cells[0].log_evidence - _REACH]
        of_kinds = _best_of_kinds(problem, alone)
        problem = _exact_at_strengths(problem, [*cells, *alone])
        counts = _worth_dividing(problem, cells, of_kinds)
        if not counts:
            break
        kept = {k for cell in (*of_kinds, *near, *cells) for k in cell.columns}
        finer = [one for k in counts for one in problem.columns[k].divided(readings)]
        left = [problem.columns[k] for k in sorted(kept - {*counts})]
        problem = problem.with_columns([*left, *finer])
    problem = _with_likeliest_length(readings, problem.columns)
    cells = hypotheses_of(problem)
    with_laws = _with_level_errors_of_laws(problem, cells)
    if with_laws is problem:
        return problem, cells
    return with_laws, hypotheses_of(with_laws)


def _exact_at_strengths(problem: Problem, cells: list[Cell]) -> Problem:
    """The problem with columns exact for their strengths in the most probable hypotheses.

    Of every kind at least `_TRIED` columns: far from the strength a column is misleading.
    """
    best: dict[int, Cell] = {}
    tried: dict[str, int] = {}
    least = cells[0].log_evidence - _LEAST
    for cell in sorted(cells, key=lambda cell: -cell.log_evidence):
        for k in cell.columns:
            kind = problem.columns[k].kind
            if hypothesis_of(kind).unit is None or k in best:
                continue
            if cell.log_evidence > least or tried.get(kind, 0) < _TRIED:
                best[k] = cell
                tried[kind] = tried.get(kind, 0) + 1
    if not best:
        return problem
    for _ in range(_ROUNDS):
        columns = list(problem.columns)
        for k, cell in best.items():
            strength = float(solved(problem, cell).mean[cell.columns.index(k)])
            columns[k] = columns[k].exact_at(problem.readings, strength)
        problem = problem.with_columns(columns)
    return problem


def _with_level_errors_of_laws(problem: Problem, cells: list[Cell]) -> Problem:
    """The problem with an alternative: level errors as estimated together with laws.

    Smooth curves attribute half of a steep change, such as that of friction, to errors of the
    levels, which would then hide the law. The best hypotheses estimate them again.
    """
    states = problem.readings.posterior.states
    free = np.array(states.level_std) == 0
    if states.n_levels < 2 or not free.any():
        return problem
    best: dict[tuple[int, ...], Cell] = {}
    for cell in cells:
        if cell.columns:
            best.setdefault(tuple(sorted(cell.columns)), cell)
    likely = itertools.islice(best.values(), _REFITTED)
    refitted = [_level_errors_with(problem, cell, free) for cell in likely]
    gained, stds, log_prior = max(refitted, default=(0.0, WITHOUT_LAWS, 0.0))
    if gained < _WORTH:
        return problem
    whole = float(np.logaddexp(0.0, log_prior))
    both = (WITHOUT_LAWS, -whole), (stds, log_prior - whole)
    return problem._replace(level_stds=both)


def _level_errors_with(
    problem: Problem, cell: Cell, free: Bool[np.ndarray, " kind"]
) -> tuple[float, LevelStds, float]:
    """Level errors with the laws of a hypothesis: nats gained, their 1σ, and ln of their prior."""
    alone = problem.with_columns([problem.columns[k] for k in cell.columns])
    own, *others = alone.blocks
    higher = [
        LawSums.of(alone.columns, block, (std,))
        for block, std in zip(others, cell.remainder_std[2:], strict=True)
    ]
    scale = np.array([prior.scale for prior in LEVELS])
    relative = (problem.readings.level_std / scale)[free]

    def log_prior(logs: np.ndarray) -> float:
        return float(np.sum(logs) - 0.5 * np.sum((relative * np.exp(logs)) ** 2 - relative**2))

    def stds(logs: np.ndarray) -> LevelStds:
        values = np.ones(4)
        values[free] = np.exp(logs)
        gain, phase, stiffness, damping = values.tolist()
        return gain, phase, stiffness, damping

    def loss(logs: np.ndarray) -> float:
        sums = LawSums.of(alone.columns, own, cell.remainder_std[:2], (stds(logs), log_prior(logs)))
        whole = functools.reduce(LawSums.with_rows_of, higher, sums)
        if len(cell.columns) == 1:
            return -whole.base - float(whole.gains(whole.b, whole.square, 1)[0])
        together = whole.together(tuple(range(len(cell.columns))))
        return _UNSEEN if together is None else -together.log_evidence

    start = np.zeros(np.count_nonzero(free))
    bounds = [(_SMALLEST, -_SMALLEST)] * len(start)
    fit = minimize(loss, start, method="L-BFGS-B", bounds=bounds, options={"maxiter": 20})
    return loss(start) - float(fit.fun), stds(fit.x), log_prior(fit.x)


def _with_likeliest_length(readings: Readings, columns: list[Column]) -> Problem:
    """The problem with the most probable correlation length of remainders, by single laws."""
    problems = (problem_of(readings, columns, length) for length in priors.REMAINDER_LENGTHS)
    return max(problems, key=_log_evidence_of_singles)


def _worth_dividing(problem: Problem, cells: list[Cell], of_kinds: list[Cell]) -> list[int]:
    """Columns to refine: the best of every kind, and all probable ones."""
    weight = np.zeros(len(problem.columns))
    for cell in cells:
        weight[list(cell.columns)] += np.exp(cell.log_evidence - cells[0].log_evidence)
    whole = sum(np.exp(cell.log_evidence - cells[0].log_evidence) for cell in cells)
    least = cells[0].log_evidence - _COARSE
    best = [cell for cell in of_kinds if cell.log_evidence > least]
    counts = {
        *(cell.columns[0] for cell in best),
        *np.flatnonzero(weight > _COUNTS * whole).tolist(),
    }
    return [k for k in sorted(counts) if problem.columns[k].widths]


def _best_of_kinds(problem: Problem, alone: list[Cell]) -> list[Cell]:
    """The column of every kind that is most probable alone."""
    best: dict[str, Cell] = {}
    for cell in sorted(alone, key=lambda cell: -cell.log_evidence):
        best.setdefault(problem.columns[cell.columns[0]].kind, cell)
    return list(best.values())


def hypotheses_of(problem: Problem) -> list[Cell]:
    """The relevant hypotheses of a problem, the most probable first."""
    return _compared(problem)[0]


def with_rivals(problem: Problem, cells: list[Cell]) -> list[Cell]:
    """The first hypothesis, kinds alone that exact changes may make as probable, and the rest."""
    alone = _best_of_kinds(problem, _compared(problem, 2)[1])
    least = cells[0].log_evidence - _RIVAL
    return [cells[0], *(one for one in alone if one.log_evidence > least), *cells[1:]]


class _Grid(NamedTuple):
    """Sums over rows on the grid of remainders: of fundamentals, and of all other harmonics."""

    own: list[LawSums]
    higher: list[LawSums | None]

    @classmethod
    def of(cls, problem: Problem, every: int, *, alone: bool = False) -> "_Grid":
        """With each `every`-th standard deviation of the remainders; `alone`: for single laws."""
        stds, few = remainder_stds(every), {*remainder_stds(2)}
        own, *others = problem.blocks
        sums = [
            LawSums.of(problem.columns, own, both, levels, alone=alone or not {*both} <= few)
            for both in itertools.product(stds, stds)
            for levels in problem.level_stds
        ]
        return cls(sums, _of_harmonics(problem.columns, others, every, alone=alone))

    def singles(self) -> Iterator[tuple[list[Cell], np.ndarray]]:
        """Hypotheses without a law, and ln evidence of every law alone, by combination."""
        of_higher = HarmonicSums.of(self.higher)
        for own in self.own:
            stds = [
                own.remainder_std if one is None else (*own.remainder_std, *one.remainder_std)
                for one in self.higher
            ]
            base, value = of_higher.singles(own)
            pairs = zip(base.tolist(), stds, strict=True)
            yield [Cell(p, (), std, own.level_std) for p, std in pairs], value

    def coarse(self) -> list[LawSums]:
        """Sums of fundamentals on the coarser grid, for several laws."""
        few = {*remainder_stds(2)}
        return [own for own in self.own if {*own.remainder_std} <= few]


def _log_evidence_of_singles(problem: Problem) -> float:
    """ln of the probability of the rows with one law or none."""
    each = [
        np.append(value, [cell.log_evidence for cell in none])
        for none, value in _Grid.of(problem, 2, alone=True).singles()
    ]
    return float(logsumexp(np.concatenate(each)))


def _alone(without: Cell, column: int, log_evidence: float) -> Cell:
    return without._replace(log_evidence=float(log_evidence), columns=(int(column),))


def _compared(
    problem: Problem, every: int = 1, reach: float = _LEAST
) -> tuple[list[Cell], list[Cell]]:
    """Relevant hypotheses, and every column alone with its best remainders.

    With each `every`-th standard deviation of the remainders, and hypotheses within `reach` nats of
    the most probable one.
    """
    grid = _Grid.of(problem, every)
    cells: list[Cell] = []
    alone: dict[int, Cell] = {}
    for none, value in grid.singles():
        cells += none
        best = max(cell.log_evidence for cell in cells)
        for k, one in enumerate(np.argmax(value, axis=0).tolist()):
            if k not in alone or value[one, k] > alone[k].log_evidence:
                alone[k] = _alone(none[one], k, value[one, k])
        cells += [_alone(none[n], k, value[n, k]) for n, k in np.argwhere(value > best - reach)]
    best = max(cell.log_evidence for cell in cells)
    prior = grid.own[0].prior_of_pairs()
    bounds = [0.0 if other is None else other.bound() for other in grid.higher]
    for own in grid.coarse():
        upper = own.bound() + prior
        for other, bound in zip(grid.higher, bounds, strict=True):
            pairs = np.nonzero(upper + bound > best - reach)
            if pairs[0].size:
                whole = own if other is None else own.with_rows_of(other)
                some = whole.pairs(pairs[0], pairs[1], best - reach)
                best = max([best, *(cell.log_evidence for cell in some)])
                cells += some
    for n_laws in range(3, len(priors.EFFECT_COUNTS)):
        some = _with_one_more(cells, grid, n_laws, best - reach)
        cells += some
        if max((cell.log_evidence for cell in some), default=-np.inf) < best:
            break
        best = max(cell.log_evidence for cell in some)
    kept = [cell for cell in cells if cell.log_evidence > best - reach]
    return sorted(kept, key=lambda cell: -cell.log_evidence), list(alone.values())


def _with_one_more(cells: list[Cell], grid: _Grid, n_laws: int, least: float) -> list[Cell]:
    """The best sets of one law less, each with every further law, where above `least`.

    With all remainders: one law more may reduce the remainder by far.
    """
    fewer: dict[tuple[int, ...], Cell] = {}
    for cell in sorted(cells, key=lambda cell: -cell.log_evidence):
        if len(cell.columns) == n_laws - 1:
            fewer.setdefault(tuple(sorted(cell.columns)), cell)
    extended: dict[tuple[tuple[int, ...], RemainderStds, LevelStds], Cell] = {}
    for one in itertools.islice(fewer.values(), _EXTENDED):
        (other,) = (
            h
            for h in grid.higher
            if (() if h is None else h.remainder_std) == one.remainder_std[2:]
        )
        for own in grid.coarse():
            whole = own if other is None else own.with_rows_of(other)
            again = whole.together(one.columns)
            for cell in () if again is None else whole.with_one_more(again, least):
                key = tuple(sorted(cell.columns)), cell.remainder_std, cell.level_std
                extended.setdefault(key, cell)
    return list(extended.values())


def _of_harmonics(
    columns: list[Column], blocks: list[RowBlock], every: int, *, alone: bool
) -> "list[LawSums | None]":
    """Sums of all other harmonics, for all combinations of remainders."""
    if not blocks:
        return [None]
    stds = [(std,) for std in priors.HARMONIC_REMAINDERS[::every].tolist()]
    each = [[LawSums.of(columns, block, std, alone=alone) for std in stds] for block in blocks]
    return [
        functools.reduce(lambda one, other: one.with_rows_of(other), some)
        for some in itertools.product(*each)
    ]
