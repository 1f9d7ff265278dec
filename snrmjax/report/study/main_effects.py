"""How an output depends on each varied quantity alone, estimated from the members themselves.

The share of quantity x is the first-order index S = Var(E[y | x])/Var(y): by how much the variance
of the output y would fall on average if x were known. The conditional mean E[y | x] is a cubic
regression spline, or the mean of each value where x takes few.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

FEWEST = 50  # members from which shares are estimated
_FEW_VALUES = 12  # a quantity that takes no more than these has a mean for each
_PIECES, _MEMBERS_A_PIECE = 7, 64
_GROUPS = 20  # of the jackknife
_DEGREE = 3
_SHOWN = 101
_BAND = 1.96


class MainEffect(NamedTuple):
    """What one varied quantity alone does to an output."""

    share: float  # first-order index; NaN where there are too few members
    half_width: float  # of its 95 % interval
    at: Float[np.ndarray, " place"]  # values of the quantity
    mean: Float[np.ndarray, " place"]  # conditional mean of the output
    error: Float[np.ndarray, " place"]  # half width of the 95 % band of that mean


def main_effect(
    quantity: Float[np.ndarray, " member"], output: Float[np.ndarray, " member"]
) -> MainEffect | None:
    """Share of variance and conditional mean of an output over one quantity.

    Members without an output are left out. The share is corrected for the freedom of the curve
    (adjusted R²), its interval is by the jackknife over twenty groups of members.
    Returns None with fewer than `FEWEST` members, or where one of the two does not vary.
    """
    known = np.isfinite(output) & np.isfinite(quantity)
    x, y = quantity[known], output[known]
    if len(y) < FEWEST or not np.ptp(x) > 0 or not np.ptp(y) > 0:
        return None
    values = np.unique(x)
    listed = len(values) <= _FEW_VALUES
    low, high = np.quantile(x, [0.005, 0.995]).tolist()
    at = values if listed else np.linspace(low, high, _SHOWN)
    knots = values if listed else _knots(x)
    basis = _levels if listed else _splines
    scale = y.std()
    centred = (y - y.mean()) / scale
    grams = [_gram(basis(x[k::_GROUPS], knots), centred[k::_GROUPS]) for k in range(_GROUPS)]
    every = _Gram.total(grams)
    share = every.share()
    without = np.array([every.less(one).share() for one in grams])
    std = np.sqrt((_GROUPS - 1) / _GROUPS * np.sum((without - without.mean()) ** 2))
    coefficients, covariance = every.fit()
    rows = basis(at, knots)
    error = np.sqrt(np.maximum(np.sum((rows @ covariance) * rows, axis=1), 0.0))
    mean = y.mean() + scale * (rows @ coefficients)
    return MainEffect(share, _BAND * float(std), at, mean, _BAND * scale * error)


def correlated_pairs(quantities: dict[str, Float[np.ndarray, " member"]]) -> list[tuple[str, str]]:
    """Varied quantities whose ranks are correlated: shares then overlap."""
    from scipy.stats import rankdata

    names = [name for name, values in quantities.items() if np.ptp(values) > 0]
    if len(names) < 2 or len(quantities[names[0]]) < FEWEST:
        return []
    ranks = np.array([rankdata(quantities[name]) for name in names])
    limit = max(0.1, 4 / np.sqrt(ranks.shape[1]))
    found = np.abs(np.corrcoef(ranks)) > limit
    return [(names[i], names[j]) for i, j in zip(*np.nonzero(np.triu(found, 1)), strict=True)]


class _Gram(NamedTuple):
    """Sums over members from which a least-squares fit follows."""

    basis: Float[np.ndarray, "place place"]
    with_output: Float[np.ndarray, " place"]
    output: float  # Σ y
    squared: float  # Σ y²
    n: int

    @classmethod
    def total(cls, parts: "list[_Gram]") -> "_Gram":
        return cls(*(sum(column[1:], column[0]) for column in zip(*parts, strict=True)))

    def less(self, part: "_Gram") -> "_Gram":
        return _Gram(
            self.basis - part.basis,
            self.with_output - part.with_output,
            self.output - part.output,
            self.squared - part.squared,
            self.n - part.n,
        )

    def fit(self) -> tuple[np.ndarray, np.ndarray]:
        """Coefficients and their covariance; a place without members has neither."""
        inverse = np.linalg.pinv(self.basis, rcond=1e-10, hermitian=True)
        coefficients = inverse @ self.with_output
        freedom = max(self.n - len(coefficients), 1)
        return coefficients, inverse * self._left(coefficients) / freedom

    def _left(self, coefficients: np.ndarray) -> float:
        """Sum of squared residuals."""
        return max(float(self.squared - coefficients @ self.with_output), 0.0)

    def share(self) -> float:
        """Adjusted R²."""
        coefficients, _ = self.fit()
        residual = self._left(coefficients) / max(self.n - len(coefficients), 1)
        variance = (self.squared - self.output**2 / self.n) / (self.n - 1)
        return float(1.0 - residual / variance)


def _gram(rows: np.ndarray, y: np.ndarray) -> _Gram:
    return _Gram(rows.T @ rows, rows.T @ y, float(y.sum()), float(y @ y), len(y))


def _knots(x: Float[np.ndarray, " member"]) -> Float[np.ndarray, " knot"]:
    """Knots of a clamped spline: as many members lie in every piece."""
    pieces = int(np.clip(len(x) // _MEMBERS_A_PIECE, 1, _PIECES))
    inner = np.unique(np.quantile(x, np.linspace(0, 1, pieces + 1)))
    return np.concatenate([[inner[0]] * _DEGREE, inner, [inner[-1]] * _DEGREE])


def _splines(
    x: Float[np.ndarray, " member"], knots: Float[np.ndarray, " knot"]
) -> Float[np.ndarray, "member place"]:
    from scipy.interpolate import BSpline

    return BSpline.design_matrix(x, knots, _DEGREE).toarray()


def _levels(
    x: Float[np.ndarray, " member"], values: Float[np.ndarray, " value"]
) -> Float[np.ndarray, "member value"]:
    return (x[:, None] == values[None, :]).astype(np.float64)
