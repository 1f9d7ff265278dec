"""The batched Levenberg–Marquardt against SciPy's solver, and each way that a fit can end."""

from typing import NamedTuple

import numpy as np
import pytest
from scipy.optimize import least_squares

from snrmjax.numerics.levenberg_marquardt import MinimisationStatus, StepRule, minimise

TIME = np.linspace(0.0, 2.0, 40)
DATA = 2.0 * np.exp(-1.3 * TIME) + 0.01 * np.random.default_rng(0).normal(size=40)
ANYWHERE = (np.full(2, -np.inf), np.full(2, np.inf))
RULE = StepRule(steps=60, settled=1e-14)


class Point(NamedTuple):
    residuals: np.ndarray
    jacobian: np.ndarray


def decay(point):
    """A decay a·exp(−b t), not finite for b below zero."""
    amplitude, rate = point
    shape = np.exp(-rate * TIME) if rate >= 0 else np.full_like(TIME, np.nan)
    return Point(amplitude * shape - DATA, np.stack([shape, -amplitude * TIME * shape], axis=1))


def fitted(starts, rule=RULE, bounds=ANYWHERE):
    """Ends of fits, and how many points were evaluated in every call."""
    calls = []

    def evaluate(points):
        calls.append(len(points))
        return [decay(point) for point in points]

    starts = np.array(starts)
    return minimise(evaluate, starts, evaluate(starts), bounds, rule), calls[1:]


def test_every_start_ends_at_scipys_minimum():
    truth = least_squares(lambda p: decay(p).residuals, [1.0, 1.0], xtol=1e-15, ftol=1e-15)
    ends, _ = fitted([[1.0, 1.0], [5.0, 0.1], [0.2, 3.0]])
    for end in ends:
        # At a minimum of the sum of squares the point is known to half the digits.
        np.testing.assert_allclose(end.point, truth.x, rtol=1e-6)
        assert end.sum_of_squares == pytest.approx(2 * truth.cost, rel=1e-12)
        assert end.status in (MinimisationStatus.CONVERGED, MinimisationStatus.STALLED)


def test_bounds_hold():
    free, _ = fitted([[1.0, 2.0]])
    (end,), _ = fitted([[1.0, 2.0]], bounds=(np.array([-np.inf, 1.5]), np.full(2, np.inf)))
    assert free[0].point[1] < 1.5 == end.point[1]
    assert end.sum_of_squares < np.sum(decay([1.0, 2.0]).residuals ** 2)


def test_each_way_to_end_has_its_status():
    (short,), _ = fitted([[50.0, 0.01]], StepRule(steps=1, settled=1e-14))
    assert short.status == MinimisationStatus.STEP_LIMIT
    (lost, found), _ = fitted([[1.0, -1.0], [1.0, 1.0]])
    assert lost.status == MinimisationStatus.NOT_FINITE
    assert lost.sum_of_squares == np.inf
    assert found.status in (MinimisationStatus.CONVERGED, MinimisationStatus.STALLED)
    (done,), _ = fitted([[1.0, 1.0]], StepRule(steps=60, settled=1e-3))
    assert done.status == MinimisationStatus.CONVERGED
    (at_best,), _ = fitted([found.point], StepRule(steps=60, settled=1e-30, largest_damping=1e3))
    assert at_best.status in (MinimisationStatus.STALLED, MinimisationStatus.CONVERGED)
    assert not MinimisationStatus.STEP_LIMIT.found_minimum
    assert MinimisationStatus.STALLED.found_minimum


def test_starts_that_fall_behind_are_given_up():
    rule = StepRule(steps=40, settled=1e-14, screened=1, kept=1)
    ends, calls = fitted([[2.0, 1.3], [80.0, 6.0]], rule)
    assert ends[1].status == MinimisationStatus.GIVEN_UP
    assert calls[0] == 2
    assert set(calls[1:]) == {1}


def test_a_step_that_promises_too_little_is_not_evaluated():
    (best,), _ = fitted([[1.0, 1.0]])
    near = best.point * (1 + 1e-6)
    (end,), calls = fitted([near], StepRule(steps=9, settled=1e-6, trust_short_steps=True))
    assert calls == []
    assert end.status == MinimisationStatus.CONVERGED
    assert np.any(end.last_step)
    np.testing.assert_array_equal(end.point, near + end.last_step)
    # Marquardt's damping shortens the step by a thousandth.
    np.testing.assert_allclose(end.point, best.point, rtol=1e-8)
