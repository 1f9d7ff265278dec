"""Curves against scipy and numpy; their fit against exact values and Monte Carlo."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import CubicSpline, PchipInterpolator

from snrmjax.identify.pointwise.curve_fit import (
    AS_STATED,
    CURVES,
    CurveFit,
    PchipCurve,
    PiecewiseLinear,
    PointSample,
    between_knots_on_host,
    fit_curve,
    log_slope,
    predict_left_out,
    values_on_host,
)
from snrmjax.identify.pointwise.knot_terms import place_knots
from snrmjax.numerics.least_squares import ErrorSizes

KNOTS = np.array([0.2, 0.5, 0.6, 1.1, 1.7, 2.0])
# Rising, flat, falling: every branch of the shape-preserving slopes.
VALUES = np.array([3.0, 4.0, 4.0, 6.5, 2.0, 1.5])
INSIDE = np.linspace(0.2, 2.0, 101)
BEYOND = np.array([0.0, 0.1, 2.3, 5.0])


def reference(kind, knots=KNOTS, values=VALUES):
    """The same curve by scipy or numpy, between its knots."""
    if kind == "spline":
        spline = PchipInterpolator(knots**2, values)
        return lambda amplitude: spline(np.asarray(amplitude) ** 2)
    return lambda amplitude: np.interp(amplitude, knots, values)


def end_slopes(kind, knots=KNOTS, values=VALUES):
    """Slopes in the abscissa at both ends."""
    if kind == "spline":
        return PchipInterpolator(knots**2, values).derivative()(knots[[0, -1]] ** 2)
    return np.diff(values)[[0, -1]] / np.diff(knots)[[0, -1]]


def curve_of(kind, knots=KNOTS, values=VALUES):
    return CURVES[kind](jnp.asarray(knots), jnp.asarray(values))


evaluate = eqx.filter_jit(lambda curve, amplitude: curve(amplitude))
both_kinds = pytest.mark.parametrize("kind", list(CURVES))


class TestCurves:
    def test_the_families(self):
        assert CURVES["piecewise_linear"] is PiecewiseLinear
        assert CURVES["spline"] is PchipCurve
        assert len(CURVES) == 2

    @both_kinds
    def test_between_the_knots_it_is_scipys_or_numpys(self, kind):
        amplitude = np.concatenate([INSIDE, KNOTS])
        found = evaluate(curve_of(kind), jnp.asarray(amplitude))
        # The same polynomial from other arithmetic.
        np.testing.assert_allclose(found, reference(kind)(amplitude), rtol=1e-13)
        np.testing.assert_allclose(found[-KNOTS.size :], VALUES, rtol=1e-14)

    @both_kinds
    def test_beyond_the_knots_it_goes_on_straight_in_its_abscissa(self, kind):
        found = evaluate(curve_of(kind), jnp.asarray(BEYOND))
        power = 2 if kind == "spline" else 1
        first, last = end_slopes(kind)
        below, above = BEYOND[:2], BEYOND[2:]
        truth = [
            *VALUES[0] + first * (below**power - KNOTS[0] ** power),
            *VALUES[-1] + last * (above**power - KNOTS[-1] ** power),
        ]
        np.testing.assert_allclose(found, truth, rtol=1e-12)  # differences of squares

    @pytest.mark.parametrize("n", [1, 2])
    @both_kinds
    def test_one_knot_is_a_constant_and_two_are_a_line(self, kind, n):
        power = 2 if kind == "spline" else 1
        amplitude = np.array([0.0, 0.3, 0.5, 4.0])
        found = evaluate(curve_of(kind, KNOTS[:n], VALUES[:n]), jnp.asarray(amplitude))
        slope = 0.0 if n == 1 else 1.0 / (KNOTS[1] ** power - KNOTS[0] ** power)
        truth = 3.0 + slope * (amplitude**power - KNOTS[0] ** power)
        np.testing.assert_allclose(found, truth, rtol=1e-14)

    @pytest.mark.parametrize("n", [1, 2, 6])
    @both_kinds
    def test_the_host_has_the_same_values(self, kind, n):
        curve, at = curve_of(kind, KNOTS[:n], VALUES[:n]), np.concatenate([INSIDE, BEYOND])
        np.testing.assert_allclose(
            values_on_host(curve, at), evaluate(curve, jnp.asarray(at)), rtol=1e-12
        )

    @both_kinds
    def test_shapes_and_transformations(self, kind):
        curve = curve_of(kind)
        traces = []

        @jax.jit
        def counted(amplitude):
            traces.append(1)
            return curve(amplitude)

        plain = counted(jnp.asarray(INSIDE[:100]))
        counted(jnp.asarray(INSIDE[1:]))
        assert len(traces) == 1
        mapped = jax.jit(jax.vmap(curve))(jnp.asarray(INSIDE[:100]))
        matrix = evaluate(curve, jnp.asarray(INSIDE[:100].reshape(20, 5)))
        np.testing.assert_allclose(mapped, plain, rtol=1e-14)
        np.testing.assert_allclose(matrix.ravel(), plain, rtol=1e-14)
        assert evaluate(curve, jnp.asarray(1.0)).shape == ()

    def test_derivatives_with_respect_to_the_amplitude(self):
        curve = curve_of("spline")
        slope = jax.jit(jax.vmap(jax.grad(curve)))(jnp.asarray(INSIDE))
        truth = PchipInterpolator(KNOTS**2, VALUES).derivative()(INSIDE**2) * 2 * INSIDE
        np.testing.assert_allclose(slope, truth, rtol=1e-11, atol=1e-12)
        # A smooth restoring force: an even function of the amplitude.
        at_zero = jax.jit(jax.grad(curve))(0.0)
        assert at_zero == 0.0

    @both_kinds
    def test_units(self, kind):
        # Powers of two, so that scaling adds no rounding.
        plain = evaluate(curve_of(kind), jnp.asarray(INSIDE))
        scaled = evaluate(curve_of(kind, 8 * KNOTS, 4 * VALUES), jnp.asarray(8 * INSIDE))
        np.testing.assert_allclose(scaled, 4 * np.asarray(plain), rtol=1e-14)


class TestCurveFit:
    @both_kinds
    def test_std_against_monte_carlo_of_the_values(self, kind):
        rng = np.random.default_rng(0)
        root = 0.01 * rng.normal(size=(6, 6))
        # A curve without flat parts: at a flat part the spline is not linear in its values.
        values = np.array([3.0, 4.0, 4.6, 6.5, 8.0, 8.5])
        amplitude = np.concatenate([INSIDE[::5], BEYOND])
        fit = CurveFit(curve_of(kind, values=values), jnp.asarray(root @ root.T))
        drawn = []
        for values_drawn in values + rng.normal(size=(4000, 6)) @ root.T:
            inside = np.clip(amplitude, KNOTS[0], KNOTS[-1])
            curve = reference(kind, values=values_drawn)(inside)
            power = 2 if kind == "spline" else 1
            first, last = end_slopes(kind, values=values_drawn)
            curve += first * np.minimum(amplitude**power - KNOTS[0] ** power, 0)
            curve += last * np.maximum(amplitude**power - KNOTS[-1] ** power, 0)
            drawn.append(curve)
        # 1.1 % for 4000 draws, and 1 % wide draws to second order.
        np.testing.assert_allclose(
            fit.std(jnp.asarray(amplitude)), np.std(drawn, axis=0, ddof=1), rtol=0.05
        )

    def test_log_slope(self):
        curve = curve_of("spline")
        at = INSIDE[1:-1]
        truth = PchipInterpolator(KNOTS**2, VALUES).derivative()(at**2) * 2 * at**2
        # One-sided over a kink in curvature: (1e-4)² within a piece, 1e-4 across a knot.
        np.testing.assert_allclose(log_slope(curve, at), truth, atol=2e-3)
        linear = curve_of("piecewise_linear", KNOTS[:2], VALUES[:2])
        # dg/d log a = a dg/da
        np.testing.assert_allclose(
            log_slope(linear, np.array([0.3, 0.4])), np.array([0.3, 0.4]) / 0.3, rtol=1e-7
        )


def sample(kind, values=VALUES, n=60, levels=6):
    amplitude = np.sort(np.random.default_rng(1).uniform(KNOTS[0], KNOTS[-1], n))
    level = np.repeat(np.arange(levels), n // levels)
    return amplitude, reference(kind, values=values)(amplitude), level


class TestFit:
    @pytest.mark.parametrize("values", [VALUES, 1e9 * VALUES, VALUES[::-1] - 3.0])
    @both_kinds
    def test_exact_points_give_exact_values(self, kind, values):
        amplitude, truth, level = sample(kind, values)
        fit = fit_curve(kind, KNOTS, 0.0, PointSample(amplitude, truth, 0.1 * np.ones(60), level))
        # Gauss-Newton steps end below 1e-9 of the largest value.
        np.testing.assert_allclose(fit.curve.values, values, atol=1e-8 * np.abs(values).max())
        np.testing.assert_array_equal(fit.curve.knots, KNOTS)
        assert fit.curve.kind == kind

    @both_kinds
    def test_a_first_value_that_is_known(self, kind):
        amplitude, truth, level = sample(kind)
        std = 0.1 * np.ones(60)
        fit = fit_curve(
            kind, KNOTS, 0.0, PointSample(amplitude, truth, std, level), fixed_first=3.0
        )
        np.testing.assert_allclose(fit.curve.values, VALUES, atol=1e-8 * VALUES.max())
        assert not np.asarray(fit.covariance)[0].any()
        assert not np.asarray(fit.covariance)[:, 0].any()
        wrong = fit_curve(
            kind, KNOTS, 0.0, PointSample(amplitude, truth, std, level), fixed_first=5.0
        )
        np.testing.assert_allclose(wrong.curve.values[0], 5.0, rtol=1e-15)
        assert abs(float(wrong.curve.values[1]) - 4.0) > 1e-3  # the next one gives way

    def test_the_penalised_fit_is_the_smallest_sum(self):
        """Piecewise linear, a linear problem: against stacked least squares by numpy."""
        amplitude, truth, level = sample("piecewise_linear")
        rng = np.random.default_rng(2)
        values, std = truth + 0.1 * rng.normal(size=60), rng.uniform(0.05, 0.2, 60)
        fit = fit_curve("piecewise_linear", KNOTS, 1e-3, PointSample(amplitude, values, std, level))
        hats = np.stack([np.interp(amplitude, KNOTS, column) for column in np.eye(6)], axis=1)
        # ∫(g″)² over the knots scaled to 0…1, g″ from the parabola through three neighbours,
        # against what the points tell about one knot on average.
        u, rough = (KNOTS - KNOTS[0]) / (KNOTS[-1] - KNOTS[0]), []
        for k in range(4):
            near = slice(k, k + 3)
            curvature = [2 * np.polyfit(u[near], column[near], 2)[0] for column in np.eye(6)]
            rough.append(np.sqrt((u[k + 2] - u[k]) / 2) * np.array(curvature))
        rough = np.sqrt(1e-3 * np.sum(1 / std**2) / 6) * np.array(rough)
        stacked = np.concatenate([hats / std[:, None], rough])
        right = np.concatenate([values / std, np.zeros(4)])
        best = np.linalg.lstsq(stacked, right, rcond=None)[0]
        # The normal equations square a condition number below 1e3.
        np.testing.assert_allclose(fit.curve.values, best, rtol=1e-9)

    @both_kinds
    def test_much_smoothing_is_a_line_in_the_abscissa(self, kind):
        amplitude, truth, level = sample(kind)
        std = np.random.default_rng(2).uniform(0.05, 0.2, 60)
        fit = fit_curve(kind, KNOTS, 1e9, PointSample(amplitude, truth, std, level))
        power = 2 if kind == "spline" else 1
        line = np.polyfit(amplitude**power, truth, 1, w=1 / std)
        # The curve gives way by 1e-9 of its bending, the spline once more where it is flat.
        np.testing.assert_allclose(fit.curve.values, np.polyval(line, KNOTS**power), rtol=1e-5)

    @pytest.mark.parametrize("smoothing", [1e-8, 1e-2, 1e6])
    def test_smoothing_leaves_a_duffing_backbone_as_it_is(self, smoothing):
        # A thousandfold range of amplitudes, knots 6e-8 of their range apart: the penalty is
        # 1e14 times as stiff as the points, and nothing against a line.
        amplitude = np.geomspace(1.0, 1000.0, 120)
        level = np.repeat(np.arange(12), 10)
        knots = place_knots(amplitude, level, 60)
        assert len(knots) == 60
        values = 1e4 * (1 + 0.5 * (amplitude / 1000) ** 2)
        fit = fit_curve(
            "spline", knots, smoothing, PointSample(amplitude, values, np.ones(120), level)
        )
        truth = 1e4 * (1 + 0.5 * (knots / 1000) ** 2)
        # Rounding times the ratio of the penalty and the points.
        np.testing.assert_allclose(fit.curve.values, truth, rtol=1e-4)

    @both_kinds
    def test_covariance_against_monte_carlo(self, kind):
        values = np.array([3.0, 4.0, 4.6, 6.5, 8.0, 8.5])
        amplitude, truth, level = sample(kind, values)
        rng = np.random.default_rng(3)
        std = rng.uniform(0.02, 0.06, 60)
        sizes = ErrorSizes(noise_scale=1.5, level_std=0.05)
        found = []
        for _ in range(400):
            error = 1.5 * std * rng.normal(size=60) + 0.05 * rng.normal(size=6)[level]
            found.append(
                np.asarray(
                    fit_curve(
                        kind, KNOTS, 1e-6, PointSample(amplitude, truth + error, std, level)
                    ).curve.values
                )
            )
        points = PointSample(amplitude, truth, std, level)
        fit = fit_curve(kind, KNOTS, 1e-6, points, sizes=sizes)
        # An error that levels are known to share counts as one that was found: here as two halves.
        halves = points._replace(shared=np.full((60, 2), 0.05 / np.sqrt(2)))
        known = fit_curve(kind, KNOTS, 1e-6, halves, sizes=ErrorSizes(1.5, 0.0))
        np.testing.assert_allclose(known.covariance, fit.covariance, rtol=1e-9, atol=1e-15)
        # 400 draws know a standard deviation to 3.5 %; four of them, and the spline's curvature.
        np.testing.assert_allclose(
            np.sqrt(np.diag(fit.covariance)), np.std(found, axis=0, ddof=1), rtol=0.15
        )

    def test_units(self):
        amplitude, truth, level = sample("spline")
        noisy = truth + 0.1 * np.random.default_rng(4).normal(size=60)
        std = 0.1 * np.ones(60)
        plain = fit_curve("spline", KNOTS, 1e-3, PointSample(amplitude, noisy, std, level))
        scaled = fit_curve(
            "spline",
            1e-6 * KNOTS,
            1e-3,
            PointSample(1e-6 * amplitude, 1e5 * noisy, 1e5 * std, level),
        )
        # Gauss-Newton steps end below 1e-9 of the largest value.
        np.testing.assert_allclose(scaled.curve.values, 1e5 * plain.curve.values, rtol=1e-7)
        np.testing.assert_allclose(scaled.covariance, 1e10 * plain.covariance, rtol=1e-5)


class TestLeftOut:
    def test_exact_points_are_predicted(self):
        amplitude = np.linspace(0.2, 2.0, 40)
        level, values = np.repeat(np.arange(8), 5), 2.0 + 3.0 * amplitude
        left = predict_left_out(
            "piecewise_linear",
            np.array([0.2, 2.0]),
            0.0,
            PointSample(amplitude, values, np.ones(40), level),
        )
        assert left.score < 1e-20  # rounding
        assert left.sizes.noise_scale < 1e-10
        assert left.sizes.level_std < 1e-10

    def test_errors_are_those_of_the_points_that_were_left_out(self):
        # A constant through levels 0 and 2; level 1 lies 0.5 above it and scatters by 0.1.
        amplitude = np.array([1.0, 4.0, 2.0, 3.0, 1.0, 4.0])
        level = np.array([0, 0, 1, 1, 2, 2])
        values = np.array([1.0, 1.0, 1.6, 1.4, 1.0, 1.0])
        std = np.full(6, 0.1)
        arguments = ("piecewise_linear", np.array([1.0, 4.0]), 0.0)
        left = predict_left_out(*arguments, PointSample(amplitude, values, std, level))
        # Levels 0 and 2 are predicted by the line through the others: 1.0 at 1 and 4 from
        # themselves and 1.5 ± 0.1 between; done by numpy.
        squares = []
        for one in range(3):
            kept = level != one
            line = np.polyfit(amplitude[kept], values[kept], 1)
            error = values[~kept] - np.polyval(line, amplitude[~kept])
            squares.append(np.mean((error / 0.1) ** 2))
        np.testing.assert_allclose(left.score, np.mean(squares), rtol=1e-10)  # rounding

    def test_a_level_that_nothing_predicts_does_not_decide(self):
        amplitude = np.linspace(0.2, 2.0, 40)
        level, values = np.repeat(np.arange(8), 5), np.where(np.arange(40) // 5 == 4, 60.0, 10.0)
        knots = amplitude[2::5].copy()
        knots[0], knots[-1] = 0.2, 2.0
        arguments = ("piecewise_linear", knots, 1e-8)
        points = PointSample(amplitude, values, np.ones(40), level)
        left = predict_left_out(*arguments, points)
        # The level itself misses by 50, its neighbours by less; a mean would be 50²/8 or more.
        assert left.score < 50**2 / 8

    def test_levels_that_only_a_continued_curve_reaches_are_left_aside(self):
        amplitude, level = np.array([1.0, 1.1, 2.0, 2.1]), np.array([0, 0, 1, 1])
        left = predict_left_out(
            "piecewise_linear",
            np.array([1.0, 2.1]),
            0.0,
            PointSample(amplitude, amplitude, np.ones(4), level),
        )
        assert left.score == np.inf
        assert left.sizes == AS_STATED


class TestPlaceKnots:
    def test_a_level_held_at_one_amplitude_gets_one_knot(self):
        held = np.array([1.0, 2.0, 4.0])
        amplitude = (held[:, None] * [0.98, 0.99, 1.0, 1.01, 1.02]).ravel()
        knots = place_knots(amplitude, np.repeat([1, 2, 3], 5), 60)
        np.testing.assert_allclose(knots, [0.98, 2.0, 4.08])  # the ends enclose all points

    def test_a_level_that_sweeps_amplitudes_gets_knots_of_its_own(self):
        amplitude = np.linspace(1.0, 2.0, 30)
        knots = place_knots(amplitude, np.ones(30), 60)
        assert 15 < len(knots) <= 30
        assert (knots[1:-1] / knots[:-2] >= 1.03).all()

    def test_one_amplitude_is_one_knot(self):
        np.testing.assert_array_equal(place_knots(np.full(4, 2.0), np.arange(4), 5), [2.0])

    @settings(max_examples=200, deadline=None, derandomize=True)
    @given(
        amplitude=st.lists(st.floats(1e-6, 1e3), min_size=1, max_size=40),
        levels=st.integers(1, 8),
        n_knots=st.integers(1, 60),
    )
    def test_knots_enclose_the_points_and_increase(self, amplitude, levels, n_knots):
        amplitude = np.asarray(amplitude)
        knots = place_knots(amplitude, np.arange(amplitude.size) % levels, n_knots)
        assert (np.diff(knots) > 0).all()
        assert (knots[0], knots[-1]) == (amplitude.min(), amplitude.max())
        assert len(knots) <= max(n_knots, 2)


def test_what_knots_leave_open_is_the_distance_of_a_smoother_curve():
    curve, inside = curve_of("spline"), INSIDE**2
    off = CubicSpline(KNOTS**2, VALUES)(inside) - PchipInterpolator(KNOTS**2, VALUES)(inside)
    np.testing.assert_allclose(between_knots_on_host(curve, INSIDE), off, atol=1e-12)
    np.testing.assert_allclose(curve.between_knots(jnp.asarray(INSIDE)), off, atol=1e-12)
    for other in (curve_of("piecewise_linear"), curve_of("spline", KNOTS[:3], VALUES[:3])):
        np.testing.assert_array_equal(between_knots_on_host(other, INSIDE), 0.0)
        np.testing.assert_array_equal(other.between_knots(jnp.asarray(INSIDE)), 0.0)


def test_errors_grow_where_points_are_farther_off_than_stated():
    amplitude, level = np.linspace(0.2, 2.0, 400), np.arange(400) % 4
    noise = np.random.default_rng(3).standard_normal(400) * np.where(amplitude > 1.2, 0.04, 0.01)
    knots = np.linspace(0.2, 2.0, 21)
    points = PointSample(amplitude, 1 + amplitude**2 + noise, np.full(400, 0.01), level)
    stated, grown = (
        np.sqrt(np.diag(fit_curve("spline", knots, 1e-12, points, own_misfit=own).covariance))
        for own in (False, True)
    )
    ratio = grown / stated
    # Residuals of some 60 points about a knot tell a scale within 10 % (1σ).
    assert ((ratio[:7] >= 1.0) & (ratio[:7] < 1.3)).all()
    np.testing.assert_allclose(ratio[-5:], 4.0, rtol=0.3)
