"""Smooth curves of amplitude as sums of fixed functions with prior variances.

A straight line in a², and the roughness of a natural cubic spline in a²: the distance of the value
at a knot from the chord between its neighbours, equally likely per step of log amplitude. The 1σ of
the roughness may vary along the curve, as where a softening arch folds; the basis functions do not
depend on it, so they are evaluated once. Beyond the last knot a curve is linear in a².
References: for the prior, Green & Silverman, Nonparametric Regression and Generalized Linear Models
(1994), ch. 2; for varying roughness, Ruppert & Carroll, Aust. N. Z. J. Stat. 42 (2000) 205,
doi:10.1111/1467-842X.00119.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.interpolate import CubicSpline

from snrmjax.identify.curves.splines import amplitudes_apart, roughness_of
from snrmjax.identify.test_model.priors import CURVE_CONSTANT, CURVE_SLOPES, ROUGHNESS_LENGTH

MOST_KNOTS = 42
_BEYOND = (1.15, 1.3)  # knots above the largest amplitude, for levels recorded too small
_NEAREST = 1.1  # smallest ratio of neighbouring knots' amplitudes
N_POWERS = 2
_NO_VARIANCE = 1e-6  # of the largest eigenvalue: directions below it are dropped


class CurveBasis(NamedTuple):
    """The basis functions for one range of amplitudes."""

    largest: float  # m
    knots: Float[np.ndarray, " knot"]  # of (a/largest)²
    pieces: Float[np.ndarray, "4 interval function"]  # cubic coefficients, highest power first
    directions: Float[np.ndarray, "curvature direction"]  # of the log of the roughness' 1σ

    @classmethod
    def of(
        cls,
        amplitude: Float[np.ndarray, " state"],
        most_knots: int = MOST_KNOTS,
        *,
        crowded: bool = False,
    ) -> "CurveBasis":
        """For measured amplitudes: knots at rest, at amplitudes of states, and slightly beyond;
        with `crowded` also closer ones where states cluster.
        """
        largest = float(np.max(amplitude))
        most = max(most_knots - 1 - len(_BEYOND), 1)
        inside = amplitudes_apart(amplitude / largest, most, _NEAREST, crowded=crowded)
        return cls.at(largest, np.array([0.0, *inside, *_BEYOND]) ** 2)

    @classmethod
    def at(cls, largest: float, knots: Float[np.ndarray, " knot"]) -> "CurveBasis":
        """For knots of (a/largest)²."""
        roughness = roughness_of(knots)
        functions = np.column_stack([np.ones_like(knots), knots, np.linalg.pinv(roughness)])
        apart_by = (
            np.subtract.outer(np.arange(len(roughness)), np.arange(len(roughness)))
            / ROUGHNESS_LENGTH
        )
        values, vectors = np.linalg.eigh(np.exp(-0.5 * apart_by**2))
        keep = values > _NO_VARIANCE * np.max(values, initial=0.0)
        directions = vectors[:, keep] * np.sqrt(values[keep])
        pieces = CubicSpline(knots, functions, bc_type="natural").c
        return cls(largest, knots, pieces, directions)

    @property
    def at_rest(self) -> Float[np.ndarray, " function"]:
        """The functions at the first knot, zero."""
        return self.pieces[-1, 0]

    @property
    def reach(self) -> float:
        """Prior 1σ at the largest amplitude of a curve with roughness of 1σ = 1."""
        return float(np.linalg.norm(self.values(np.array([self.largest]))[0][0, N_POWERS:]))

    @property
    def n_functions(self) -> int:
        """Number of basis functions."""
        return self.pieces.shape[2]

    def values(
        self, amplitude: Float[np.ndarray, " point"]
    ) -> tuple[Float[np.ndarray, "point function"], Float[np.ndarray, "point function"]]:
        """The basis functions, and their derivatives by the logarithm of amplitude."""
        values, slopes = self.curves(amplitude, np.eye(self.n_functions))
        return values.T, slopes.T

    def curves(
        self,
        amplitude: Float[np.ndarray, " point"],
        coefficients: Float[np.ndarray, "function curve"],
    ) -> tuple[Float[np.ndarray, "curve point"], Float[np.ndarray, "curve point"]]:
        """Curves of these coefficients, and their derivatives by the logarithm of amplitude."""
        u = (amplitude / self.largest) ** 2
        k = np.searchsorted(self.knots[1:-1], u, side="right")
        inside = np.minimum(u, self.knots[-1])
        t = (inside - self.knots[k])[:, None]
        third, second, first, value = (self.pieces @ coefficients)[:, k]
        slope = first + t * (2 * second + 3 * t * third)
        value = value + t * (first + t * (second + t * third))
        return (value + slope * (u - inside)[:, None]).T, (2 * u[:, None] * slope).T

    def log_variances(
        self,
    ) -> tuple[Float[np.ndarray, " function"], Float[np.ndarray, "function hyper"]]:
        """ln of the prior variances of the linear functions, and of roughness of constant 1σ = 1;
        and their slopes by ln of that 1σ and by its variation along the curve.
        """
        powers = 2 * np.log([CURVE_CONSTANT, CURVE_SLOPES])
        slopes = np.zeros((self.n_functions, 1 + self.directions.shape[1]))
        slopes[N_POWERS:, 0] = 2.0
        slopes[N_POWERS:, 1:] = 2 * self.directions
        return np.concatenate([powers, np.zeros(len(self.directions))]), slopes
