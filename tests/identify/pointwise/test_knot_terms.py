"""Curves by values and slopes at knots, and points condensed to rows, against plain algebra."""

import numpy as np
import pytest
from scipy.interpolate import PchipInterpolator

from snrmjax.identify.pointwise.curve_fit import PointSample, _problem, _settle, predict_left_out
from snrmjax.identify.pointwise.knot_terms import CondensedPoints, KnotTerms, slopes_at_knots

KNOTS = np.array([0.04, 0.25, 0.36, 1.21, 2.89, 4.0])
VALUES = np.array([3.0, 4.0, 4.6, 6.5, 8.0, 8.5])
RNG = np.random.default_rng(0)
AT = np.concatenate([RNG.uniform(KNOTS[0], KNOTS[-1], 500), KNOTS])
STD = RNG.uniform(0.5, 2.0, AT.size)
kinds = pytest.mark.parametrize(("cubic", "n"), [(False, 6), (False, 2), (False, 1), (True, 6)])


def truth(cubic, n, values):
    """By SciPy's spline, NumPy's straight lines, or as a constant."""
    if n == 1:
        return np.full(AT.size, values[0])
    if cubic:
        return PchipInterpolator(KNOTS[:n], values)(np.clip(AT, KNOTS[0], KNOTS[n - 1]))
    return np.interp(AT, KNOTS[:n], values)


def terms(cubic, n):
    return KnotTerms.of(np.clip(AT, KNOTS[0], KNOTS[n - 1]), KNOTS[:n], cubic=cubic)


@kinds
def test_the_curve_is_scipys_and_its_slopes_are_finite_differences(cubic, n):
    values, own = VALUES[:n], terms(cubic, n)
    slopes, by_values = slopes_at_knots(KNOTS[:n], values, cubic=cubic)
    np.testing.assert_allclose(own.curve(values, slopes), truth(cubic, n, values), rtol=1e-13)
    step = 1e-6
    for k, unit in enumerate(np.eye(n)):
        sides = [truth(cubic, n, values + sign * step * unit) for sign in (1, -1)]
        found = own.curve(unit, by_values[:, k])
        # Rounding of 8.5 over 2e-6, and of the slopes over 1e-7 of that.
        np.testing.assert_allclose(found, (sides[0] - sides[1]) / (2 * step), atol=3e-8)


@kinds
def test_rows_say_as_much_as_the_points(cubic, n):
    own = terms(cubic, n)
    rows = CondensedPoints.of(own, STD)
    _, by_values = slopes_at_knots(KNOTS[:n], VALUES[:n], cubic=cubic)
    design = own.curve(np.eye(n), by_values) / STD[:, None]
    short = rows.terms.curve(np.eye(n), by_values)
    target, group = RNG.normal(size=AT.size), RNG.integers(0, 3, AT.size)
    assert len(short) <= 4 * max(n - 1, 1)
    np.testing.assert_allclose(short.T @ short, design.T @ design, rtol=1e-11, atol=1e-10)
    np.testing.assert_allclose(short.T @ rows.of_rows(target), design.T @ target, atol=1e-11)
    each = np.stack([design.T @ np.where(group == k, target, 0) for k in range(3)], axis=1)
    np.testing.assert_allclose(short.T @ rows.of_groups(target, group), each, atol=1e-11)


def sample(n, levels):
    rng = np.random.default_rng(1)
    amplitude = rng.uniform(0.2, 2.0, n)
    values = 3.0 + np.sin(amplitude) + 0.1 * rng.normal(size=n)
    return PointSample(amplitude, values, np.full(n, 0.1), rng.integers(0, levels, n))


@pytest.mark.parametrize("kind", ["spline", "piecewise_linear"])
@pytest.mark.parametrize("levels", [2, 7])
def test_levels_left_out_are_predicted_as_by_fits_without_them(kind, levels):
    points, smoothing = sample(90, levels), 1e-4
    knots = np.linspace(points.amplitude.min(), points.amplitude.max(), 9)
    problem = _problem(kind, knots, smoothing, points, None)
    values, slopes, by_values = _settle(problem)
    design = problem.terms.curve(np.eye(9), by_values)
    current = problem.terms.curve(values, slopes)
    squares = []
    for one in range(levels):
        kept, left = points.level != one, points.level == one
        ends = points.amplitude[kept].min(), points.amplitude[kept].max()
        left &= (points.amplitude >= ends[0]) & (points.amplitude <= ends[1])
        stacked = np.concatenate([design[kept] / problem.spread[kept, None], problem.rough])
        right = (problem.target - current)[kept] / problem.spread[kept]
        right = np.concatenate([right, -problem.rough @ values])
        step = np.linalg.lstsq(stacked, right, rcond=None)[0]
        error = (problem.target - current - design @ step)[left] / problem.spread[left]
        squares.append(np.mean(error**2))
    found = predict_left_out(kind, knots, smoothing, points)
    # Two ways of solving a system of condition 1e4.
    np.testing.assert_allclose(found.squares, squares, rtol=1e-9)


def test_a_fit_costs_what_its_knots_cost():
    # The size of the system, not time, which a busy machine decides.
    rows = []
    for n in (1000, 20000):
        points = sample(n, 5)
        knots = np.linspace(points.amplitude.min(), points.amplitude.max(), 60)
        rows.append(len(_problem("spline", knots, 1e-6, points, None).condensed.terms.below))
    assert max(rows) <= 4 * 59
