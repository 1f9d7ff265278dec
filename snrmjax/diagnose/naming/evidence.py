"""Evidences of laws, alone and together, in closed form.

With the standard deviations of the remainders fixed, rows y = Aθ + e have e ~ N(0, C). Sufficient
for the columns A are b = AᵀC⁻¹y and S = AᵀC⁻¹A, from one Cholesky factor; for θ ~ N(0, τ²) the
evidences are one- and two-dimensional Gaussian integrals, between the limits of each strength.
Blocks of rows share only the laws, so that their b and S add up.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.linalg import cholesky, solve_triangular
from scipy.special import log_ndtr

from snrmjax.diagnose import priors
from snrmjax.diagnose.kinds.registry import hypothesis_of
from snrmjax.diagnose.naming.columns import Column
from snrmjax.diagnose.naming.rows import (
    WITHOUT_LAWS,
    Cell,
    LevelStds,
    Problem,
    RemainderStds,
    RowBlock,
)
from snrmjax.model.library.measurement_chain import ForceHarmonics

_ALIKE = 2 * (priors.BAND * priors.DESCRIBED) ** 2  # least sin² of the angle between two laws
PRIOR_OF_PAIRS = np.log(priors.EFFECT_COUNTS[2]) + 3 * np.log(2)  # at most


def remainder_stds(every: int) -> list[float]:
    """Standard deviations tried for a remainder of stiffness or damping, each `every`-th one."""
    return [0.0, *priors.REMAINDERS[::every].tolist()]


def _log_prior(stds: RemainderStds) -> float:
    of_harmonic = len(stds) == 1
    some = len(priors.HARMONIC_REMAINDERS) - 1 if of_harmonic else len(priors.REMAINDERS)
    fraction = (1 - priors.NO_REMAINDER) / some
    return float(sum(np.log(priors.NO_REMAINDER if s == 0 else fraction) for s in stds))


class LawSums(NamedTuple):
    """b and S of all columns, for given standard deviations of the remainders."""

    remainder_std: RemainderStds
    level_std: LevelStds
    base: float  # ln p of the rows without any law, times the prior of `remainder_std`
    b: Float[np.ndarray, " column"]
    square: Float[np.ndarray, " column"]  # diagonal of S
    gram: Float[np.ndarray, "column column"]  # S; empty for laws alone
    kind: np.ndarray  # of every column
    low: Float[np.ndarray, " column"]  # limits of the strength
    high: Float[np.ndarray, " column"]
    std: Float[np.ndarray, " column"]  # NaN: over `STRENGTHS`
    prior: Float[np.ndarray, " column"]  # probability among single laws

    @classmethod
    def of(
        cls,
        columns: list[Column],
        block: RowBlock,
        remainder_std: RemainderStds,
        levels: tuple[LevelStds, float] = (WITHOUT_LAWS, 0.0),
        *,
        alone: bool = False,
    ) -> "LawSums":
        """From one Cholesky factor; `levels`: 1σ of level errors, and ln of their prior.

        `alone`: for hypotheses of one law.
        """
        root = block.triangle * np.sqrt(block.variances(remainder_std, levels[0]))
        factor = cholesky(root @ root.T + np.eye(len(root)), lower=True)
        white = solve_triangular(factor, block.along, lower=True)
        square = np.diag(block.across) + np.sum(white**2, axis=0)
        b = block.across[:-1, -1] + white[:, :-1].T @ white[:, -1]
        gram = np.empty((0, 0))
        if not alone:
            gram = block.across[:-1, :-1] + white[:, :-1].T @ white[:, :-1]
        base = -0.5 * float(square[-1]) - float(np.sum(np.log(np.diag(factor))))
        kinds = [column.kind for column in columns]
        odds = {kind: hypothesis_of(kind).odds for kind in dict.fromkeys(kinds)}
        every = sum(odds.values())
        low, high = np.array([column.limits for column in columns]).reshape(-1, 2).T
        # A known sign doubles the prior density; other limits leave it as it is.
        one_sided = np.where((low == 0) & np.isposinf(high) | np.isneginf(low) & (high == 0), 2, 1)
        return cls(
            remainder_std,
            levels[0],
            base + _log_prior(remainder_std) + levels[1],
            b,
            square[:-1],
            gram,
            np.array(kinds),
            low,
            high,
            np.array([np.nan if c.std is None else c.std for c in columns]),
            np.array([odds[c.kind] / every * c.fraction for c in columns]) * one_sided,
        )

    def with_rows_of(self, other: "LawSums") -> "LawSums":
        """From the rows of both."""
        return self._replace(
            remainder_std=(*self.remainder_std, *other.remainder_std),
            base=self.base + other.base,
            b=self.b + other.b,
            square=self.square + other.square,
            gram=self.gram + other.gram,
        )

    def strengths(self, some: Int[np.ndarray, " some"], every: int) -> np.ndarray:
        """Prior 1σ values tried for the strengths of some columns, (some, strength)."""
        values = priors.STRENGTHS[::every]
        tried = np.broadcast_to(values, (len(some), len(values)))
        std = self.std[some, None]
        return np.where(np.isfinite(std), std, tried)

    def bound(self) -> Float[np.ndarray, "column column"]:
        """Upper bound of a pair's ln likelihood, ½ bᵀS⁻¹b plus base; prior 1σ is at most 1."""
        s = self.square + 1.0
        both = np.multiply.outer(s, s)
        across = np.maximum(both - self.gram**2, 1e-9 * both)
        square = np.multiply.outer(self.b**2, s)
        square = square + square.T - 2 * self.gram * np.multiply.outer(self.b, self.b)
        return 0.5 * square / across + self.base

    def prior_of_pairs(self) -> Float[np.ndarray, "column column"]:
        """ln of the largest prior of every pair, each once; −∞ for columns that make no pair."""
        apart = (self.kind[:, None] != self.kind) | (self.kind == ForceHarmonics.kind)
        log_prior = np.log(self.prior)
        prior = np.add.outer(log_prior, log_prior) + PRIOR_OF_PAIRS
        return np.where(np.triu(apart, 1), prior, -np.inf)

    def pairs(self, i: np.ndarray, j: np.ndarray, least: float) -> list[Cell]:
        """Those of some pairs whose log evidence exceeds `least`."""
        likely = self._likely(i, j) > least
        i, j = i[likely], j[likely]
        if not i.size:
            return []
        blocks = range(0, len(i), 4096)
        values = [self._pair(i[begin : begin + 4096], j[begin : begin + 4096]) for begin in blocks]
        # Pairs use a coarser grid of remainders than single laws, with the same total prior.
        fewer = (len(priors.REMAINDERS) - 1) / (len(remainder_stds(2)) - 2)
        prior = np.log(priors.EFFECT_COUNTS[2]) + np.log(fewer) * np.count_nonzero(
            self.remainder_std[:2]
        )
        value = np.concatenate(values) + self.base + prior
        keep = np.flatnonzero(value > least)
        stds = self.remainder_std, self.level_std
        return [Cell(float(value[k]), (int(i[k]), int(j[k])), *stds) for k in keep]

    def together(self, columns: tuple[int, ...]) -> Cell | None:
        """Several laws as one hypothesis; None if any is insignificant with the others."""
        first, second, *further = columns
        cells = self.pairs(np.array([first]), np.array([second]), -np.inf)
        for column in further:
            more = self.with_one_more(cells[0], -np.inf) if cells else []
            cells = [cell for cell in more if cell.columns[-1] == column]
        return cells[0] if cells else None

    def with_one_more(self, cell: Cell, least: float) -> list[Cell]:
        """A hypothesis with each further significant law, where its log evidence exceeds `least`.

        As for a single law, after projecting out the hypothesis' own laws.
        """
        own, n_laws = list(cell.columns), len(cell.columns) + 1
        wide = np.where(np.isnan(self.std[own]), 1.0, self.std[own])
        known = np.linalg.solve(self.gram[np.ix_(own, own)] + np.diag(wide**-2.0), self.gram[own])
        b = self.b - known.T @ self.b[own]
        square = self.square - np.sum(known * self.gram[own], axis=0)
        smallest = _ALIKE * self.square
        apart, square = square > smallest, np.maximum(square, smallest)
        value = self.gains(b, square, 2) + np.log(n_laws * self.prior)
        value += cell.log_evidence + np.log(
            priors.EFFECT_COUNTS[n_laws] / priors.EFFECT_COUNTS[n_laws - 1]
        )
        further = ~np.isin(self.kind, self.kind[own]) | (self.kind == ForceHarmonics.kind)
        further[own] = False
        significant = apart & (b**2 > priors.VISIBLE**2 * square)
        some = np.flatnonzero(further & significant & (value > least)).tolist()
        return [
            cell._replace(log_evidence=float(value[k]), columns=(*cell.columns, k)) for k in some
        ]

    def gains(
        self,
        b: Float[np.ndarray, "*rest column"],
        square: Float[np.ndarray, "*rest column"],
        every: int,
    ) -> Float[np.ndarray, "*rest column"]:
        """ln Bayes factor of every column alone, averaged over strengths, each `every`-th one."""
        narrow = self.strengths(np.arange(len(self.b)), every) ** -2.0
        precision = square[..., None] + narrow
        mean = b[..., None] / precision
        value = 0.5 * b[..., None] * mean - 0.5 * np.log(precision / narrow)
        by_column = [np.moveaxis(one, -2, 0) for one in (mean, np.sqrt(precision))]
        within = np.moveaxis(_log_within(self.low, self.high, *by_column), 0, -2)
        return _log_mean_exp(value + within, -1)

    def _likely(self, i: np.ndarray, j: np.ndarray) -> np.ndarray:
        """Approximate upper bound of pairs' log evidence, with half a nat of slack for each law.

        Excluded (−∞) are pairs with an insignificant law, which amount to the other law alone, and
        pairs whose laws differ by less than the error of describing functions.
        """
        s, t, b, c, g = *self.square[[i, j]], *self.b[[i, j]], self.gram[i, j]
        s, t = s + 1.0, t + 1.0
        both = (b * b * t + c * c * s - 2 * g * b * c) / np.maximum(s * t - g * g, 1e-9 * s * t)
        first, second = both - c * c / t, both - b * b / s  # gain of one given the other
        occam = np.log(np.maximum(first, 1.0)) + np.log(np.maximum(second, 1.0))
        prior = np.log(self.prior[i] * self.prior[j]) + PRIOR_OF_PAIRS
        value = 0.5 * both - 0.5 * occam + self.base + prior + 1.0
        apart = s * t - g * g > _ALIKE * s * t
        return np.where(apart & (np.minimum(first, second) > priors.VISIBLE**2), value, -np.inf)

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
        value = _log_mean_exp(value.reshape(len(i), -1), 1)
        # Limits matter little for a narrow prior, which a significant law makes improbable.
        for k, mean, precision in ((i, x, det / q), (j, y, det / p)):
            widest = mean[:, -1, -1], np.sqrt(precision[:, -1, -1])
            value = value + _log_within(self.low[k], self.high[k], *widest)
        return value + np.log(2 * self.prior[i] * self.prior[j])


