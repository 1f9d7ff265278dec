"""Hypotheses that can count: laws alone, in pairs and more, with remainders of every size.

Pairs that cannot reach the best answer, as ½ bᵀS⁻¹b bounds them, are left out; three and more laws
go on from the best of fewer.
"""

import functools
import itertools
from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.optimize import minimize
from scipy.special import logsumexp

from snrmjax.diagnose import priors
from snrmjax.diagnose.naming.columns import Column, hypothesis_columns
from snrmjax.diagnose.naming.evidence import (
    HarmonicSums,
    LawSums,
    sizes_of_remainders,
)
from snrmjax.diagnose.naming.readings import Readings
from snrmjax.diagnose.naming.rows import (
    AS_CURVES_LEAVE,
    Cell,
    LevelSizes,
    Problem,
    RowBlock,
    Sizes,
    problem_of,
)
from snrmjax.identify.test_model.priors import LEVELS

_ROUNDS = 3  # of finer shapes
_LAWS = 4  # sets of laws, beside which errors of levels are found again
_UNSEEN = 1e6  # nats, where one of the laws is not seen beside the others
_LEAST_OF_LEVELS = np.log(0.05)  # ln of how much smaller these may be
_WORTH = 1.0  # nats, from which on they are worth another set of hypotheses
_COARSE = 40.0  # nats that a coarse shape may lack
_REACH = 16.0  # nats below the best, down to which a column is kept while shapes are refined
_COUNTS = 0.02  # probability from which on a shape is divided
_GONE_ON = 4  # sets of laws, from which those of one more go on
_LEAST = 8.0  # of ln p below the most probable answer: what is less likely is left out


def best_hypotheses(readings: Readings, kinds: Iterable[str]) -> tuple[Problem, list[Cell]]:
    """All hypotheses that can count, the most probable first; their shapes as fine as needed."""
    problem = _with_likeliest_length(readings, hypothesis_columns(readings, kinds))
    for _ in range(_ROUNDS):
        cells, alone = _weighed(problem, 2, _REACH)
        counts = _worth_dividing(problem, cells, alone)
        if not counts:
            break
        kept = {*_best_of_kinds(problem, alone), *(k for cell in cells for k in cell.columns)}
        finer = [one for k in counts for one in problem.columns[k].divided(readings)]
        left = [problem.columns[k] for k in sorted(kept - {*counts})]
        problem = problem.with_columns([*left, *finer])
    problem = _with_likeliest_length(readings, problem.columns)
    cells = hypotheses_of(problem)
    beside_laws = with_levels_of_laws(problem, cells)
    if beside_laws is problem:
        return problem, cells
    return beside_laws, hypotheses_of(beside_laws)


def with_levels_of_laws(problem: Problem, cells: list[Cell]) -> Problem:
    """The problem with the level errors that are likeliest beside laws, too.

    Smooth curves know no laws: what changes steeply with amplitude, such as friction, is half taken
    for errors of levels, and these would hide it. The likeliest of the hypotheses say what is left.
    """
    states = problem.readings.posterior.states
    free = np.array(states.level_std) == 0
    if states.n_levels < 2 or not free.any():
        return problem
    best: dict[tuple[int, ...], Cell] = {}
    for cell in cells:
        if cell.columns:
            best.setdefault(tuple(sorted(cell.columns)), cell)
    likely = itertools.islice(best.values(), _LAWS)
    found = [_levels_beside(problem, cell, free) for cell in likely]
    gained, levels, log_prior = max(found, default=(0.0, AS_CURVES_LEAVE, 0.0))
    if gained < _WORTH:
        return problem
    whole = float(np.logaddexp(0.0, log_prior))
    either = (AS_CURVES_LEAVE, -whole), (levels, log_prior - whole)
    return problem._replace(levels=either)


