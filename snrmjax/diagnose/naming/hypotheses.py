"""Search of hypotheses: laws alone, in pairs and more, over a grid of remainders.

Pairs whose bound ½ bᵀS⁻¹b is below the best answer are left out; sets of three and more laws are
grown from the best smaller ones.
"""

import functools
import itertools
from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.special import logsumexp

from snrmjax.diagnose import priors
from snrmjax.diagnose.naming.columns import Column, hypothesis_columns
from snrmjax.diagnose.naming.evidence import (
    HarmonicSums,
    LawSums,
    remainder_stds,
)
from snrmjax.diagnose.naming.readings import Readings
from snrmjax.diagnose.naming.rows import Cell, Problem, RemainderStds, RowBlock, problem_of

_ROUNDS = 3  # of refined shapes
_COARSE = 40.0  # nats that a coarse shape may be below the best
_REACH = 16.0  # nats below the best within which a column is kept while shapes are refined
_COUNTS = 0.02  # probability from which on a shape is refined
_EXTENDED = 4  # sets of laws that are extended by one more
_LEAST = 8.0  # nats below the most probable answer within which hypotheses are kept


def best_hypotheses(readings: Readings, kinds: Iterable[str]) -> tuple[Problem, list[Cell]]:
    """All relevant hypotheses, the most probable first, with refined shapes."""
    problem = _with_likeliest_length(readings, hypothesis_columns(readings, kinds))
    for _ in range(_ROUNDS):
        cells, alone = _compared(problem, 2, _REACH)
        counts = _worth_dividing(problem, cells, alone)
        if not counts:
            break
        kept = {*_best_of_kinds(problem, alone), *(k for cell in cells for k in cell.columns)}
        finer = [one for k in counts for one in problem.columns[k].divided(readings)]
        left = [problem.columns[k] for k in sorted(kept - {*counts})]
        problem = problem.with_columns([*left, *finer])
    problem = _with_likeliest_length(readings, problem.columns)
    return problem, hypotheses_of(problem)


def _with_likeliest_length(readings: Readings, columns: list[Column]) -> Problem:
    """The problem with the most probable correlation length of remainders, by single laws."""
    problems = (problem_of(readings, columns, length) for length in priors.REMAINDER_LENGTHS)
    return max(problems, key=_log_evidence_of_singles)


def _worth_dividing(
    problem: Problem, cells: list[Cell], alone: Float[np.ndarray, " column"]
) -> list[int]:
    """Columns to refine: the best of every kind, and all probable ones."""
    weight = np.zeros(len(problem.columns))
    for cell in cells:
        weight[list(cell.columns)] += np.exp(cell.log_evidence - cells[0].log_evidence)
    whole = sum(np.exp(cell.log_evidence - cells[0].log_evidence) for cell in cells)
    best = [k for k in _best_of_kinds(problem, alone) if alone[k] > cells[0].log_evidence - _COARSE]
    counts = {*best, *np.flatnonzero(weight > _COUNTS * whole).tolist()}
    return [k for k in sorted(counts) if problem.columns[k].widths]


def _best_of_kinds(problem: Problem, alone: Float[np.ndarray, " column"]) -> list[int]:
    """The column of every kind that is most probable alone."""
    best: dict[str, int] = {}
    for k in np.argsort(-alone, kind="stable").tolist():
        best.setdefault(problem.columns[k].kind, k)
    return list(best.values())


def hypotheses_of(problem: Problem) -> list[Cell]:
    """The relevant hypotheses of a problem, the most probable first."""
    return _compared(problem)[0]


class _Grid(NamedTuple):
    """Sums over rows on the grid of remainders: of fundamentals, and of all other harmonics."""

    own: list[LawSums]
    higher: list[LawSums | None]

    @classmethod
    def of(cls, problem: Problem, every: int) -> "_Grid":
        """With each `every`-th standard deviation of the remainders."""
        stds = remainder_stds(every)
        own, *others = problem.blocks
        sums = [LawSums.of(problem.columns, own, s) for s in itertools.product(stds, stds)]
        return cls(sums, _of_harmonics(problem.columns, others, every))

    def singles(self) -> Iterator[tuple[list[RemainderStds], np.ndarray, np.ndarray]]:
        """Remainders, and ln evidence without a law and of every law alone, by combination."""
        of_higher = HarmonicSums.of(self.higher)
        for own in self.own:
            stds = [
                own.remainder_std if one is None else (*own.remainder_std, *one.remainder_std)
                for one in self.higher
            ]
            yield stds, *of_higher.singles(own)

    def coarse(self) -> list[LawSums]:
        """Sums of fundamentals on the coarser grid, for several laws."""
        few = {*remainder_stds(2)}
        return [own for own in self.own if {*own.remainder_std} <= few]


def _log_evidence_of_singles(problem: Problem) -> float:
    """ln of the probability of the rows with one law or none."""
    each = [np.append(value, base) for _, base, value in _Grid.of(problem, 2).singles()]
    return float(logsumexp(np.concatenate(each)))


def _compared(
    problem: Problem, every: int = 1, reach: float = _LEAST
) -> tuple[list[Cell], Float[np.ndarray, " column"]]:
    """Relevant hypotheses, and ln evidence of every column alone with its best remainders.

    With each `every`-th standard deviation of the remainders, and hypotheses within `reach` nats of
    the most probable one.
    """
    grid = _Grid.of(problem, every)
    cells: list[Cell] = []
    alone = np.full(len(problem.columns), -np.inf)
    for stds, base, value in grid.singles():
        alone = np.maximum(alone, np.max(value, axis=0, initial=-np.inf))
        cells += [Cell(float(v), (), s) for v, s in zip(base, stds, strict=True)]
        best = max(cell.log_evidence for cell in cells)
        for one, k in np.argwhere(value > best - reach).tolist():
            cells.append(Cell(float(value[one, k]), (k,), stds[one]))
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
    return sorted(kept, key=lambda cell: -cell.log_evidence), alone


def _with_one_more(cells: list[Cell], grid: _Grid, n_laws: int, least: float) -> list[Cell]:
    """The best sets of one law less, each with every further law, where above `least`.

    With all remainders: one law more may reduce the remainder by far.
    """
    fewer: dict[tuple[int, ...], Cell] = {}
    for cell in sorted(cells, key=lambda cell: -cell.log_evidence):
        if len(cell.columns) == n_laws - 1:
            fewer.setdefault(tuple(sorted(cell.columns)), cell)
    extended: dict[tuple[tuple[int, ...], RemainderStds], Cell] = {}
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
                extended.setdefault((tuple(sorted(cell.columns)), cell.remainder_std), cell)
    return list(extended.values())


def _of_harmonics(
    columns: list[Column], blocks: list[RowBlock], every: int
) -> "list[LawSums | None]":
    """Sums of all other harmonics, for all combinations of remainders."""
    if not blocks:
        return [None]
    stds = [(std,) for std in priors.HARMONIC_REMAINDERS[::every].tolist()]
    each = [[LawSums.of(columns, block, std) for std in stds] for block in blocks]
    return [
        functools.reduce(lambda one, other: one.with_rows_of(other), some)
        for some in itertools.product(*each)
    ]