class HarmonicSums(NamedTuple):
    """b and S of other harmonics for single laws, for all combinations of remainders at once."""

    base: Float[np.ndarray, " combination"]
    b: Float[np.ndarray, "combination column"]
    square: Float[np.ndarray, "combination column"]

    @classmethod
    def of(cls, higher: list[LawSums | None]) -> "HarmonicSums":
        """Zeros where no other harmonic was recorded."""
        some = [one for one in higher if one is not None]
        if not some:
            return cls(np.zeros(1), np.zeros((1, 1)), np.zeros((1, 1)))
        return cls(
            np.array([one.base for one in some]),
            np.array([one.b for one in some]),
            np.array([one.square for one in some]),
        )

    def singles(self, own: LawSums) -> tuple[np.ndarray, np.ndarray]:
        """ln evidence without a law, and of every law alone: (combination,), (combination, column).

        Includes the rows of the fundamentals.
        """
        base = own.base + self.base
        value = own.gains(own.b + self.b, own.square + self.square, 1) + np.log(own.prior)
        value = value + base[:, None] + np.log(priors.EFFECT_COUNTS[1])
        return base + np.log(priors.EFFECT_COUNTS[0]), value


def _log_mean_exp(values: np.ndarray, axis: int) -> np.ndarray:
    most = np.max(values, axis=axis, keepdims=True)
    return np.squeeze(most, axis) + np.log(np.mean(np.exp(values - most), axis=axis))


