"""Responses drawn from a measured mode, against harmonic balance and exact impedances."""

import numpy as np
import pytest

import snrmjax as sj
from snrmjax.methods.result import MethodPoint, MethodStatus, method_result

REST, RATIO, CUBIC, MASS = 2 * np.pi * 40.0, 0.01, 3e9, 0.8


@pytest.fixture(scope="module")
def modes():
    shape = 1 / np.sqrt(MASS)
    return sj.model.linear_modes([REST], [RATIO], [[-shape]], [shape])


@pytest.fixture(scope="module")
def duffing():
    """The exact mode of Duffing's oscillator by one term, with a lost point and a doubled one."""
    size = np.append(np.linspace(1e-4, 2e-3, 25), 1e-3)
    omega = np.sqrt(REST**2 + 0.75 * CUBIC * size**2)
    points = [
        MethodPoint(
            *(MethodStatus.FOUND, k, w * x, w),
            damping_ratio=RATIO * REST / w,
        )
        for k, (x, w) in enumerate(zip(size, omega, strict=True))
    ]
    return method_result("pll", [*points, MethodPoint(MethodStatus.NOT_LOCKED, 99)], 27)


def test_every_point_balances_the_force_and_the_unstable_part_is_between_the_folds(duffing, modes):
    (curve,) = sj.methods.synthesised_response(duffing, modes, 2.0)
    speed, omega = np.abs(curve.velocity), curve.frequency
    square = REST**2 + 0.75 * CUBIC * (speed / omega) ** 2 - omega**2
    needed = MASS * np.abs(2 * RATIO * REST + square / (1j * omega)) * speed
    np.testing.assert_allclose(needed, 2.0, rtol=1e-3)
    assert not curve.continued[speed > 0.03].any()
    lost = np.flatnonzero(~curve.stable)
    turns = np.flatnonzero(np.diff(np.sign(np.diff(omega))) != 0) + 1  # the two folds
    assert len(turns) == 2
    assert abs(lost[0] - turns[0]) <= 1
    assert abs(lost[-1] - turns[1]) <= 1
    assert len(lost) == lost[-1] - lost[0] + 1


def test_too_little_was_found(duffing, modes):
    empty = method_result("cbc", [MethodPoint(MethodStatus.NOT_LOCKED, 1)], 1)
    with pytest.raises(
        ValueError, match="two amplitudes or more to draw a response, but cbc found"
    ):
        sj.methods.synthesised_response(empty, modes, 1.0)
    with pytest.raises(ValueError, match="`force` must be positive"):
        sj.methods.synthesised_response(duffing, modes, 0.0)