def _levels_beside(
    problem: Problem, cell: Cell, free: Bool[np.ndarray, " kind"]
) -> tuple[float, LevelSizes, float]:
    """Sizes of level errors beside laws: nats that they gain, the sizes, and ln of their prior."""
    alone = problem.with_columns([problem.columns[k] for k in cell.columns])
    own, *others = alone.blocks
    higher = [
        LawSums.of(alone.columns, block, (size,))
        for block, size in zip(others, cell.sizes[2:], strict=True)
    ]
    scale = np.array([prior.scale for prior in LEVELS])
    over = (problem.readings.level_std / scale)[free]

    def prior(logs: np.ndarray) -> float:
        return float(np.sum(logs) - 0.5 * np.sum((over * np.exp(logs)) ** 2 - over**2))

    def levels_at(logs: np.ndarray) -> LevelSizes:
        values = np.ones(4)
        values[free] = np.exp(logs)
        gain, phase, stiffness, damping = values.tolist()
        return gain, phase, stiffness, damping

    def fall(logs: np.ndarray) -> float:
        sums = LawSums.of(alone.columns, own, cell.sizes[:2], (levels_at(logs), prior(logs)))
        whole = functools.reduce(LawSums.with_rows_of, higher, sums)
        if len(cell.columns) == 1:
            return -whole.base - float(whole.gains(whole.b, np.diag(whole.gram), 1)[0])
        both = whole.together(tuple(range(len(cell.columns))))
        return _UNSEEN if both is None else -both.log_evidence

    start = np.zeros(np.count_nonzero(free))
    ends = [(_LEAST_OF_LEVELS, -_LEAST_OF_LEVELS)] * len(start)
    best = minimize(fall, start, method="L-BFGS-B", bounds=ends, options={"maxiter": 20})
    return fall(start) - float(best.fun), levels_at(best.x), prior(best.x)


def _with_likeliest_length(readings: Readings, columns: list[Column]) -> Problem:
    """The problem with remainders that change over the likeliest amplitudes, by single laws."""
    problems = (problem_of(readings, columns, length) for length in priors.REMAINDER_LENGTHS)
    return max(problems, key=_log_evidence_of_singles)


def _worth_dividing(
    problem: Problem, cells: list[Cell], alone: Float[np.ndarray, " column"]
) -> list[int]:
    """Columns whose shape counts: of every kind the best, and all that are probable."""
    mass = np.zeros(len(problem.columns))
    for cell in cells:
        mass[list(cell.columns)] += np.exp(cell.log_evidence - cells[0].log_evidence)
    whole = sum(np.exp(cell.log_evidence - cells[0].log_evidence) for cell in cells)
    best = [k for k in _best_of_kinds(problem, alone) if alone[k] > cells[0].log_evidence - _COARSE]
    counts = {*best, *np.flatnonzero(mass > _COUNTS * whole).tolist()}
    return [k for k in sorted(counts) if problem.columns[k].widths]


def _best_of_kinds(problem: Problem, alone: Float[np.ndarray, " column"]) -> list[int]:
    """Of every kind the column that is most probable alone."""
    best: dict[str, int] = {}
    for k in np.argsort(-alone, kind="stable").tolist():
        best.setdefault(problem.columns[k].kind, k)
    return list(best.values())


def hypotheses_of(problem: Problem) -> list[Cell]:
    """The hypotheses of a problem that can count, the most probable first."""
    return _weighed(problem)[0]


class _Grid(NamedTuple):
    """Sums over rows for remainders of every size: of fundamentals, and of all other harmonics."""

    own: list[LawSums]
    higher: list[LawSums | None]

    @classmethod
    def of(cls, problem: Problem, every: int) -> "_Grid":
        """With every size of remainders, or some: `every` second one."""
        sizes = sizes_of_remainders(every)
        own, *others = problem.blocks
        sums = [
            LawSums.of(problem.columns, own, both, levels)
            for both in itertools.product(sizes, sizes)
            for levels in problem.levels
        ]
        return cls(sums, _of_harmonics(problem.columns, others, every))

    def singles(self) -> Iterator[tuple[list[Cell], np.ndarray]]:
        """Hypotheses without a law, and ln evidence of every law alone, by combination of sizes."""
        of_higher = HarmonicSums.of(self.higher)
        for own in self.own:
            sizes = [own.sizes if one is None else (*own.sizes, *one.sizes) for one in self.higher]
            base, value = of_higher.singles(own)
            none = [Cell(v, (), s, own.levels) for v, s in zip(base.tolist(), sizes, strict=True)]
            yield none, value

    def coarse(self) -> list[LawSums]:
        """Of fundamentals, for the sizes that several laws are tried with."""
        few = {*sizes_of_remainders(2)}
        return [own for own in self.own if {*own.sizes} <= few]


