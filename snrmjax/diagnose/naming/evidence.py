"""Evidences of laws, alone and in pairs, with remainders of every size, in closed form.

With the sizes of the remainders fixed, rows y = Aθ + e have e ~ N(0, C). All that counts of the
columns A is b = AᵀC⁻¹y and S = AᵀC⁻¹A, from one Cholesky factor; for θ ~ N(0, τ²) evidences are
those of one and two Gaussian numbers, or of their positive half. Pairs that cannot reach the best
answer, as ½ bᵀS⁻¹b bounds them, are left out. Fundamentals and every other harmonic are blocks of
rows that have nothing but the laws in common, so that their b and S add up.
"""

import functools
import itertools
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.linalg import block_diag, cholesky, solve_triangular
from scipy.special import log_ndtr, logsumexp

from snrmjax.diagnose import priors
from snrmjax.diagnose.naming.columns import Column, hypothesis_columns, odds_of
from snrmjax.diagnose.naming.readings import Readings
from snrmjax.model.library.measurement_chain import ForceHarmonics

_ROUNDS = 3  # of finer shapes
_COARSE = 40.0  # nats that a coarse shape may lack
_REACH = 16.0  # nats below the best, down to which a column is kept while shapes are refined
_COUNTS = 0.02  # probability from which on a shape is divided
_LEAST = 8.0  # of ln p below the most probable answer: what is less likely is left out
_KNOTS_A_UNIT = 8  # of ln a
_MOST_KNOTS = 40
_NO_VARIANCE = 1e-8  # of the largest: a function of the remainder that adds nothing
_PRIOR_OF_PAIRS = np.log(priors.SIZES[2]) + 5 * np.log(2)  # at most, with both signs known

Sizes = tuple[float, ...]


class Cell(NamedTuple):
    """One hypothesis: some columns with remainders of some sizes."""

    log_evidence: float  # times the prior
    columns: tuple[int, ...]  # places in `Problem.columns`
    sizes: Sizes  # σ of the remainders of stiffness, damping and every other harmonic


class RowBlock(NamedTuple):
    """Rows that have errors and remainders of their own, made triangular once."""

    rows: Float[np.ndarray, " row"]
    design: Float[np.ndarray, "row unknown"]  # errors, then remainders of size 1
    groups: tuple[int, ...]  # how many unknowns are errors, and functions of every remainder
    directions: Float[np.ndarray, "row direction"]  # of the design, orthogonal
    triangle: Float[np.ndarray, "direction unknown"]
    laws: Float[np.ndarray, "row column"]
    along: Float[np.ndarray, "direction column"]  # laws and, last, the rows
    across: Float[np.ndarray, "column column"]  # Gram matrix of what is left of them

    @classmethod
    def of(
        cls,
        rows: Float[np.ndarray, " row"],
        errors: Float[np.ndarray, "row error"],
        *remainders: Float[np.ndarray, "row function"],
    ) -> "RowBlock":
        """A block without laws."""
        design = np.hstack([errors, *remainders])
        groups = errors.shape[1], *(one.shape[1] for one in remainders)
        none = np.empty((0, 0))
        return cls(rows, design, groups, *np.linalg.qr(design), none, none, none)

    def with_laws(self, laws: Float[np.ndarray, "row column"]) -> "RowBlock":
        """The same with the columns of laws."""
        both = np.column_stack([laws, self.rows])
        along = self.directions.T @ both
        left = both - self.directions @ along
        return self._replace(laws=laws, along=along, across=left.T @ left)

    def variances(self, sizes: Sizes) -> Float[np.ndarray, " unknown"]:
        """Prior variances of the design's unknowns."""
        return np.repeat([1.0, *(size**2 for size in sizes)], self.groups)


