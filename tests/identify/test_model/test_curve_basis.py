"""Curves as sums of functions: their covariance is that of a Matérn process between its mirrors."""

import numpy as np
import pytest

from snrmjax.identify.test_model.curve_basis import _ROOM, LENGTHS, N_POWERS, CurveBasis
from snrmjax.identify.test_model.priors import CURVE_CONSTANT, CURVE_SLOPES

SIZE = 0.01


def matern(distance, length):
    """Matérn 5/2 of unit variance."""
    d = np.sqrt(5) * np.abs(distance) / length
    return (1 + d + d**2 / 3) * np.exp(-d)


def covariances(smallest, length):
    """Of the process as the functions have it, between images, and without any boundary."""
    amplitude = 2e-3 * np.geomspace(smallest, 1, 80)
    basis = CurveBasis.of(amplitude)
    values, span = basis.values(amplitude)[0], basis.high - basis.low
    log_variance, _ = basis.log_variances(np.log(SIZE), np.log(length))
    x = np.log(amplitude / amplitude.max() + basis.floor)
    own = SIZE**2 * matern(x[:, None] - x, length * span)
    images, wide = np.zeros_like(own), _ROOM * span
    mirror = 0.5 * (basis.low + basis.high) - 0.5 * wide
    for n in range(-9, 10):  # a process that is zero at both ends: odd about each of them
        images += matern(x[:, None] - x + 2 * n * wide, length * span)
        images -= matern(x[:, None] + x - 2 * mirror + 2 * n * wide, length * span)
    processes = values[:, N_POWERS:]
    found = (processes * np.exp(log_variance[N_POWERS:])) @ processes.T
    return found, SIZE**2 * images, own, values[:, :N_POWERS]


@pytest.mark.parametrize("smallest", [0.001, 0.05, 0.5])
@pytest.mark.parametrize("length", [LENGTHS[0], 0.7, 1.5])
def test_the_process_is_a_matern_process_between_its_mirrors(smallest, length):
    found, images, _, _ = covariances(smallest, length)
    # The sines that are left out have at most 0.06 of the variance, at the shortest length.
    share = 0.07 if length == LENGTHS[0] else 2e-3
    np.testing.assert_allclose(found, images, rtol=0, atol=share * SIZE**2)


@pytest.mark.parametrize("smallest", [0.05, 0.5])
@pytest.mark.parametrize("length", [LENGTHS[0], 0.7])
def test_beside_the_parabola_the_boundary_is_not_seen(smallest, length):
    """Root-mean-square size of what constant, a and a² do not follow, inside the range."""
    found, _, own, powers = covariances(smallest, length)
    basis = np.linalg.qr(powers)[0]
    beside = np.eye(len(own)) - basis @ basis.T
    sizes = [np.sqrt(np.trace(beside @ one @ beside)) for one in (found, own)]
    assert sizes[0] == pytest.approx(sizes[1], rel=0.07)


def test_slopes_are_finite_differences():
    amplitude = 2e-3 * np.array([0.004, 0.02, 0.1, 0.4, 0.9, 1.0])
    basis, step = CurveBasis.of(amplitude), 1e-5
    _, slopes = basis.values(amplitude)
    ends = [basis.values(amplitude * np.exp(sign * step))[0] for sign in (1, -1)]
    # The fastest sine turns by 50 rad over the range: 50³ step²/6.
    np.testing.assert_allclose(slopes, (ends[0] - ends[1]) / (2 * step), rtol=1e-5, atol=2e-5)
    at = np.log([0.02, 0.6])
    _, by = basis.log_variances(*at)
    for k, unit in enumerate(step * np.eye(2)):
        ends = [basis.log_variances(*(at + sign * unit))[0] for sign in (1, -1)]
        np.testing.assert_allclose(by[:, k], (ends[0] - ends[1]) / (2 * step), atol=1e-7)


def test_powers_keep_priors_of_their_own():
    basis = CurveBasis.of(np.geomspace(1e-4, 2e-3, 9))
    log_variance, _ = basis.log_variances(np.log(SIZE), np.log(0.7))
    std = np.exp(0.5 * log_variance[:N_POWERS])
    assert std == pytest.approx([CURVE_CONSTANT, CURVE_SLOPES, CURVE_SLOPES])
    values, _ = basis.values(np.array([1e-3, 2e-3]))
    assert values[:, :N_POWERS] == pytest.approx(np.array([[1, 0.5, 0.25], [1, 1, 1]]))


def test_one_amplitude_has_a_range_too():
    basis = CurveBasis.of(np.full(5, 1e-3))
    assert basis.high > basis.low
    for part in basis.values(np.array([1e-3, 1e-5, 1e-1])):
        assert np.all(np.isfinite(part))
