"""Continuation on curves whose points, folds and ends are known exactly."""

import dataclasses
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from snrmjax.numerics.newton import correct, solve_appended
from snrmjax.simulate.continuation.continuation import (
    CurveRange,
    CurveStatus,
    StepControl,
    trace_curve,
)
from snrmjax.simulate.continuation.event_location import EventSearch

STEPS = StepControl()


def s_curve(point):
    """λ = x³ − x: folds at x = ±1/√3, λ = ∓2/(3√3)."""
    x, lam = point
    return jnp.array([x**3 - x - lam]), jnp.array([[3 * x**2 - 1, -1.0]])


def circle(point):
    """x² + λ² = 1."""
    return jnp.array([point @ point - 1.0]), 2 * point[None]


def pole(point):
    """x (1 − λ) = 1: grows without bound below λ = 1."""
    x, lam = point
    return jnp.array([x * (1 - lam) - 1]), jnp.array([[1 - lam, -x]])


def broken(point):
    """x = λ, which becomes NaN beyond λ = 0.5."""
    x, lam = point
    bad = jnp.where(lam > 0.5, jnp.nan, 0.0)
    return jnp.array([x - lam + bad]), jnp.array([[1.0, -1.0]])


def nothing(point):
    """x² + 1 = 0: no solution."""
    x, _ = point
    return jnp.array([x**2 + 1]), jnp.array([[2 * x, 0.0]])


def isola(point):
    """An isolated loop: an ellipse, x²/0.09 + (λ − 1)²/0.25 = 1."""
    x, lam = point
    value = x**2 / 0.09 + (lam - 1) ** 2 / 0.25 - 1
    return jnp.array([value]), jnp.array([[2 * x / 0.09, 2 * (lam - 1) / 0.25]])


def corner(point):
    """x = ½|λ − 0.3|: a corner, at which the tangent rotates by 2 atan ½."""
    x, lam = point
    side = jnp.where(lam > 0.3, 0.5, -0.5)
    return jnp.array([x - side * (lam - 0.3)]), jnp.stack([jnp.ones(()), -side])[None]


PROBLEMS = (s_curve, circle, pole, broken, nothing, isola, corner)


@jax.jit
def compiled(which, start, direction, within, across, steps):
    """All problems in one program, selected by a number, so that it compiles once."""

    def problem(point):
        return jax.lax.switch(which, PROBLEMS, point)

    return trace_curve(problem, start, direction, within, steps, start_across=across)


def followed(
    problem,
    start,
    *,
    direction=(0.0, 1.0),
    ends=(-2.0, 2.0),
    limit=np.inf,
    steps=STEPS,
    max_points=800,
    across=(0.0, 1.0),
):
    start, direction, across = (jnp.asarray(part) for part in (start, direction, across))
    within = CurveRange(*ends, limit)
    steps = dataclasses.replace(steps, max_points=max_points)
    curve = compiled(PROBLEMS.index(problem), start, direction, within, across, steps)
    n = int(curve.n_points)
    followed.n_solves = int(curve.n_solves)
    assert np.all(np.isfinite(curve.points[:n]))
    assert np.all(np.isfinite(curve.tangents[:n]))
    assert np.all(np.isnan(curve.points[n:]))  # NaN after the last point
    return (
        np.asarray(curve.points)[:n],
        np.asarray(curve.tangents)[:n],
        CurveStatus(int(curve.status)),
    )


@pytest.fixture(scope="module")
def s_points():
    return followed(s_curve, [-1.0, -2.0])


def test_points_lie_on_the_curve_and_tangents_along_it(s_points):
    points, tangents, status = s_points
    assert status == CurveStatus.UPPER_END
    x, lam = points.T
    # Newton's method ends when the remaining error is below the tolerance.
    np.testing.assert_allclose(x**3 - x, lam, atol=5 * STEPS.tolerance)  # slopes up to 5
    np.testing.assert_allclose(np.linalg.norm(tangents, axis=1), 1.0, rtol=1e-14)
    # From the previous Newton iterate: off by up to the root of 1e-9 times λ'' = 9.
    exact = np.stack([np.ones_like(x), 3 * x**2 - 1], axis=1)
    exact /= np.linalg.norm(exact, axis=1, keepdims=True)
    np.testing.assert_allclose(tangents, exact, atol=1e-3)


