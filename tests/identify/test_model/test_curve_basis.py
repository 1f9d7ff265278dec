"""Curves as sums of functions: natural cubic splines in a² with a prior on their roughness."""

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from snrmjax.identify.test_model.curve_basis import MOST_KNOTS, N_POWERS, CurveBasis
from snrmjax.identify.test_model.priors import CURVE_CONSTANT, CURVE_SLOPES, ROUGHNESS_LENGTH

AMPLITUDE = 2e-3 * np.geomspace(0.02, 1, 60)


@pytest.fixture(scope="module")
def basis():
    return CurveBasis.of(AMPLITUDE)


def test_any_values_at_the_knots_are_followed_by_the_natural_spline(basis):
    rng = np.random.default_rng(0)
    unknowns = rng.normal(size=basis.n_functions)
    at_knots = basis.values(2e-3 * np.sqrt(basis.knots))[0] @ unknowns
    spline = CubicSpline(basis.knots, at_knots, bc_type="natural")
    inside = np.sqrt(np.linspace(0.0, basis.knots[-1], 301))
    found = basis.values(2e-3 * inside)[0] @ unknowns
    np.testing.assert_allclose(found, spline(inside**2), atol=1e-9 * np.abs(at_knots).max())
    assert 0.7 * MOST_KNOTS < np.sum(basis.knots <= 1.0) <= MOST_KNOTS
    assert basis.n_functions == len(basis.knots)


def test_beyond_the_knots_a_curve_is_straight_over_the_squared_amplitude(basis):
    u = np.array([1.7, 2.0, 5.0])
    unknowns = np.random.default_rng(1).normal(size=basis.n_functions)
    values = basis.values(2e-3 * np.sqrt(u))[0] @ unknowns
    slope = np.diff(values) / np.diff(u)
    assert slope[0] == pytest.approx(slope[1], rel=1e-9)


def test_slopes_are_finite_differences(basis):
    amplitude, step = 2e-3 * np.array([0.004, 0.03, 0.1, 0.4, 0.9, 1.3]), 1e-5
    _, slopes = basis.values(amplitude)
    ends = [basis.values(amplitude * np.exp(sign * step))[0] for sign in (1, -1)]
    np.testing.assert_allclose(slopes, (ends[0] - ends[1]) / (2 * step), rtol=1e-5, atol=1e-6)


def test_roughness_is_the_distance_from_the_chord_between_the_neighbours(basis):
    """For knots far apart, whose mean spacing in log amplitude is one unit each."""
    own = CurveBasis.of(np.array([0.2, 0.4, 0.8]))
    values = own.values(0.8 * np.sqrt(own.knots))[0]
    for k in range(1, len(own.knots) - 1):
        left, here, right = own.knots[k - 1 : k + 2]
        fraction = (here - left) / (right - left)
        off = values[k] - (1 - fraction) * values[k - 1] - fraction * values[k + 1]
        # One function moves this knot off the chord, and no other.
        assert np.count_nonzero(np.abs(off[N_POWERS:]) > 1e-9) == 1
        assert np.allclose(off[:N_POWERS], 0.0, atol=1e-12)


def test_roughness_is_correlated_over_two_knots(basis):
    covariance = basis.directions @ basis.directions.T
    apart = np.subtract.outer(np.arange(len(covariance)), np.arange(len(covariance)))
    np.testing.assert_allclose(
        covariance, np.exp(-0.5 * (apart / ROUGHNESS_LENGTH) ** 2), atol=1e-4
    )


def test_log_variances_are_linear_in_the_log_roughness(basis):
    rng = np.random.default_rng(2)
    along = rng.normal(size=basis.directions.shape[1])
    constant, slopes = basis.log_variances()
    log_variance = constant + slopes @ [np.log(0.02), *along]
    assert np.exp(0.5 * log_variance[:N_POWERS]) == pytest.approx([CURVE_CONSTANT, CURVE_SLOPES])
    expected = 2 * (np.log(0.02) + basis.directions @ along)
    assert log_variance[N_POWERS:] == pytest.approx(expected)


@pytest.mark.parametrize("amplitude", [[1.0, 1.0], [0.5, 0.51, 1.0], [1e-6, 1.0]])
def test_few_amplitudes_suffice(amplitude):
    own = CurveBasis.of(np.array(amplitude))
    assert own.n_functions == len(own.knots) >= 2
    assert np.all(np.isfinite(own.values(np.array(amplitude))[0]))


def test_crowded_knots_are_dense_where_states_cluster():
    wall = np.concatenate([np.geomspace(1e-5, 1e-3, 40), np.linspace(0.96e-3, 1e-3, 40)])
    even, crowded = (CurveBasis.of(wall, crowded=one) for one in (False, True))
    inside = [np.sqrt(basis.knots) for basis in (even, crowded)]
    near = [int(np.sum((knots > 0.955) & (knots < 1.01))) for knots in inside]
    assert near[0] == 1  # at the largest amplitude: others are a tenth apart
    assert near[1] >= 7
    assert np.min(np.diff(np.log(inside[1][1:]))) > np.log(1.003) - 1e-12