def _log_within(
    low: Float[np.ndarray, " column"],
    high: Float[np.ndarray, " column"],
    mean: Float[np.ndarray, "column *rest"],
    root_precision: Float[np.ndarray, "column *rest"],
) -> Float[np.ndarray, "column *rest"]:
    """ln of the probability of N(mean, 1/root_precision²) between every column's limits."""
    value = np.zeros(mean.shape)
    below, above = np.isfinite(low), np.isfinite(high)
    for some, limit, sign in ((below & ~above, low, 1), (above & ~below, high, -1)):
        off = mean[some] - np.expand_dims(limit[some], tuple(range(1, mean.ndim)))
        value[some] = log_ndtr(sign * off * root_precision[some])
    both = below & above
    limits = (np.expand_dims(one[both], tuple(range(1, mean.ndim))) for one in (low, high))
    lower, upper = ((one - mean[both]) * root_precision[both] for one in limits)
    flipped = lower > 0  # in the lower tail, where differences are exact
    lower, upper = np.where(flipped, -upper, lower), np.where(flipped, -lower, upper)
    log_lower, log_upper = log_ndtr(lower), log_ndtr(upper)
    value[both] = log_upper + np.log1p(-np.exp(log_lower - log_upper))
    return value


def detectable_strengths(problem: Problem, cell: Cell, nats: float) -> Float[np.ndarray, " column"]:
    """Detectable strength of each column in addition to a hypothesis."""
    first = cell.remainder_std[:2], (cell.level_std, 0.0)
    normal = LawSums.of(problem.columns, problem.blocks[0], *first)
    for block, std in zip(problem.blocks[1:], cell.remainder_std[2:], strict=True):
        normal = normal.with_rows_of(LawSums.of(problem.columns, block, (std,)))
    some, n_rows = list(cell.columns), sum(len(block.rows) for block in problem.blocks)
    across = normal.gram[:, some]
    known = across @ np.linalg.pinv(normal.gram[np.ix_(some, some)], hermitian=True)
    precision = normal.square - np.sum(known * across, axis=1)
    # Δχ² ≥ `nats` for the choice and ln n for one parameter (Schwarz).
    need = nats + np.log(n_rows)
    return np.sqrt(need / np.maximum(precision, 1e-12))
