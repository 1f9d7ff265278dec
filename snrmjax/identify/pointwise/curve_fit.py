"""Curves of ω̃² and 2ζ̃ω̃ against amplitude, and their fit to scattered points.

A curve is a family (piecewise linear as in the paper, or a shape-preserving cubic spline), knots
and values at the knots. Families differ only in how they pass through the knots.
"""

import itertools
from abc import abstractmethod
from typing import ClassVar, NamedTuple

import equinox as eqx
import interpax
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.linalg import lstsq

from snrmjax.identify.pointwise.knot_terms import (
    CondensedPoints,
    KnotTerms,
    bending,
    slopes_at_knots,
)
from snrmjax.numerics.least_squares import (
    ErrorSizes,
    LeastSquares,
    error_sizes,
    penalised_least_squares,
)


class AbstractPointwiseCurve(eqx.Module):
    """A function of amplitude through values at knots; continued linearly beyond them."""

    kind: ClassVar[str]
    knots: Float[Array, " knot"]  # amplitudes, increasing
    values: Float[Array, " knot"]

    @staticmethod
    @abstractmethod
    def abscissa(amplitude: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
        """The variable in which the curve is drawn through its knots."""

    @abstractmethod
    def within(self, abscissa: Float[Array, " point"]) -> Float[Array, " point"]:
        """The curve between its first and its last knot."""

    def __call__(self, amplitude: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
        """Value at an amplitude; beyond the knots along the end slopes of the abscissa."""
        x = self.abscissa(jnp.asarray(amplitude))
        first, last = self.abscissa(self.knots[0]), self.abscissa(self.knots[-1])
        inside = jnp.clip(x, first, last)
        flat = inside.reshape(-1)
        value = self.within(flat).reshape(x.shape)
        if self.knots.shape[0] < 2:
            return value
        slopes = jax.vmap(jax.grad(lambda u: self.within(u[None])[0]))(jnp.stack([first, last]))
        below = jnp.minimum(x - first, 0.0) * slopes[0]
        return value + below + jnp.maximum(x - last, 0.0) * slopes[1]

    def between_knots(self, amplitude: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
        """How far another curve through the same knots is off: what the knots leave open."""
        return jnp.zeros_like(amplitude)


class PiecewiseLinear(AbstractPointwiseCurve):
    """Straight lines between the knots, in the amplitude itself: the paper's choice."""

    kind: ClassVar[str] = "piecewise_linear"

    @staticmethod
    def abscissa(amplitude: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
        """See `AbstractPointwiseCurve.abscissa`."""
        return amplitude

    def within(self, abscissa: Float[Array, " point"]) -> Float[Array, " point"]:
        """See `AbstractPointwiseCurve.within`."""
        if self.knots.shape[0] < 2:
            return jnp.broadcast_to(self.values[0], abscissa.shape)
        return interpax.interp1d(abscissa, self.knots, self.values, method="linear", extrap=True)


class PchipCurve(AbstractPointwiseCurve):
    """A monotonicity-preserving cubic (PCHIP) in the squared amplitude.

    The square makes the curve an even, smooth function of amplitude: ω̃² of a smooth restoring
    force is linear in it to first order, at zero and when continued beyond the data.
    """

    kind: ClassVar[str] = "spline"

    @staticmethod
    def abscissa(amplitude: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
        """See `AbstractPointwiseCurve.abscissa`."""
        return amplitude**2

    def within(self, abscissa: Float[Array, " point"]) -> Float[Array, " point"]:
        """See `AbstractPointwiseCurve.within`."""
        if self.knots.shape[0] < 2:
            return jnp.broadcast_to(self.values[0], abscissa.shape)
        knots = self.abscissa(self.knots)
        method = "monotonic" if self.knots.shape[0] > 2 else "linear"
        return interpax.interp1d(abscissa, knots, self.values, method=method, extrap=True)

    def between_knots(self, amplitude: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
        """See `AbstractPointwiseCurve.between_knots`; the other one bends without kinks (C²)."""
        if self.knots.shape[0] < _FEWEST_OF_SPLINE:
            return jnp.zeros_like(amplitude)
        knots = self.abscissa(self.knots)
        inside = jnp.clip(self.abscissa(amplitude), knots[0], knots[-1]).reshape(-1)
        other = interpax.interp1d(inside, knots, self.values, method="cubic2")
        return (other - self.within(inside)).reshape(jnp.shape(amplitude))


CURVES: dict[str, type[AbstractPointwiseCurve]] = {
    curve.kind: curve for curve in (PiecewiseLinear, PchipCurve)
}
"""Families of curves by name."""

_FEWEST_OF_SPLINE = 4  # knots that a cubic without kinks needs
_NEIGHBOURS = 4.0  # knots about a knot, whose points tell how well the curve fits there

AS_STATED = ErrorSizes(1.0, 0.0)
"""Errors of the stated size, none of them shared."""


class CurveFit(NamedTuple):
    """A curve fitted to points, with the uncertainty of its values at the knots."""

    curve: AbstractPointwiseCurve
    covariance: Float[Array, "knot knot"]

    def std(self, amplitude: Float[Array, " point"]) -> Float[Array, " point"]:
        """1σ of the curve at some amplitudes."""
        slopes = _slopes(self.curve, amplitude)
        return jnp.sqrt(jnp.einsum("pk,kl,pl->p", slopes, self.covariance, slopes))


@eqx.filter_jit
def _slopes(curve: AbstractPointwiseCurve, amplitude: Array) -> Float[Array, "point knot"]:
    """Derivatives of the curve with respect to its values."""

    def at(values: Array) -> Array:
        return eqx.tree_at(lambda c: c.values, curve, values)(amplitude)

    return jax.jacfwd(at)(curve.values)


class PointSample(NamedTuple):
    """Scattered points of one quantity against amplitude, and whose errors are partly shared."""

    amplitude: Float[np.ndarray, " point"]
    values: Float[np.ndarray, " point"]
    std: Float[np.ndarray, " point"]  # 1σ, or relative sizes where the scale is not known
    level: np.ndarray  # (point,): points of one level share a part of their errors
    # 1σ of the errors that are known to be shared by the points of a level.
    shared: Float[np.ndarray, "point kind"] | None = None
    # 1σ of errors that all points share, each to its own extent.
    common: Float[np.ndarray, "point kind"] | None = None


def fit_curve(
    kind: str,
    knots: Float[np.ndarray, " knot"],
    smoothing: float,
    points: PointSample,
    *,
    fixed_first: float | None = None,
    sizes: ErrorSizes = AS_STATED,
    own_misfit: bool = False,
) -> CurveFit:
    """Fit a curve to points by penalised least squares over its values at the knots.

    Arguments: `kind` of `CURVES`; `knots` that enclose the amplitudes; `smoothing` weighs the
    bending of the curve in its abscissa against the points (relative to what a knot knows on
    average). `fixed_first` pins the value at the first knot. `sizes` scale the two parts of the
    covariance. With `own_misfit` the part that is not shared grows wherever the points near a knot
    are farther off the curve than their errors explain.
    Returns `CurveFit`.
    """
    problem = _problem(kind, knots, smoothing, points, fixed_first)
    at_knots, slopes, by_values = _settle(problem)
    free, n = problem.free, len(knots)
    design = problem.condensed.terms.curve(np.eye(n), by_values)
    _, level = np.unique(points.level, return_inverse=True)
    together = [np.full(len(level), sizes.level_std)]
    together += [] if points.shared is None else list(points.shared.T)
    groups = [(one, level) for one in together]
    if points.common is not None:
        groups += [(one, np.zeros_like(level)) for one in points.common.T]
    members = [problem.condensed.of_groups(one / points.std, group) for one, group in groups]
    result = penalised_least_squares(
        design[:, free],
        np.zeros(len(design)),
        np.ones(len(design)),
        np.concatenate(members, axis=1),
        problem.rough[:, free],
        np.zeros(len(problem.rough)),
    )
    of_noise = sizes.noise_scale**2 * result.unshared_covariance
    if own_misfit:
        stacked = np.concatenate([design[:, free], problem.rough[:, free]])
        inverse = np.linalg.pinv(stacked, rcond=1e-15)
        arms = [inverse[:, : len(design)] @ one for one in members]
        shared = [
            (one / points.std, arm[:, group])
            for (one, group), arm in zip(groups, arms, strict=True)
        ]
        settled = (at_knots, slopes, by_values)
        scale = _misfit_at_knots(problem, settled, inverse @ inverse.T, result, shared)[free]
        of_noise = of_noise * np.outer(scale, scale)
    covariance = np.zeros((n, n))
    covariance[free, free] = of_noise + result.shared_covariance
    return CurveFit(
        curve=CURVES[kind](*jax.device_put((knots, at_knots * problem.unit))),
        covariance=jax.device_put(covariance * problem.unit**2),
    )


def _misfit_at_knots(
    problem: "_Problem",
    settled: tuple[np.ndarray, np.ndarray, np.ndarray],
    inverse: np.ndarray,
    result: LeastSquares,
    shared: list[tuple[np.ndarray, np.ndarray]],
) -> Float[np.ndarray, " knot"]:
    """How many times as far as their errors explain points near a knot are off; 1 at least.

    Residuals are M e, M = 1 − X (XᵀX + R)⁻¹ Xᵀ with `inverse` in its middle: their variances are
    those of M cov(e) Mᵀ. `shared` are the errors that points share, in units of the points' own,
    and what each does to the knots.
    """
    at_knots, slopes, by_values = settled
    n = len(at_knots)
    spread = problem.spread[:, None]
    x = problem.terms.curve(np.eye(n), by_values)[:, problem.free] / spread
    left = (problem.target - problem.terms.curve(at_knots, slopes)) / problem.spread

    def through(matrix: np.ndarray) -> np.ndarray:
        return np.einsum("pk,kl,pl->p", x, matrix, x)

    expected = 1 - 2 * through(inverse) + through(result.unshared_covariance)
    expected = expected + through(result.shared_covariance)
    for size, arm in shared:
        expected = expected + size**2 - 2 * size * np.einsum("pk,kp->p", x, arm)
    # Every knot sees the points of its neighbours, the nearer the more.
    place = problem.terms.below + problem.terms.shares[:, 2:].clip(0.0, 1.0)[:, 0]
    near = np.maximum(0.0, 1 - np.abs(place - np.arange(n)[:, None]) / _NEIGHBOURS)
    excess = (near @ left**2) / np.maximum(near @ np.maximum(expected, 0.0), 1e-300)
    return np.sqrt(np.maximum(excess, 1.0))


class _Problem(NamedTuple):
    """A fit in values of order one."""

    abscissa: np.ndarray  # of the knots
    cubic: bool
    terms: KnotTerms  # of the points
    condensed: CondensedPoints  # that say as much as the points
    target: np.ndarray
    spread: np.ndarray
    rough: np.ndarray  # rows of the roughness penalty
    first: float  # where the first knot starts, and stays if it is not free
    free: slice  # the knots that are fitted
    unit: float  # of the values


def _problem(
    kind: str,
    knots: np.ndarray,
    smoothing: float,
    points: PointSample,
    fixed_first: float | None,
) -> _Problem:
    amplitude, values, std, *_ = points
    unit = float(np.max(np.abs(values)))
    target, spread = np.asarray(values) / unit, np.asarray(std) / unit
    information = np.sum(1.0 / spread**2) / len(knots)
    squared = kind == PchipCurve.kind
    abscissa, at = (knots**2, amplitude**2) if squared else (knots, amplitude)
    cubic = squared and len(knots) > 2
    terms = KnotTerms.of(np.asarray(at), abscissa, cubic=cubic)
    return _Problem(
        abscissa=abscissa,
        cubic=cubic,
        terms=terms,
        condensed=CondensedPoints.of(terms, spread),
        target=target,
        spread=spread,
        rough=np.sqrt(smoothing * information) * bending(abscissa),
        first=float(np.mean(target)) if fixed_first is None else fixed_first / unit,
        free=slice(0 if fixed_first is None else 1, len(knots)),
        unit=unit,
    )


def _settle(problem: _Problem) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Values at the knots, the curve's slopes there and the derivatives of these by the values.

    The slopes of the spline depend on its values: Gauss-Newton steps until they settle.
    """
    n, rows = len(problem.abscissa), problem.condensed.terms
    at_knots = np.full(n, float(np.mean(problem.target)))
    at_knots[0] = problem.first
    target = problem.condensed.of_rows(problem.target / problem.spread)
    for _ in range(12):
        slopes, by_values = slopes_at_knots(problem.abscissa, at_knots, cubic=problem.cubic)
        design = rows.curve(np.eye(n), by_values)
        step = _step(problem, at_knots, design, target - rows.curve(at_knots, slopes))
        at_knots = at_knots + step
        if np.max(np.abs(step)) < 1e-9:
            break
    return at_knots, slopes + by_values @ step, by_values


def _step(
    problem: _Problem, at_knots: np.ndarray, design: np.ndarray, right: np.ndarray
) -> np.ndarray:
    """Change of the values at the knots that fits weighted rows best."""
    free = problem.free
    stacked = np.concatenate([design[:, free], problem.rough[:, free]])
    both = np.concatenate([right, -problem.rough @ at_knots])
    step = np.zeros(len(at_knots))
    # Not by normal equations: a strong penalty would drown what the points say.
    step[free] = lstsq(stacked, both, cond=1e-15, lapack_driver="gelsy", check_finite=False)[0]
    return step


class LeftOut(NamedTuple):
    """How well levels are predicted by the others."""

    score: float  # error²/std², mean of the better three quarters of the levels; infinity = none
    sizes: ErrorSizes
    squares: Float[np.ndarray, " level"]  # error²/std² of every level that was predicted


def predict_left_out(
    kind: str,
    knots: Float[np.ndarray, " knot"],
    smoothing: float,
    points: PointSample,
    fixed_first: float | None = None,
) -> LeftOut:
    """Leave out every level in turn and predict it from a curve through the others.

    A level is left out of the problem linearised at the fit to all of them: a shape-preserving
    spline is nearly linear in its values, and one linear solve a level is fast.
    Points outside the amplitudes of the other levels are left aside: they would be continued,
    not interpolated.
    """
    amplitude, values, std, level, shared, _ = points
    problem = _problem(kind, knots, smoothing, points, fixed_first)
    at_knots, slopes, by_values = _settle(problem)
    n = len(knots)
    design = problem.terms.curve(np.eye(n), by_values)
    current = problem.terms.curve(at_knots, slopes)
    rows = np.column_stack([design, problem.target - current]) / problem.spread[:, None]
    order = np.argsort(level, kind="stable")
    members = np.split(order, np.flatnonzero(np.diff(level[order])) + 1)
    others = _all_but_one([np.asarray(np.linalg.qr(rows[own], mode="r")) for own in members])
    lowest = _lowest_of_others(np.array([amplitude[own].min() for own in members]))
    highest = -_lowest_of_others(np.array([-amplitude[own].max() for own in members]))
    errors, spreads, known = [], [], []
    for own, kept, low, high in zip(members, others, lowest, highest, strict=True):
        left = own[(amplitude[own] >= low) & (amplitude[own] <= high)]
        if not left.size:
            continue
        step = _step(problem, at_knots, kept[:, :-1], kept[:, -1])
        predicted = (current[left] + design[left] @ step) * problem.unit
        errors.append(values[left] - predicted)
        spreads.append(std[left])
        known.append(np.zeros((left.size, 0)) if shared is None else shared[left])
    if not errors:
        return LeftOut(np.inf, AS_STATED, np.zeros(0))
    pairs = zip(errors, spreads, strict=True)
    squares = np.array([np.mean((error / spread) ** 2) for error, spread in pairs])
    # A few levels that no curve predicts, at a sharp bend, must not decide for all.
    score = float(np.mean(np.sort(squares)[: -(-3 * len(squares) // 4)]))
    return LeftOut(score, error_sizes(errors, spreads, known), squares)


def _all_but_one(parts: list[np.ndarray]) -> list[np.ndarray]:
    """Triangular factors of all parts but one, for each in turn, in a few steps a part."""

    def joined(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return np.asarray(np.linalg.qr(np.concatenate([a, b]), mode="r"))

    none = np.zeros((0, parts[0].shape[1]))
    before = itertools.accumulate(parts[:-1], joined, initial=none)
    after = list(itertools.accumulate(parts[:0:-1], joined, initial=none))[::-1]
    return [np.concatenate(both) for both in zip(before, after, strict=True)]


def _lowest_of_others(numbers: Float[np.ndarray, " level"]) -> Float[np.ndarray, " level"]:
    """The lowest number of all levels but one, for each in turn; infinity where it is alone."""
    first, second = np.sort([*numbers, np.inf])[:2]
    return np.where(numbers == first, second, first)


def log_slope(curve: AbstractPointwiseCurve, amplitude: Float[np.ndarray, " point"]) -> np.ndarray:
    """dg/d log a of a curve at amplitudes between its knots, to the accuracy weights need."""
    knots = np.asarray(curve.knots)
    low = np.clip(amplitude * (1 - 1e-4), knots[0], knots[-1])
    high = np.clip(amplitude * (1 + 1e-4), knots[0], knots[-1])
    change = values_on_host(curve, high) - values_on_host(curve, low)
    return change / np.maximum(np.log(high / low), 1e-12)


def values_on_host(
    curve: AbstractPointwiseCurve, amplitude: Float[np.ndarray, " point"]
) -> Float[np.ndarray, " point"]:
    """A curve at some amplitudes in NumPy: nothing compiles for one more number of them."""
    return linearised_on_host(curve, amplitude)[0]


def linearised_on_host(
    curve: AbstractPointwiseCurve, amplitude: Float[np.ndarray, " point"]
) -> tuple[Float[np.ndarray, " point"], Float[np.ndarray, "point knot"]]:
    """The same, and its derivatives by the values at the knots (central differences)."""
    knots, values = np.asarray(curve.knots), np.asarray(curve.values)
    n, squared = len(knots), curve.kind == PchipCurve.kind
    x, at = (knots**2, amplitude**2) if squared else (knots, amplitude)
    cubic = squared and n > 2
    slopes, by_values = slopes_at_knots(x, values, cubic=cubic)
    terms = KnotTerms.of(np.clip(at, x[0], x[-1]), x, cubic=cubic)
    inside, by_inside = terms.curve(values, slopes), terms.curve(np.eye(n), by_values)
    if n < 2:
        return inside, by_inside
    if not cubic:
        by_values = np.diff(np.eye(n), axis=0) / np.diff(x)[:, None]
        slopes = by_values @ values
    below, above = np.minimum(at - x[0], 0), np.maximum(at - x[-1], 0)
    return (
        inside + slopes[0] * below + slopes[-1] * above,
        by_inside + np.outer(below, by_values[0]) + np.outer(above, by_values[-1]),
    )


def between_knots_on_host(
    curve: AbstractPointwiseCurve, amplitude: Float[np.ndarray, " point"]
) -> Float[np.ndarray, " point"]:
    """`AbstractPointwiseCurve.between_knots` in NumPy."""
    from scipy.interpolate import CubicSpline

    if curve.kind != PchipCurve.kind or len(curve.knots) < _FEWEST_OF_SPLINE:
        return np.zeros(len(amplitude))
    x, values = np.asarray(curve.knots) ** 2, np.asarray(curve.values)
    inside = np.clip(np.asarray(amplitude) ** 2, x[0], x[-1])
    return CubicSpline(x, values)(inside) - values_on_host(curve, np.sqrt(inside))