def _log_evidence_of_singles(problem: Problem) -> float:
    """ln of the probability of the rows with one law or none."""
    each = [
        np.append(value, [cell.log_evidence for cell in none])
        for none, value in _Grid.of(problem, 2).singles()
    ]
    return float(logsumexp(np.concatenate(each)))


def _weighed(
    problem: Problem, every: int = 1, reach: float = _LEAST
) -> tuple[list[Cell], Float[np.ndarray, " column"]]:
    """Hypotheses that can count, and ln evidence of every column alone with its best remainders.

    With every size of remainders, or some: `every` second one. Down to `reach` below the most
    probable, in nats.
    """
    grid = _Grid.of(problem, every)
    cells: list[Cell] = []
    alone = np.full(len(problem.columns), -np.inf)
    for none, value in grid.singles():
        alone = np.maximum(alone, np.max(value, axis=0, initial=-np.inf))
        cells += none
        best = max(cell.log_evidence for cell in cells)
        for one, k in np.argwhere(value > best - reach).tolist():
            cells.append(none[one]._replace(log_evidence=float(value[one, k]), columns=(k,)))
    best = max(cell.log_evidence for cell in cells)
    prior = grid.own[0].prior_of_pairs()
    bounds = [0.0 if other is None else other.most() for other in grid.higher]
    for own in grid.coarse():
        most = own.most() + prior
        for other, bound in zip(grid.higher, bounds, strict=True):
            places = np.nonzero(most + bound > best - reach)
            if places[0].size:
                whole = own if other is None else own.with_rows_of(other)
                some = whole.pairs(places[0], places[1], best - reach)
                best = max([best, *(cell.log_evidence for cell in some)])
                cells += some
    for n_laws in range(3, len(priors.SIZES)):
        some = _with_one_more(cells, grid, n_laws, best - reach)
        cells += some
        if max((cell.log_evidence for cell in some), default=-np.inf) < best:
            break
        best = max(cell.log_evidence for cell in some)
    kept = [cell for cell in cells if cell.log_evidence > best - reach]
    return sorted(kept, key=lambda cell: -cell.log_evidence), alone


def _with_one_more(cells: list[Cell], grid: _Grid, n_laws: int, least: float) -> list[Cell]:
    """The likeliest sets of one law less with every further law, where as probable as `least`.

    With remainders of every size: one law more may leave far less than the fewer do.
    """
    fewer: dict[tuple[int, ...], Cell] = {}
    for cell in sorted(cells, key=lambda cell: -cell.log_evidence):
        if len(cell.columns) == n_laws - 1:
            fewer.setdefault(tuple(sorted(cell.columns)), cell)
    found: dict[tuple[tuple[int, ...], Sizes, LevelSizes], Cell] = {}
    for one in itertools.islice(fewer.values(), _GONE_ON):
        (other,) = (h for h in grid.higher if (() if h is None else h.sizes) == one.sizes[2:])
        for own in grid.coarse():
            whole = own if other is None else own.with_rows_of(other)
            again = whole.together(one.columns)
            for cell in () if again is None else whole.with_one_more(again, least):
                found.setdefault((tuple(sorted(cell.columns)), cell.sizes, cell.levels), cell)
    return list(found.values())


def _of_harmonics(
    columns: list[Column], blocks: list[RowBlock], every: int
) -> "list[LawSums | None]":
    """What counts of all other harmonics, for remainders of every combination of sizes."""
    if not blocks:
        return [None]
    sizes = [(size,) for size in priors.HARMONIC_REMAINDERS[::every].tolist()]
    each = [[LawSums.of(columns, block, size) for size in sizes] for block in blocks]
    return [
        functools.reduce(lambda one, other: one.with_rows_of(other), some)
        for some in itertools.product(*each)
    ]