def test_ends_lie_on_the_ends_of_the_range(s_points):
    points, _, _ = s_points
    assert points[0, 1] == -2.0
    assert points[-1, 1] == 2.0
    # The real roots of x³ − x ∓ 2 = 0.
    root = max(np.roots([1, 0, -1, -2]), key=lambda r: r.real).real
    assert points[-1, 0] == pytest.approx(root, abs=STEPS.tolerance)
    assert points[0, 0] == pytest.approx(-root, abs=STEPS.tolerance)
    assert np.all(np.abs(points[1:-1, 1]) < 2.0)


def test_steps_keep_to_their_limits(s_points):
    points, tangents, _ = s_points
    rotation = np.arccos(np.clip(np.sum(tangents[1:] * tangents[:-1], axis=1), -1, 1))
    assert rotation.max() < 3 * STEPS.angle
    length = np.linalg.norm(np.diff(points, axis=0), axis=1)
    # A step is measured along the tangent; the chord is longer by at most 1/cos(rotation).
    assert length.max() <= STEPS.largest / np.cos(3 * STEPS.angle)
    assert np.median(length) > 0.5 * STEPS.largest  # and the steps do grow to the largest
    # In order along the curve, both folds passed.
    assert np.all(np.diff(points[:, 0]) > 0)
    assert np.sum(np.diff(np.sign(np.diff(points[:, 1]))) != 0) == 2


@jax.jit
def located_fold(here, tangent, there):
    return EventSearch(s_curve, lambda _, t: t[-1], here, tangent, there, STEPS).ended()


@pytest.mark.parametrize("sign", [-1, 1])
def test_folds_are_located(s_points, sign):
    points, tangents, _ = s_points
    fold = sign / np.sqrt(3)
    k = int(np.searchsorted(points[:, 0], fold)) - 1
    search = located_fold(points[k], tangents[k], points[k + 1])
    found, tangent = search.last.point, search.last.tangent
    assert bool(search.resolved)
    assert not bool(search.missed)
    # Newton to 1e-11; the tangent's component along λ is then 6x·δx/(3x²−1…) of that order.
    np.testing.assert_allclose(found, [fold, fold**3 - fold], atol=1e-10)
    assert abs(float(tangent[-1])) < 1e-10
    # Without an event none is resolved and none is missed.
    search = located_fold(points[k + 5], tangents[k + 5], points[k + 6])
    assert not bool(search.resolved)
    assert not bool(search.missed)


def test_a_coarse_curve_and_a_fine_one_agree(s_points):
    fine, _, status = followed(
        s_curve,
        [-1.0, -2.0],
        steps=StepControl(first=1e-3, largest=4e-3, angle=0.008),
        max_points=4000,
    )
    assert status == CurveStatus.UPPER_END
    assert len(fine) > 8 * len(s_points[0])
    lam = np.interp(s_points[0][:, 0], fine[:, 0], fine[:, 1])
    # Linear interpolation: h²/8·λ'' = (4e-3)²/8·9.
    np.testing.assert_allclose(s_points[0][:, 1], lam, atol=2e-5)


# ---------------------------------------------------------------------------------- every status


def test_a_curve_that_is_too_long_ends_at_the_point_limit():
    points, _, status = followed(circle, [-0.8, -0.6], max_points=25)
    assert status == CurveStatus.POINT_LIMIT
    assert len(points) == 25
    np.testing.assert_allclose(np.linalg.norm(points, axis=1), 1.0, atol=STEPS.tolerance)