class Problem(NamedTuple):
    """Rows, and what can explain them."""

    readings: Readings
    columns: list[Column]
    functions: Float[np.ndarray, "state function"]  # of a remainder of size 1
    blocks: tuple[RowBlock, ...]  # fundamentals, then every other harmonic

    @property
    def parts(self) -> tuple[str, ...]:
        """What of the test may have a remainder."""
        higher = (f"harmonic_{one.order}" for one in self.readings.harmonics)
        return ("stiffness", "damping", *higher)

    def with_columns(self, columns: list[Column]) -> "Problem":
        """The same with other columns."""
        readings = self.readings
        unit = readings.natural_frequency**2
        laws = [readings.whitened(unit * np.array([column.change for column in columns])).T]
        for place, one in enumerate(readings.harmonics):
            higher = np.array([column.higher[place] for column in columns])
            laws.append(one.whitened(unit * higher).T)
        blocks = [block.with_laws(own) for block, own in zip(self.blocks, laws, strict=True)]
        return self._replace(columns=columns, blocks=tuple(blocks))

    def remainders(self, at: Float[np.ndarray, " point"]) -> Float[np.ndarray, "point function"]:
        """The remainder's functions at amplitudes over the largest one."""
        return _functions(self.readings.relative_amplitude, at)


def problem_of(readings: Readings, columns: list[Column]) -> Problem:
    """The problem, made triangular once for all hypotheses."""
    x, natural = readings.relative_amplitude, readings.natural_frequency
    functions = _functions(x, x)
    curves = natural**2 * functions.T
    lossy = 1j * readings.relative_frequency * curves
    remainders = readings.whitened(curves).T, readings.whitened(lossy).T
    blocks = [RowBlock.of(readings.rows, readings.errors, *remainders)]
    for one in readings.harmonics:
        both = np.concatenate([one.whitened(curves), one.whitened(1j * curves)]).T
        blocks.append(RowBlock.of(one.whitened(one.beyond), one.whitened(one.errors).T, both))
    return Problem(readings, [], functions, tuple(blocks)).with_columns(columns)


def _functions(
    measured: Float[np.ndarray, " state"], at: Float[np.ndarray, " point"]
) -> Float[np.ndarray, "point function"]:
    """Independent functions of unit variance whose sum is a Matérn 5/2 process in ln a."""
    low = float(np.log(np.min(measured)))
    knots = np.linspace(low, 0.0, int(min(_MOST_KNOTS, 8 - _KNOTS_A_UNIT * low)))
    values, vectors = np.linalg.eigh(_matern(knots, knots))
    kept = values > _NO_VARIANCE * values[-1]
    inside = np.clip(np.log(at), low, np.inf)
    return _matern(inside, knots) @ (vectors[:, kept] / np.sqrt(values[kept]))


