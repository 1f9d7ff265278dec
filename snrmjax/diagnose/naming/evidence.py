"""Evidences of laws, alone and in pairs, with remainders of every size, in closed form.

With the sizes (σ₁, σ₂) of the remainders of stiffness and damping fixed, rows y = Aθ + e have
e ~ N(0, C). All that counts of the columns A is b = AᵀC⁻¹y and S = AᵀC⁻¹A, from one Cholesky
factor; for θ ~ N(0, τ²) evidences are those of one and two Gaussian numbers, or of their positive
half. Pairs that cannot reach the best answer, as ½ bᵀS⁻¹b bounds them, are left out.
"""

import itertools
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.linalg import cholesky, solve_triangular
from scipy.special import log_ndtr, logsumexp

from snrmjax.diagnose.naming import priors
from snrmjax.diagnose.naming.columns import Column, hypothesis_columns, odds_of, rows_of_columns
from snrmjax.diagnose.naming.readings import Readings

_ROUNDS = 3  # of finer shapes
_COARSE = 40.0  # nats that a coarse shape may lack
_COUNTS = 0.02  # probability from which on a shape is divided
_LEAST = 8.0  # of ln p below the most probable answer: what is less likely is left out
_KNOTS_A_UNIT = 8  # of ln a
_MOST_KNOTS = 40
_NO_VARIANCE = 1e-8  # of the largest: a function of the remainder that adds nothing

Sizes = tuple[float, float]


class Cell(NamedTuple):
    """One hypothesis: some columns with remainders of some sizes."""

    log_evidence: float  # times the prior
    columns: tuple[int, ...]  # places in `Problem.columns`
    sizes: Sizes  # σ of the remainders of stiffness and damping


class Problem(NamedTuple):
    """Rows, and what can explain them."""

    readings: Readings
    columns: list[Column]
    functions: Float[np.ndarray, "state function"]  # of a remainder of size 1
    design: Float[np.ndarray, "row unknown"]  # errors, then both remainders of size 1
    laws: Float[np.ndarray, "row column"]
    directions: Float[np.ndarray, "row direction"]  # of the design, orthogonal
    triangle: Float[np.ndarray, "direction unknown"]
    along: Float[np.ndarray, "direction column"]  # laws and, last, the rows
    across: Float[np.ndarray, "column column"]  # Gram matrix of what is left of them

    @property
    def n_errors(self) -> int:
        """How many unknowns are errors."""
        return self.readings.errors.shape[1]

    def variances(self, sizes: Sizes) -> Float[np.ndarray, " unknown"]:
        """Prior variances of the design's unknowns."""
        n = self.functions.shape[1]
        return np.repeat([1.0, sizes[0] ** 2, sizes[1] ** 2], [self.n_errors, n, n])

    def with_columns(self, columns: list[Column]) -> "Problem":
        """The same with other columns."""
        laws = rows_of_columns(self.readings, columns)
        both = np.column_stack([laws, self.readings.rows])
        along = self.directions.T @ both
        left = both - self.directions @ along
        return self._replace(columns=columns, laws=laws, along=along, across=left.T @ left)

    def remainders(self, at: Float[np.ndarray, " point"]) -> Float[np.ndarray, "point function"]:
        """The remainder's functions at amplitudes over the largest one."""
        return _functions(self.readings.relative_amplitude, at)


def problem_of(readings: Readings, columns: list[Column]) -> Problem:
    """The problem, made triangular once for all hypotheses."""
    x, natural = readings.relative_amplitude, readings.natural_frequency
    functions = _functions(x, x)
    stiff = natural**2 * functions.T
    lossy = 1j * readings.frequency * natural * functions.T
    remainders = readings.whitened(np.concatenate([stiff, lossy])).T
    design = np.hstack([readings.errors, remainders])
    directions, triangle = np.linalg.qr(design)
    none = np.empty((0, 0))
    bare = Problem(readings, [], functions, design, none, directions, triangle, none, none)
    return bare.with_columns(columns)


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
        counts = _worth_dividing(problem, hypotheses_of(problem, _COARSE))
        if not counts:
            break
        finer = [one for k in counts for one in problem.columns[k].divided(readings)]
        kept = [one for k, one in enumerate(problem.columns) if k not in counts]
        problem = problem.with_columns([*kept, *finer])
    return problem, hypotheses_of(problem)


