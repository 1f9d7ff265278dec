"""A curve at many points by its values and slopes at the knots, and many points as few rows.

Between two knots a curve of either kind is a combination of its values and slopes at both, with
shares that do not depend on the values. Whatever is asked of the points between two knots is
asked of four numbers: four rows say all of it, and a fit costs what its knots cost.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int


class KnotTerms(NamedTuple):
    """A curve at some points as four shares of each, in values and slopes at knots."""

    below: Int[np.ndarray, " point"]  # the knot before every point
    above: Int[np.ndarray, " point"]
    shares: Float[np.ndarray, "point term"]  # of value and slope below, of value and slope above

    @classmethod
    def of(
        cls,
        abscissa: Float[np.ndarray, " point"],
        knots: Float[np.ndarray, " knot"],
        *,
        cubic: bool,
    ) -> "KnotTerms":
        """Of points between the knots, on straight lines or on cubics; a single knot: constant."""
        n = len(knots)
        if n == 1:
            below = np.zeros(len(abscissa), dtype=int)
            return cls(below, below, np.eye(4)[np.zeros(len(abscissa), dtype=int)])
        below = np.clip(np.searchsorted(knots, abscissa, side="right") - 1, 0, n - 2)
        width = np.diff(knots)[below]
        t = (abscissa - knots[below]) / width
        zero = np.zeros(len(t))
        if not cubic:
            return cls(below, below + 1, np.stack([1 - t, zero, t, zero], axis=1))
        shares = [
            (1 + 2 * t) * (1 - t) ** 2,
            t * (1 - t) ** 2 * width,
            t**2 * (3 - 2 * t),
            t**2 * (t - 1) * width,
        ]
        return cls(below, below + 1, np.stack(shares, axis=1))

    def curve(
        self, values: Float[np.ndarray, "knot *column"], slopes: Float[np.ndarray, "knot *column"]
    ) -> Float[np.ndarray, "point *column"]:
        """The curve at the points; with columns, several curves."""
        wide = (slice(None), *(None,) * (values.ndim - 1))
        a, b, c, d = (share[wide] for share in self.shares.T)
        below, above = self.below, self.above
        return a * values[below] + b * slopes[below] + c * values[above] + d * slopes[above]


class CondensedPoints(NamedTuple):
    """Few rows from which every curve differs by as much as from the points.

    Points between the same knots become at most four rows, of unit weight: an orthogonal factor
    of their weighted shares.
    """

    terms: KnotTerms  # of the rows
    parts: list[np.ndarray]  # points between the same knots
    factors: list[np.ndarray]  # (point, row) of every part, with orthonormal columns

    @classmethod
    def of(cls, terms: KnotTerms, std: Float[np.ndarray, " point"]) -> "CondensedPoints":
        """Of points with these standard deviations."""
        weighted = terms.shares / std[:, None]
        order = np.argsort(terms.below, kind="stable")
        parts = np.split(order, np.flatnonzero(np.diff(terms.below[order])) + 1)
        factors, shares = zip(*(np.linalg.qr(weighted[part]) for part in parts), strict=True)
        count = [len(rows) for rows in shares]
        below = np.repeat([terms.below[part[0]] for part in parts], count)
        above = np.repeat([terms.above[part[0]] for part in parts], count)
        return cls(KnotTerms(below, above, np.concatenate(shares)), parts, list(factors))

    def of_rows(self, weighted: Float[np.ndarray, " point"]) -> Float[np.ndarray, " row"]:
        """Numbers of the points, in units of their standard deviations, as numbers of the rows."""
        both = zip(self.factors, self.parts, strict=True)
        return np.concatenate([factor.T @ weighted[part] for factor, part in both])

    def of_groups(
        self, weighted: Float[np.ndarray, " point"], group: Int[np.ndarray, " point"]
    ) -> Float[np.ndarray, "row group"]:
        """The same for every group of points alone, the others' numbers being zero."""
        n_groups, blocks = int(group.max()) + 1, []
        for factor, part in zip(self.factors, self.parts, strict=True):
            block = np.zeros((n_groups, factor.shape[1]))
            np.add.at(block, group[part], factor * weighted[part, None])
            blocks.append(block.T)
        return np.concatenate(blocks)


def slopes_at_knots(
    abscissa: Float[np.ndarray, " knot"], values: Float[np.ndarray, " knot"], *, cubic: bool
) -> tuple[Float[np.ndarray, " knot"], Float[np.ndarray, "knot knot"]]:
    """Slopes of a shape-preserving cubic (PCHIP) at its knots, and their derivatives by its values.

    Central differences: they steer Gauss–Newton steps whose fixed point does not depend on them.
    Zeros for straight lines, which need no slopes.
    """
    n = len(abscissa)
    if not cubic:
        return np.zeros(n), np.zeros((n, n))
    # A quarter of the time that importing the package would take, and not needed to simulate.
    from scipy.interpolate import PchipInterpolator

    step = 1e-7 * max(float(np.max(np.abs(values))), 1e-300)
    moved = values[:, None] + step * np.concatenate([np.eye(n), -np.eye(n)], axis=1)
    coefficients = PchipInterpolator(abscissa, np.column_stack([values, moved])).c
    third, second, first, _ = coefficients
    width = np.diff(abscissa)[-1]
    last = (3 * third[-1] * width + 2 * second[-1]) * width + first[-1]
    slopes = np.concatenate([first, last[None]])
    return slopes[:, 0], (slopes[:, 1 : n + 1] - slopes[:, n + 1 :]) / (2 * step)


def place_knots(
    amplitude: Float[np.ndarray, " point"], level: np.ndarray, n_knots: int
) -> Float[np.ndarray, " knot"]:
    """At most `n_knots` amplitudes, spread as the points are, from the smallest to the largest.

    A level that was held at one amplitude (within 15 % from end to end) gets one knot: what
    varies inside it is not amplitude. Otherwise knots are at least 3 % apart.
    """
    candidates: list[float] = []
    for one in np.unique(level):
        inside = amplitude[level == one]
        held = len(inside) > 1 and inside.max() < 1.15 * inside.min()
        candidates += [float(np.median(inside))] if held else inside.tolist()
    ordered = np.sort(candidates)
    apart = [ordered[0]]
    for value in ordered[1:]:
        if value >= 1.03 * apart[-1]:
            apart.append(value)
    pick = np.linspace(0, len(apart) - 1, min(max(n_knots, 2), len(apart)))
    knots = np.asarray(apart)[np.unique(np.round(pick).astype(int))]
    lowest, highest = amplitude.min(), amplitude.max()
    if len(knots) == 1:
        return np.array([lowest, highest]) if highest > lowest else knots
    knots[0], knots[-1] = lowest, highest
    return knots


def bending(abscissa: Float[np.ndarray, " knot"]) -> Float[np.ndarray, "row knot"]:
    """Rows whose squares add up to about ∫(d²g/du²)² du of values at knots, u from 0 to 1."""
    u = (abscissa - abscissa[0]) / max(abscissa[-1] - abscissa[0], 1e-300)
    n = len(u)
    rows = np.zeros((max(n - 2, 0), n))
    for k in range(n - 2):
        left, right = u[k + 1] - u[k], u[k + 2] - u[k + 1]
        mean = 0.5 * (left + right)
        rows[k, k : k + 3] = np.array([1 / left, -1 / left - 1 / right, 1 / right]) / np.sqrt(mean)
    return rows