def _matern(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    r = np.sqrt(5.0) * np.abs(np.subtract.outer(u, v)) / priors.REMAINDER_LENGTH
    return (1 + r + r * r / 3) * np.exp(-r)


def best_hypotheses(readings: Readings, kinds: Iterable[str]) -> tuple[Problem, list[Cell]]:
    """All hypotheses that can count, the most probable first; their shapes as fine as needed."""
    problem = problem_of(readings, hypothesis_columns(readings, kinds))
    for _ in range(_ROUNDS):
        cells, alone = _weighed(problem, 2, _REACH)
        counts = _worth_dividing(problem, cells, alone)
        if not counts:
            break
        kept = {*_best_of_kinds(problem, alone), *(k for cell in cells for k in cell.columns)}
        finer = [one for k in counts for one in problem.columns[k].divided(readings)]
        left = [problem.columns[k] for k in sorted(kept - {*counts})]
        problem = problem.with_columns([*left, *finer])
    return problem, hypotheses_of(problem)


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


def _weighed(
    problem: Problem, every: int = 1, reach: float = _LEAST
) -> tuple[list[Cell], Float[np.ndarray, " column"]]:
    """Hypotheses that can count, and ln evidence of every column alone with its best remainders.

    With every size of remainders, or some: `every` second one. Down to `reach` below the most
    probable, in nats.
    """
    few, each = _sizes(2), _sizes(every)
    own, *others = problem.blocks
    grid = [_Normal.of(problem.columns, own, s) for s in itertools.product(each, each)]
    higher = _of_harmonics(problem.columns, others, every)
    cells: list[Cell] = []
    alone, best = np.full(len(problem.columns), -np.inf), -np.inf
    of_higher = _Diagonals.of(higher)
    for normal in grid:
        base, value = of_higher.singles(normal)
        alone = np.maximum(alone, np.max(value, axis=0, initial=-np.inf))
        best = max(best, np.max(base), np.max(value, initial=-np.inf))
        sizes = [normal.sizes if one is None else (*normal.sizes, *one.sizes) for one in higher]
        cells += [Cell(float(v), (), s) for v, s in zip(base, sizes, strict=True)]
        for one, k in np.argwhere(value > best - reach).tolist():
            cells.append(Cell(float(value[one, k]), (k,), sizes[one]))
    bounds = [None if other is None else other.most() for other in higher]
    for normal in grid:
        if not {*normal.sizes} <= {*few}:
            continue
        most = normal.most() + np.log(np.outer(normal.prior, normal.prior)) + _PRIOR_OF_PAIRS
        most = np.where(normal.apart(), most, -np.inf)
        for other, bound in zip(higher, bounds, strict=True):
            places = np.nonzero((most if bound is None else most + bound) > best - reach)
            if places[0].size:
                whole = normal if other is None else normal.with_rows_of(other)
                some = whole.pairs(places[0], places[1], best - reach)
                best = max([best, *(cell.log_evidence for cell in some)])
                cells += some
    kept = [cell for cell in cells if cell.log_evidence > best - reach]
    return sorted(kept, key=lambda cell: -cell.log_evidence), alone


def _of_harmonics(
    columns: list[Column], blocks: list[RowBlock], every: int
) -> "list[_Normal | None]":
    """What counts of all other harmonics, for remainders of every combination of sizes."""
    if not blocks:
        return [None]
    sizes = [(size,) for size in priors.HARMONIC_REMAINDERS[::every].tolist()]
    each = [[_Normal.of(columns, block, size) for size in sizes] for block in blocks]
    return [
        functools.reduce(lambda one, other: one.with_rows_of(other), some)
        for some in itertools.product(*each)
    ]


def _sizes(every: int) -> list[float]:
    return [0.0, *priors.REMAINDERS[::every].tolist()]


def _log_prior(sizes: Sizes) -> float:
    of_harmonic = len(sizes) == 1
    some = len(priors.HARMONIC_REMAINDERS) - 1 if of_harmonic else len(priors.REMAINDERS)
    share = (1 - priors.NO_REMAINDER) / some
    return float(sum(np.log(priors.NO_REMAINDER if s == 0 else share) for s in sizes))


class _Normal(NamedTuple):
    """What counts of all columns for remainders of some sizes."""

    sizes: Sizes
    base: float  # ln p of the rows without any law, times the prior of the sizes
    b: Float[np.ndarray, " column"]
    gram: Float[np.ndarray, "column column"]
    kind: np.ndarray  # of every column
    sign: Int[np.ndarray, " column"]
    std: Float[np.ndarray, " column"]  # NaN: of any size
    prior: Float[np.ndarray, " column"]  # probability among single laws

    @classmethod
    def of(cls, columns: list[Column], block: RowBlock, sizes: Sizes) -> "_Normal":
        """By one Cholesky factor."""
        root = block.triangle * np.sqrt(block.variances(sizes))
        factor = cholesky(root @ root.T + np.eye(len(root)), lower=True)
        white = solve_triangular(factor, block.along, lower=True)
        gram = block.across + white.T @ white
        base = -0.5 * float(gram[-1, -1]) - float(np.sum(np.log(np.diag(factor))))
        kinds = [column.kind for column in columns]
        odds = {kind: odds_of(kind) for kind in dict.fromkeys(kinds)}
        every = sum(odds.values())
        return cls(
            *(sizes, base + _log_prior(sizes), gram[:-1, -1], gram[:-1, :-1], np.array(kinds)),
            np.array([column.sign for column in columns]),
            np.array([np.nan if c.std is None else c.std for c in columns]),
            np.array([odds[c.kind] / every * c.fraction for c in columns]),
        )

    def with_rows_of(self, other: "_Normal") -> "_Normal":
        """By the rows of both."""
        return self._replace(
            sizes=(*self.sizes, *other.sizes),
            base=self.base + other.base,
            b=self.b + other.b,
            gram=self.gram + other.gram,
        )

    def strengths(self, some: Int[np.ndarray, " some"], every: int) -> np.ndarray:
        """1σ of the strengths of some columns that are tried, (some, strength)."""
        values = priors.STRENGTHS[::every]
        tried = np.broadcast_to(values, (len(some), len(values)))
        std = self.std[some, None]
        return np.where(np.isfinite(std), std, tried)

    def most(self) -> Float[np.ndarray, "column column"]:
        """What the rows of a pair can gain at most, with the base: no strength is larger than 1."""
        s = np.diag(self.gram) + 1.0
        across = np.maximum(np.outer(s, s) - self.gram**2, 1e-9 * np.outer(s, s))
        square = np.outer(self.b**2, s)
        square = square + square.T - 2 * self.gram * np.outer(self.b, self.b)
        return 0.5 * square / across + self.base

    def apart(self) -> np.ndarray:
        """Which columns can be a pair, each pair once."""
        other = (self.kind[:, None] != self.kind[None]) | (self.kind == ForceHarmonics.kind)
        return np.triu(other, 1)

    def pairs(self, i: np.ndarray, j: np.ndarray, least: float) -> list[Cell]:
        """Of some pairs those that are as probable as `least`."""
        likely = self._likely(i, j) > least
        i, j = i[likely], j[likely]
        if not i.size:
            return []
        blocks = range(0, len(i), 4096)
        values = [self._pair(i[begin : begin + 4096], j[begin : begin + 4096]) for begin in blocks]
        # Sizes of remainders are coarser than those of single laws, and as likely together.
        fewer = (len(priors.REMAINDERS) - 1) / (len(_sizes(2)) - 2)
        prior = np.log(priors.SIZES[2]) + np.log(fewer) * np.count_nonzero(self.sizes[:2])
        value = np.concatenate(values) + self.base + prior
        keep = np.flatnonzero(value > least)
        return [Cell(float(value[k]), (int(i[k]), int(j[k])), self.sizes) for k in keep]

    def _likely(self, i: np.ndarray, j: np.ndarray) -> np.ndarray:
        """What pairs may reach: with the strengths' best prior, a half nat of slack for each.

        A pair of which one is not seen reads as the other alone, and is left out.
        """
        s, t, b, c, g = *np.diag(self.gram)[[i, j]], *self.b[[i, j]], self.gram[i, j]
        s, t = s + 1.0, t + 1.0
        both = (b * b * t + c * c * s - 2 * g * b * c) / np.maximum(s * t - g * g, 1e-9 * s * t)
        first, second = both - c * c / t, both - b * b / s  # gain of one given the other
        occam = np.log(np.maximum(first, 1.0)) + np.log(np.maximum(second, 1.0))
        prior = np.log(self.prior[i] * self.prior[j]) + _PRIOR_OF_PAIRS
        value = 0.5 * both - 0.5 * occam + self.base + prior + 1.0
        return np.where(np.minimum(first, second) > priors.VISIBLE**2, value, -np.inf)

    def _pair(self, i: np.ndarray, j: np.ndarray) -> np.ndarray:
        first = self.strengths(i, 2)[:, :, None] ** -2.0
        second = self.strengths(j, 2)[:, None, :] ** -2.0
        p = self.gram[i, i][:, None, None] + first
        q = self.gram[j, j][:, None, None] + second
        c = self.gram[i, j][:, None, None]
        one, two = self.b[i][:, None, None], self.b[j][:, None, None]
        det = np.maximum(p * q - c * c, 1e-12 * p * q)
        x, y = (q * one - c * two) / det, (p * two - c * one) / det
        value = 0.5 * (one * x + two * y) - 0.5 * np.log(det / (first * second))
        value = value + _log_half(self.sign[i][:, None, None], x * np.sqrt(det / q))
        value = value + _log_half(self.sign[j][:, None, None], y * np.sqrt(det / p))
        n = value.shape[1] * value.shape[2]
        value = logsumexp(value.reshape(len(i), n), axis=1) - np.log(n)
        return value + np.log(2 * self.prior[i] * self.prior[j])


class _Diagonals(NamedTuple):
    """What counts of other harmonics for single laws, for all combinations of sizes at once."""

    base: Float[np.ndarray, " combination"]
    b: Float[np.ndarray, "combination column"]
    square: Float[np.ndarray, "combination column"]

    @classmethod
    def of(cls, higher: list[_Normal | None]) -> "_Diagonals":
        """Zeros where no other harmonic was recorded."""
        some = [one for one in higher if one is not None]
        if not some:
            return cls(np.zeros(1), np.zeros((1, 1)), np.zeros((1, 1)))
        squares = np.array([np.diag(one.gram) for one in some])
        return cls(np.array([one.base for one in some]), np.array([o.b for o in some]), squares)

    def singles(self, own: _Normal) -> tuple[np.ndarray, np.ndarray]:
        """ln evidence without a law, and of every law alone: (combination,), (combination, column).

        By the fundamentals' rows too.
        """
        base = own.base + self.base
        narrow = own.strengths(np.arange(len(own.b)), 1) ** -2.0
        b = (own.b + self.b)[..., None]
        precision = (np.diag(own.gram) + self.square)[..., None] + narrow
        mean = b / precision
        value = 0.5 * b * mean - 0.5 * np.log(precision / narrow)
        value = value + _log_half(own.sign[:, None], mean * np.sqrt(precision))
        value = logsumexp(value, axis=2) - np.log(value.shape[2]) + np.log(own.prior)
        value = value + base[:, None] + np.log(priors.SIZES[1])
        return base + np.log(priors.SIZES[0]), value


def _log_half(sign: np.ndarray, standardised: np.ndarray) -> np.ndarray:
    """ln of what a law of one sign gains: the posterior's part of that sign, over the prior's."""
    return np.where(sign == 0, 0.0, np.log(2) + log_ndtr(sign * standardised))


def seen_strengths(problem: Problem, cell: Cell, nats: float) -> Float[np.ndarray, " column"]:
    """Of every column the strength that would raise the evidence of a hypothesis by some nats."""
    normal = _Normal.of(problem.columns, problem.blocks[0], cell.sizes[:2])
    for block, size in zip(problem.blocks[1:], cell.sizes[2:], strict=True):
        normal = normal.with_rows_of(_Normal.of(problem.columns, block, (size,)))
    some, n_rows = list(cell.columns), sum(len(block.rows) for block in problem.blocks)
    across = normal.gram[:, some]
    known = across @ np.linalg.pinv(normal.gram[np.ix_(some, some)], hermitian=True)
    precision = np.diag(normal.gram) - np.sum(known * across, axis=1)
    # The fall of χ² has to pay for the choice, and for one number more.
    need = nats + np.log(n_rows)
    return np.sqrt(need / np.maximum(precision, 1e-12))


class Solved(NamedTuple):
    """Most likely strengths of a hypothesis' laws and its remainders, with their covariance."""

    mean: Float[np.ndarray, " unknown"]  # strengths, then the remainders' functions, part by part
    covariance: Float[np.ndarray, "unknown unknown"]
    misfit: float  # root-mean-square of what is left of the rows
    of_fundamentals: float  # that of the fundamentals' rows
    linear: tuple[float, float]  # errors of the natural frequency and damping ratio, in their 1σ


def solved(problem: Problem, cell: Cell) -> Solved:
    """The unknowns of a hypothesis; a law's strength has no prior but what an instrument's has."""
    laws, blocks = list(cell.columns), problem.blocks
    design = block_diag(*(block.design for block in blocks))
    design = np.hstack([np.vstack([block.laws[:, laws] for block in blocks]), design])
    rows = np.concatenate([block.rows for block in blocks])
    variances = [np.ones(len(laws))]  # what is seen at all is far smaller
    kept, first = [np.ones(len(laws), bool)], 2
    for place, block in enumerate(blocks):
        sizes = cell.sizes[:first] if place == 0 else cell.sizes[first + place - 1 :][:1]
        variances.append(block.variances(sizes))
        kept.append(np.repeat([False, True], [block.groups[0], sum(block.groups[1:])]))
    root, remain = np.sqrt(np.concatenate(variances)), np.concatenate(kept)
    q, r = np.linalg.qr(np.vstack([design * root, np.eye(len(root))]))
    inverse = root[:, None] * solve_triangular(r, np.eye(len(root)))
    mean = inverse @ (q[: len(rows)].T @ rows)
    left = (rows - design @ mean) ** 2
    misfit = float(np.sqrt(np.mean(left)))
    of_fundamentals = float(np.sqrt(np.mean(left[: len(blocks[0].rows)])))
    # The first error is that of the modal mass.
    linear = float(mean[len(laws) + 1]), float(mean[len(laws) + 2])
    covariance = (inverse @ inverse.T)[np.ix_(remain, remain)]
    return Solved(mean[remain], covariance, misfit, of_fundamentals, linear)