def _worth_dividing(problem: Problem, cells: list[Cell]) -> list[int]:
    """Columns whose shape counts: of every kind the best, and all that are probable."""
    weight = np.exp([cell.log_evidence - cells[0].log_evidence for cell in cells])
    mass = np.zeros(len(problem.columns))
    best: dict[str, int] = {}
    for cell, w in zip(cells, weight / weight.sum(), strict=True):
        mass[list(cell.columns)] += w
        for k in cell.columns:
            best.setdefault(problem.columns[k].kind, k)
    counts = {*best.values(), *np.flatnonzero(mass > _COUNTS).tolist()}
    return [k for k in sorted(counts) if problem.columns[k].shape]


def hypotheses_of(problem: Problem, reach: float = 0.0) -> list[Cell]:
    """The hypotheses of a problem that can count, the most probable first.

    And single laws down to a `reach` below, in nats: with a finer shape they may count.
    """
    all_sizes, few_sizes = _sizes(1), _sizes(2)
    grid = [_Normal.of(problem, sizes) for sizes in itertools.product(all_sizes, all_sizes)]
    fewer = (len(priors.REMAINDERS) - 1) / (len(few_sizes) - 2)  # of pairs: coarser, as likely
    cells, best = [], -np.inf
    for normal in grid:
        some = [Cell(normal.base + np.log(priors.SIZES[0]), (), normal.sizes)]
        some += normal.singles(np.log(priors.SIZES[1]), best - max(_LEAST, reach))
        best = max(best, *(cell.log_evidence for cell in some))
        cells += some
    for normal in grid:
        if not {*normal.sizes} <= {*few_sizes}:
            continue
        coarser = np.log(fewer) * np.count_nonzero(normal.sizes)
        some = normal.pairs(problem, np.log(priors.SIZES[2]) + coarser, best - _LEAST)
        best = max([best, *(cell.log_evidence for cell in some)])
        cells += some
    least = best - max(_LEAST, reach)
    kept = [cell for cell in cells if cell.log_evidence > least]
    return sorted(kept, key=lambda cell: -cell.log_evidence)


def _sizes(every: int) -> list[float]:
    return [0.0, *priors.REMAINDERS[::every].tolist()]


def _log_prior(sizes: Sizes) -> float:
    some = (1 - priors.NO_REMAINDER) / len(priors.REMAINDERS)
    return float(sum(np.log(priors.NO_REMAINDER if s == 0 else some) for s in sizes))


