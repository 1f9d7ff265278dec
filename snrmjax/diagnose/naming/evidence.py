"""Evidences of laws, alone and together, in closed form.

With the sizes of the remainders fixed, rows y = Aθ + e have e ~ N(0, C). All that counts of the
columns A is b = AᵀC⁻¹y and S = AᵀC⁻¹A, from one Cholesky factor; for θ ~ N(0, τ²) evidences are
those of one and two Gaussian numbers, or of their positive half. Blocks of rows have nothing but
the laws in common, so that their b and S add up.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.linalg import cholesky, solve_triangular
from scipy.special import log_ndtr, logsumexp

from snrmjax.diagnose import priors
from snrmjax.diagnose.naming.columns import Column, odds_of
from snrmjax.diagnose.naming.rows import (
    AS_CURVES_LEAVE,
    Cell,
    LevelSizes,
    Problem,
    RowBlock,
    Sizes,
)
from snrmjax.model.library.measurement_chain import ForceHarmonics

_ALIKE = 2 * (priors.BAND * priors.DESCRIBED) ** 2  # of a column, that errors of two laws may be
PRIOR_OF_PAIRS = np.log(priors.SIZES[2]) + 5 * np.log(2)  # at most, with both signs known


def sizes_of_remainders(every: int) -> list[float]:
    """Sizes that a remainder of stiffness or damping is tried with; `every` second one."""
    return [0.0, *priors.REMAINDERS[::every].tolist()]


def _log_prior(sizes: Sizes) -> float:
    of_harmonic = len(sizes) == 1
    some = len(priors.HARMONIC_REMAINDERS) - 1 if of_harmonic else len(priors.REMAINDERS)
    share = (1 - priors.NO_REMAINDER) / some
    return float(sum(np.log(priors.NO_REMAINDER if s == 0 else share) for s in sizes))


class LawSums(NamedTuple):
    """What counts of all columns for remainders of some sizes."""

    sizes: Sizes
    levels: LevelSizes
    base: float  # ln p of the rows without any law, times the prior of the sizes
    b: Float[np.ndarray, " column"]
    gram: Float[np.ndarray, "column column"]
    kind: np.ndarray  # of every column
    sign: Int[np.ndarray, " column"]
    std: Float[np.ndarray, " column"]  # NaN: of any size
    prior: Float[np.ndarray, " column"]  # probability among single laws

    @classmethod
    def of(
        cls,
        columns: list[Column],
        block: RowBlock,
        sizes: Sizes,
        levels: tuple[LevelSizes, float] = (AS_CURVES_LEAVE, 0.0),
    ) -> "LawSums":
        """By one Cholesky factor; `levels` with ln of their prior."""
        root = block.triangle * np.sqrt(block.variances(sizes, levels[0]))
        factor = cholesky(root @ root.T + np.eye(len(root)), lower=True)
        white = solve_triangular(factor, block.along, lower=True)
        gram = block.across + white.T @ white
        base = -0.5 * float(gram[-1, -1]) - float(np.sum(np.log(np.diag(factor))))
        kinds = [column.kind for column in columns]
        odds = {kind: odds_of(kind) for kind in dict.fromkeys(kinds)}
        every = sum(odds.values())
        return cls(
            *(
                sizes,
                levels[0],
                base + _log_prior(sizes) + levels[1],
                gram[:-1, -1],
                gram[:-1, :-1],
                np.array(kinds),
            ),
            np.array([column.sign for column in columns]),
            np.array([np.nan if c.std is None else c.std for c in columns]),
            np.array([odds[c.kind] / every * c.fraction for c in columns]),
        )

    def with_rows_of(self, other: "LawSums") -> "LawSums":
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
        both = np.multiply.outer(s, s)
        across = np.maximum(both - self.gram**2, 1e-9 * both)
        square = np.multiply.outer(self.b**2, s)
        square = square + square.T - 2 * self.gram * np.multiply.outer(self.b, self.b)
        return 0.5 * square / across + self.base

    def prior_of_pairs(self) -> Float[np.ndarray, "column column"]:
        """ln of the largest prior of every pair, each once; -∞ of columns that are none."""
        apart = (self.kind[:, None] != self.kind) | (self.kind == ForceHarmonics.kind)
        log_prior = np.log(self.prior)
        prior = np.add.outer(log_prior, log_prior) + PRIOR_OF_PAIRS
        return np.where(np.triu(apart, 1), prior, -np.inf)

    def pairs(self, i: np.ndarray, j: np.ndarray, least: float) -> list[Cell]:
        """Of some pairs those that are as probable as `least`."""
        likely = self._likely(i, j) > least
        i, j = i[likely], j[likely]
        if not i.size:
            return []
        blocks = range(0, len(i), 4096)
        values = [self._pair(i[begin : begin + 4096], j[begin : begin + 4096]) for begin in blocks]
        # Sizes of remainders are coarser than those of single laws, and as likely together.
        fewer = (len(priors.REMAINDERS) - 1) / (len(sizes_of_remainders(2)) - 2)
        prior = np.log(priors.SIZES[2]) + np.log(fewer) * np.count_nonzero(self.sizes[:2])
        value = np.concatenate(values) + self.base + prior
        keep = np.flatnonzero(value > least)
        return [
            Cell(float(value[k]), (int(i[k]), int(j[k])), self.sizes, self.levels) for k in keep
        ]

    def together(self, columns: tuple[int, ...]) -> Cell | None:
        """Several laws as one hypothesis; None where one of them is not seen beside the others."""
        first, second, *further = columns
        found = self.pairs(np.array([first]), np.array([second]), -np.inf)
        for column in further:
            more = self.with_one_more(found[0], -np.inf) if found else []
            found = [cell for cell in more if cell.columns[-1] == column]
        return found[0] if found else None

    def with_one_more(self, cell: Cell, least: float) -> list[Cell]:
        """A hypothesis with every further law that is seen, where it is as probable as `least`.

        As for a single law, of rows from which the hypothesis' own laws are taken away.
        """
        own, n_laws = list(cell.columns), len(cell.columns) + 1
        wide = np.where(np.isnan(self.std[own]), 1.0, self.std[own])
        known = np.linalg.solve(self.gram[np.ix_(own, own)] + np.diag(wide**-2.0), self.gram[own])
        b = self.b - known.T @ self.b[own]
        square = np.diag(self.gram) - np.sum(known * self.gram[own], axis=0)
        smallest = _ALIKE * np.diag(self.gram)
        apart, square = square > smallest, np.maximum(square, smallest)
        value = self.gains(b, square, 2) + np.log(n_laws * self.prior)
        value += cell.log_evidence + np.log(priors.SIZES[n_laws] / priors.SIZES[n_laws - 1])
        further = ~np.isin(self.kind, self.kind[own]) | (self.kind == ForceHarmonics.kind)
        further[own] = False
        seen = apart & (b**2 > priors.VISIBLE**2 * square)
        some = np.flatnonzero(further & seen & (value > least)).tolist()
        return [
            cell._replace(log_evidence=float(value[k]), columns=(*cell.columns, k)) for k in some
        ]

    def gains(
        self,
        b: Float[np.ndarray, "*rest column"],
        square: Float[np.ndarray, "*rest column"],
        every: int,
    ) -> Float[np.ndarray, "*rest column"]:
        """ln of what every column alone gains, over all strengths, or `every` second one."""
        narrow = self.strengths(np.arange(len(self.b)), every) ** -2.0
        precision = square[..., None] + narrow
        mean = b[..., None] / precision
        value = 0.5 * b[..., None] * mean - 0.5 * np.log(precision / narrow)
        value = value + _log_half(self.sign[:, None], mean * np.sqrt(precision))
        return logsumexp(value, axis=-1) - np.log(value.shape[-1])

    def _likely(self, i: np.ndarray, j: np.ndarray) -> np.ndarray:
        """What pairs may reach: with the strengths' best prior, a half nat of slack for each.

        A pair of which one is not seen reads as the other alone, and is left out; so is one whose
        laws differ by less than describing functions are right.
        """
        s, t, b, c, g = *np.diag(self.gram)[[i, j]], *self.b[[i, j]], self.gram[i, j]
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
        value = value + _log_half(self.sign[i][:, None, None], x * np.sqrt(det / q))
        value = value + _log_half(self.sign[j][:, None, None], y * np.sqrt(det / p))
        n = value.shape[1] * value.shape[2]
        value = logsumexp(value.reshape(len(i), n), axis=1) - np.log(n)
        return value + np.log(2 * self.prior[i] * self.prior[j])


class HarmonicSums(NamedTuple):
    """What counts of other harmonics for single laws, for all combinations of sizes at once."""

    base: Float[np.ndarray, " combination"]
    b: Float[np.ndarray, "combination column"]
    square: Float[np.ndarray, "combination column"]

    @classmethod
    def of(cls, higher: list[LawSums | None]) -> "HarmonicSums":
        """Zeros where no other harmonic was recorded."""
        some = [one for one in higher if one is not None]
        if not some:
            return cls(np.zeros(1), np.zeros((1, 1)), np.zeros((1, 1)))
        squares = np.array([np.diag(one.gram) for one in some])
        return cls(np.array([one.base for one in some]), np.array([o.b for o in some]), squares)

    def singles(self, own: LawSums) -> tuple[np.ndarray, np.ndarray]:
        """ln evidence without a law, and of every law alone: (combination,), (combination, column).

        By the fundamentals' rows too.
        """
        base = own.base + self.base
        value = own.gains(own.b + self.b, np.diag(own.gram) + self.square, 1) + np.log(own.prior)
        value = value + base[:, None] + np.log(priors.SIZES[1])
        return base + np.log(priors.SIZES[0]), value


def _log_half(sign: np.ndarray, standardised: np.ndarray) -> np.ndarray:
    """ln of what a law of one sign gains: the posterior's part of that sign, over the prior's."""
    return np.where(sign == 0, 0.0, np.log(2) + log_ndtr(sign * standardised))


def seen_strengths(problem: Problem, cell: Cell, nats: float) -> Float[np.ndarray, " column"]:
    """Of every column the strength that would raise the evidence of a hypothesis by some nats."""
    normal = LawSums.of(problem.columns, problem.blocks[0], cell.sizes[:2], (cell.levels, 0.0))
    for block, size in zip(problem.blocks[1:], cell.sizes[2:], strict=True):
        normal = normal.with_rows_of(LawSums.of(problem.columns, block, (size,)))
    some, n_rows = list(cell.columns), sum(len(block.rows) for block in problem.blocks)
    across = normal.gram[:, some]
    known = across @ np.linalg.pinv(normal.gram[np.ix_(some, some)], hermitian=True)
    precision = np.diag(normal.gram) - np.sum(known * across, axis=1)
    # The fall of χ² has to pay for the choice, and for one number more.
    need = nats + np.log(n_rows)
    return np.sqrt(need / np.maximum(precision, 1e-12))
