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
    # Sums over members from which a fit follows: products of the basis, the output and one.
    table = np.column_stack([basis(x, knots), centred, np.ones(len(y))])
    groups = [table[k::_GROUPS].T @ table[k::_GROUPS] for k in range(_GROUPS)]
    every = np.sum(groups, axis=0)
    coefficients, covariance, share = _fit(every)
    without = np.array([_fit(every - one)[2] for one in groups])
    std = np.sqrt((_GROUPS - 1) / _GROUPS * np.sum((without - without.mean()) ** 2))
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


def _fit(sums: Float[np.ndarray, "sum sum"]) -> tuple[np.ndarray, np.ndarray, float]:
    """Coefficients, their covariance and the adjusted R²; a place without members has neither."""
    basis, with_output, n = sums[:-2, :-2], sums[:-2, -2], sums[-1, -1]
    inverse = np.linalg.pinv(basis, rcond=1e-10, hermitian=True)
    coefficients = inverse @ with_output
    left = max(sums[-2, -2] - coefficients @ with_output, 0.0) / max(n - len(coefficients), 1)
    variance = (sums[-2, -2] - sums[-2, -1] ** 2 / n) / (n - 1)
    return coefficients, inverse * left, float(1.0 - left / variance)


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