class _Normal(NamedTuple):
    """What counts of all columns for one pair of sizes."""

    sizes: Sizes
    base: float  # ln p of the rows without any law, times the prior of the sizes
    b: Float[np.ndarray, " column"]
    gram: Float[np.ndarray, "column column"]
    sign: Int[np.ndarray, " column"]
    std: Float[np.ndarray, " column"]  # NaN: of any size
    prior: Float[np.ndarray, " column"]  # probability among single laws

    @classmethod
    def of(cls, problem: Problem, sizes: Sizes) -> "_Normal":
        """By one Cholesky factor."""
        root = problem.triangle * np.sqrt(problem.variances(sizes))
        factor = cholesky(root @ root.T + np.eye(len(root)), lower=True)
        white = solve_triangular(factor, problem.along, lower=True)
        gram = problem.across + white.T @ white
        base = -0.5 * float(gram[-1, -1]) - float(np.sum(np.log(np.diag(factor))))
        kinds = dict.fromkeys(column.kind for column in problem.columns)
        odds = {kind: odds_of(kind) for kind in kinds}
        every = sum(odds.values())
        return cls(
            *(sizes, base + _log_prior(sizes), gram[:-1, -1], gram[:-1, :-1]),
            np.array([column.sign for column in problem.columns]),
            np.array([np.nan if c.std is None else c.std for c in problem.columns]),
            np.array([odds[c.kind] / every * c.fraction for c in problem.columns]),
        )

    def strengths(self, some: Int[np.ndarray, " some"], every: int) -> np.ndarray:
        """1σ of the strengths of some columns that are tried, (some, strength)."""
        values = priors.STRENGTHS[::every]
        tried = np.broadcast_to(values, (len(some), len(values)))
        std = self.std[some, None]
        return np.where(np.isfinite(std), std, tried)

    def singles(self, log_prior: float, least: float) -> list[Cell]:
        """One law each, of those that are as probable as `least`."""
        every = np.arange(len(self.b))
        narrow = self.strengths(every, 1) ** -2.0
        precision = np.diag(self.gram)[:, None] + narrow
        mean = self.b[:, None] / precision
        value = 0.5 * self.b[:, None] * mean - 0.5 * np.log(precision / narrow)
        value = value + _log_half(self.sign[:, None], mean * np.sqrt(precision))
        value = logsumexp(value, axis=1) - np.log(value.shape[1]) + np.log(self.prior)
        value = value + self.base + log_prior
        kept = np.flatnonzero(value > least)
        return [Cell(float(value[k]), (int(k),), self.sizes) for k in kept]

    def pairs(self, problem: Problem, log_prior: float, least: float) -> list[Cell]:
        """Pairs that may be as probable as `least`."""
        s = np.diag(self.gram)
        across = np.outer(s, s) - self.gram**2
        across = np.maximum(across, 1e-9 * np.outer(s, s))
        square = np.outer(self.b**2, s)
        square = square + square.T - 2 * self.gram * np.outer(self.b, self.b)
        most = 0.5 * square / across + np.log(np.outer(self.prior, self.prior)) + 3 * np.log(2)
        kinds = np.array([column.kind for column in problem.columns])
        chosen = np.triu(kinds[:, None] != kinds[None]) & (most + self.base + log_prior > least)
        i, j = np.nonzero(chosen)
        if not i.size:
            return []
        values = []
        for begin in range(0, len(i), 4096):
            values.append(self._pair(i[begin : begin + 4096], j[begin : begin + 4096]))
        value = np.concatenate(values) + self.base + log_prior
        keep = np.flatnonzero(value > least)
        return [Cell(float(value[k]), (int(i[k]), int(j[k])), self.sizes) for k in keep]

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


def _log_half(sign: np.ndarray, standardised: np.ndarray) -> np.ndarray:
    """ln of what a law of one sign gains: the posterior's part of that sign, over the prior's."""
    return np.where(sign == 0, 0.0, np.log(2) + log_ndtr(sign * standardised))


class Solved(NamedTuple):
    """Most likely strengths of a hypothesis' laws and its remainders, with their covariance."""

    mean: Float[np.ndarray, " unknown"]  # strengths, then both remainders' functions
    covariance: Float[np.ndarray, "unknown unknown"]
    misfit: float  # root-mean-square of what is left of the rows
    linear: tuple[float, float]  # errors of the natural frequency and damping ratio, in their 1σ


def solved(problem: Problem, cell: Cell) -> Solved:
    """The unknowns of a hypothesis; a law's strength has no prior but what an instrument's has."""
    n, laws = problem.n_errors, list(cell.columns)
    design = np.hstack([problem.laws[:, laws], problem.design])
    wide = np.ones(len(laws))  # what is seen at all is far smaller
    root = np.concatenate([wide, np.sqrt(problem.variances(cell.sizes))])
    stacked = np.vstack([design * root, np.eye(len(root))])
    q, r = np.linalg.qr(stacked)
    inverse = root[:, None] * solve_triangular(r, np.eye(len(root)))
    mean = inverse @ (q[: len(problem.readings.rows)].T @ problem.readings.rows)
    left = problem.readings.rows - design @ mean
    misfit = float(np.sqrt(np.mean(left**2)))
    kept = np.r_[: len(laws), len(laws) + n : len(root)]
    # The first error is that of the modal mass.
    linear = float(mean[len(laws) + 1]), float(mean[len(laws) + 2])
    return Solved(mean[kept], (inverse @ inverse.T)[np.ix_(kept, kept)], misfit, linear)