@pytest.mark.parametrize("largest", [0.01, 0.05, 0.3])
@pytest.mark.parametrize("direction", [(0.0, 1.0), (0.0, -1.0)])
@pytest.mark.parametrize(("problem", "start"), [(circle, (-0.8, -0.6)), (isola, (0.2, 1.1))])
def test_a_loop_is_followed_once(problem, start, direction, largest):
    points, _, status = followed(
        problem, start, direction=direction, steps=StepControl(largest=largest)
    )
    assert status == CurveStatus.CLOSED
    np.testing.assert_array_equal(points[-1], points[0])
    centre, axes = ((0, 0), (1, 1)) if problem is circle else ((0, 1), (0.3, 0.5))
    x, lam = ((points - centre) / axes).T
    np.testing.assert_allclose(np.hypot(x, lam), 1.0, atol=1e-8)
    angle = np.unwrap(np.arctan2(lam, x))
    way = np.sign(angle[1] - angle[0])
    # Once around, every point once and in sequence, the last step no longer than the others.
    assert angle[-1] - angle[0] == pytest.approx(way * 2 * np.pi, abs=1e-6)
    assert np.all(way * np.diff(angle) > 0)
    length = np.linalg.norm(np.diff(points, axis=0), axis=1)
    assert length.max() < 1.1 * largest
    assert len(np.unique(points[:-1].round(9), axis=0)) == len(points) - 1


def test_a_corner_is_passed():
    points, tangents, status = followed(corner, [0.65, -1.0], ends=(-1.0, 1.5))
    assert status == CurveStatus.UPPER_END
    np.testing.assert_allclose(points[:, 0], 0.5 * np.abs(points[:, 1] - 0.3), atol=1e-9)
    assert np.all(np.diff(points[:, 1]) > 0)  # never back
    # Steps are small only near the corner, and grow again after it.
    near = np.abs(points[:, 1] - 0.3) < 0.02
    assert np.min(np.abs(points[near, 1] - 0.3)) < STEPS.corner_step
    assert np.linalg.norm(np.diff(points[-5:-1], axis=0), axis=1).max() > 0.9 * STEPS.largest
    np.testing.assert_allclose(tangents[-1], np.array([0.5, 1.0]) / np.hypot(0.5, 1.0), atol=1e-9)


def test_tolerance_is_honoured_and_costs_solves():
    errors, solves = [], []
    for tolerance in (1e-3, 1e-6, 1e-9, 1e-13):
        points, _, status = followed(
            s_curve, [-1.0, -2.0], steps=StepControl(tolerance=tolerance, largest=0.2)
        )
        assert status == CurveStatus.UPPER_END
        x, lam = points.T
        # The residual over its slope is the distance from the curve.
        distance = np.abs(x**3 - x - lam) / np.hypot(3 * x**2 - 1, 1)
        errors.append(distance.max())
        solves.append(followed.n_solves / len(points))
        # The remaining error is estimated from the reduction of the residual in the last step.
        assert errors[-1] <= 2 * tolerance
    assert errors[0] > 1e-9  # no superfluous solves
    assert solves[0] < solves[1] < solves[2] < solves[3]


def test_solves_are_counted():
    calls = []

    def counted(point):
        jax.debug.callback(lambda _: calls.append(1), point[0])
        return circle(point)

    @jax.jit
    def run(start):
        return trace_curve(counted, start, jnp.array([0.0, 1.0]), CurveRange(-2.0, 2.0), STEPS)

    curve = run(jnp.array([-0.8, -0.6]))
    jax.effects_barrier()
    # Each factorisation evaluates the matrix, and the residual after its step.
    assert len(calls) == 2 * int(curve.n_solves)
    assert int(curve.n_solves) >= int(curve.n_points) > 50


def test_a_curve_that_turns_back_ends_at_the_lower_end():
    points, _, status = followed(circle, [-0.8, -0.6], ends=(-0.6, 2.0))
    assert status == CurveStatus.LOWER_END
    np.testing.assert_allclose(points[0], [-0.8, -0.6], atol=STEPS.tolerance)
    np.testing.assert_allclose(points[-1], [0.8, -0.6], atol=STEPS.tolerance)


def test_a_curve_that_grows_ends_at_the_amplitude_limit():
    points, _, status = followed(pole, [1.0, 0.0], limit=5.0)
    assert status == CurveStatus.AMPLITUDE_LIMIT
    assert 5.0 < points[-1, 0] < 5.0 + 2 * STEPS.largest
    assert np.all(points[:-1, 0] <= 5.0)
    np.testing.assert_allclose(points[:, 0] * (1 - points[:, 1]), 1.0, atol=6 * STEPS.tolerance)


def test_an_equation_that_fails_ends_with_too_small_a_step():
    points, _, status = followed(broken, [0.0, 0.0])
    assert status == CurveStatus.STEP_TOO_SMALL
    np.testing.assert_allclose(points[:, 0], points[:, 1], atol=1e-12)
    assert points[-1, 1] <= 0.5
    assert points[-1, 1] == pytest.approx(0.5, abs=2 * STEPS.smallest)


def test_an_equation_without_solution_has_no_start():
    points, _, status = followed(nothing, [0.3, 0.0])
    assert status == CurveStatus.NO_START
    assert points.shape == (0, 2)


def test_a_start_may_be_corrected_at_fixed_amplitude():
    points, tangents, _ = followed(circle, [0.3, 0.9], direction=[1.0, 0.0], across=[1.0, 0.0])
    assert points[0, 0] == pytest.approx(0.3, abs=1e-14)
    assert points[0, 1] == pytest.approx(np.sqrt(1 - 0.09), abs=STEPS.tolerance)
    assert tangents[0, 0] > 0


@pytest.mark.parametrize("max_points", [-1, 0, 1])
def test_a_curve_has_two_points(max_points):
    with pytest.raises(ValueError, match=f"`max_points` must be 2 or more, but is {max_points}"):
        followed(circle, [-0.8, -0.6], max_points=max_points)


# ----------------------------------------------------------------------------------- correction


def test_correction_stays_in_its_plane_and_reports_failure():
    start, across = jnp.array([-0.7, 0.9]), jnp.array([0.6, 0.8])
    found = correct(circle, start, across, 1e-8, 20)
    point = found.point
    assert bool(found.converged)
    assert 2 <= int(found.n_solves) <= 8
    # The exact point where the line 0.6x + 0.8λ = 0.3 meets the circle.
    exact = 0.3 * np.array([0.6, 0.8]) + np.sqrt(1 - 0.3**2) * np.array([-0.8, 0.6])
    np.testing.assert_allclose(point, exact, rtol=0, atol=1e-8)  # the tolerance asked for
    assert float(across @ (point - start)) == pytest.approx(0.0, abs=1e-14)
    # The tangent is that of the previous iterate: off by the root of the tolerance.
    assert float(found.tangent @ point) == pytest.approx(0.0, abs=1e-4)
    assert float(found.tangent @ across) > 0
    converged = correct(circle, start, across, 1e-8, 2).converged  # too few iterations
    assert not bool(converged)
    # The line 0.6x + 0.8λ = 1.06 passes the circle by.
    converged = correct(circle, jnp.array([0.9, 0.65]), across, 1e-8, 40).converged
    assert not bool(converged)
    converged = correct(broken, jnp.array([0.6, 0.6]), across, 1e-8, 20).converged
    assert not bool(converged)


def test_batched_matrices_are_factorised_one_by_one():
    # Batched factorisations may deadlock in two threads (jaxlib 0.10).
    matrices = np.random.default_rng(0).normal(size=(3, 5, 7))
    columns = np.swapaxes(matrices, 1, 2)
    found = jax.vmap(solve_appended)(columns)
    exact = np.linalg.solve(matrices[:, :, :5], matrices[:, :, 5:])
    np.testing.assert_allclose(np.swapaxes(found, 1, 2), exact, rtol=1e-12, atol=1e-13)
    # Under a further `vmap` too.
    together = jax.vmap(solve_appended)
    for solve, given in ((together, columns), (jax.vmap(together), columns[None])):
        program = str(jax.make_jaxpr(solve)(given))
        sizes = re.findall(r"f64\[([\d,]+)\] \w+:i32\[[\d,]+\] \w+:i32\[[\d,]+\] = lu", program)
        assert sizes == ["5,7"]
        assert "scan" in program  # over the three
