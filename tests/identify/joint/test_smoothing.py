"""The smoothing spline: its bends, their size, and bands that hold what lies between levels."""

import jax.numpy as jnp
import numpy as np
import pytest
from truths.exact_states import CONSTANT, NOISE, OMEGA, modes, stated
from truths.sizes import repeats

import snrmjax as sj
from snrmjax.identify.curves.splines import SmoothingSpline
from snrmjax.identify.inference.sensitivity import sensitivity
from snrmjax.identify.joint.joint_fit import fit_jointly
from snrmjax.identify.joint.smoothness import curve_columns, moved, with_sizes
from snrmjax.identify.joint.variance_components import (
    Bends,
    Linearised,
    estimated_components,
    likeliest_std,
)
from snrmjax.io.joint_results import described, read_joint_fit, write_joint_fit

KNOTS = np.array([0.0, 0.02, 0.05, 0.2, 0.3, 0.7, 1.0])


def curve(values, bend_std=1.0):
    """A smoothing spline through values at `KNOTS`."""
    drawn = SmoothingSpline.through(KNOTS, values, jnp.asarray(2.0), "displacement")
    return SmoothingSpline(**(vars(drawn) | {"bend_std": jnp.asarray(bend_std)}))


def test_a_straight_line_has_no_bends_and_a_corner_has_one():
    line = curve(3.0 - 2.0 * KNOTS)
    np.testing.assert_allclose(line.prior_residuals(), 0.0, atol=1e-12)
    corner = np.asarray(curve(np.maximum(KNOTS - 0.3, 0.0)).prior_residuals())
    assert np.flatnonzero(np.abs(corner) > 1e-9).tolist() == [3]  # the inner knot at 0.3
    wide, narrow = (np.asarray(curve(KNOTS**2, std).prior_residuals()) for std in (1.0, 0.1))
    np.testing.assert_allclose(narrow, 10 * wide, rtol=1e-12)


def test_its_line_and_bends_are_the_curve():
    rng = np.random.default_rng(0)
    values, at = rng.normal(size=7), np.linspace(0.1, 2.4, 30)
    smooth = curve(values, 0.3)
    columns = curve_columns(smooth, at)
    assert columns.prior_std.tolist() == [np.inf] * 2 + [0.3] * 5
    # The line alone, then as many bends as there were.
    change = np.concatenate([np.zeros(2), 0.3 * np.asarray(smooth.prior_residuals())])
    again = moved(smooth, change)
    np.testing.assert_allclose(again.parameters, values, atol=1e-12)
    np.testing.assert_allclose(columns.values + columns.slopes @ change, smooth(at), atol=1e-12)


def test_bends_of_their_own_sizes_are_alike_from_one_to_the_next():
    size = np.linspace(0.5, 2.0, len(KNOTS) - 2)
    blank = curve(np.cos(3 * KNOTS))
    bends = np.asarray(blank.bends @ blank.parameters)
    apart = np.subtract.outer(np.arange(len(size)), np.arange(len(size)))
    covariance = np.exp(-0.5 * (apart / 0.8) ** 2) * np.outer(size, size)
    found = np.sum(np.asarray(with_sizes(blank, size).prior_residuals()) ** 2)
    # Rounding of a matrix whose eigenvalues differ by a factor of 200.
    assert found == pytest.approx(bends @ np.linalg.solve(covariance, bends), rel=1e-10)


def drawn(seed, bend_std, noise, shared=0.0):
    """Readings of a curve of drawn bends at 16 levels, five each, with errors of levels."""
    rng = np.random.default_rng(seed)
    knots = np.linspace(0.1, 1.0, 17) ** 2
    knots[0] = 0.0
    blank = SmoothingSpline.through(knots, np.zeros(17), jnp.asarray(1.0), "displacement")
    level = np.repeat(np.arange(16), 5)
    parts = curve_columns(blank, np.sqrt(knots[1:])[level])
    bends = bend_std * rng.normal(size=15)
    members = (level[:, None] == np.arange(16)).astype(float)
    own = shared * rng.normal(size=16)
    residuals = parts.slopes @ np.r_[1.0, -0.5, bends] + members @ own
    residuals = (residuals + noise * rng.normal(size=80)) / noise
    slopes = np.column_stack([parts.slopes, members]) / noise
    std = np.r_[np.full(2, np.inf), np.full(15, 1.0), np.zeros(16)]
    problem = Linearised(residuals, slopes, std, np.zeros(33))
    return problem, Bends(2 + np.arange(15), (1e-7, 10.0)), 17 + np.arange(16)[:, None]


def test_knots_lie_where_few_states_are_at_resonance():
    """Four levels that pass resonance: most states are far below it, where levels overlap."""
    detuned = np.linspace(-4, 4, 25)
    amplitude = np.concatenate([peak / np.hypot(1, detuned) for peak in (0.1, 0.2, 0.5, 1.0)])
    (order,) = SmoothingSpline.sizes(len(amplitude), 4)
    given = (amplitude, np.ones_like(amplitude), np.ones_like(amplitude))
    (curve,) = SmoothingSpline.starts(order, "displacement", *given)
    knots = np.sqrt(np.asarray(curve.knots))[1:]
    np.testing.assert_allclose(knots[[0, -1]], [0.1 / np.hypot(1, 4), 1.0], rtol=0.05)
    # A knot at every level's peak or close to it, and two at least between any of them.
    for peak in (0.1, 0.2, 0.5, 1.0):
        assert np.min(np.abs(np.log(knots / peak))) < 0.08
    for low, high in ((0.1, 0.2), (0.2, 0.5), (0.5, 1.0)):
        assert np.sum((knots > 1.02 * low) & (knots < 0.98 * high)) >= 2


def test_the_size_of_bends_is_found_without_bias():
    found = [likeliest_std(*drawn(seed, 0.2, 0.02)[:2]) for seed in range(20)]
    # Fifteen bends tell their size to 1/sqrt(30).
    assert abs(np.mean(np.log(found)) - np.log(0.2)) < 3 * 0.19 / np.sqrt(20)


@pytest.mark.long
def test_a_rough_curve_does_not_pass_for_levels_that_differ():
    for seed in range(8):
        problem, bends, index = drawn(seed, 0.3, 0.02)
        assert estimated_components(problem, index, bends=[bends]).level == (0.0,)
        # A curve without a prior of its own size leaves its bends to the levels.
        stiff = problem._replace(prior_std=np.where(problem.prior_std == 1.0, 1e-3, np.inf))
        stiff.prior_std[index] = 0.0
        found = estimated_components(stiff, index)
        assert found.level[0] > 0.05 or found.unbounded == (0,)


@pytest.mark.long
def test_levels_that_differ_are_found_beside_a_smooth_curve():
    found = [
        estimated_components(problem, index, bends=[bends]).level[0]
        for problem, bends, index in (drawn(seed, 1e-4, 0.02, shared=0.2) for seed in range(12))
    ]
    # Of one of them bends would take the place, did they always come first.
    assert all(size > 0 for size in found)
    assert np.mean(found) == pytest.approx(0.2, rel=0.25)


def dipping(x):
    """ω̃² that falls to a sharp minimum and rises again, as a curved beam's does."""
    return OMEGA**2 * (0.25 + np.sqrt((x / 1e-3 - 1.0) ** 2 + 0.1**2))


def near_resonance(seed, n_levels=14):
    """Noisy states within 1.2° of resonance; the gain of a level errs by 1 %."""
    rng = np.random.default_rng(seed)
    level = np.repeat(np.arange(n_levels), 6)
    phase = np.radians(np.tile(np.linspace(-1.2, 1.2, 6), n_levels))
    x = np.concatenate([np.linspace(3e-4, 8e-4, 4), np.linspace(8.6e-4, 1.16e-3, 6),
                        np.linspace(1.25e-3, 2e-3, 4)])[level]  # fmt: skip
    damping = 15.0
    half = 0.5 * damping * np.tan(phase)
    omega = np.sqrt(half**2 + dipping(x)) - half
    needed = dipping(x) - omega**2 + 1j * omega * damping
    force = np.abs(needed) * x / CONSTANT
    velocity = 1j * omega * CONSTANT * force / needed
    gain = 0.01 * rng.normal(size=n_levels)[level]
    own = NOISE["velocity"] * rng.normal(size=len(x)) + 1j * NOISE["phase"] * rng.normal(
        size=len(x)
    )
    force = force * np.exp(NOISE["force"] * rng.normal(size=len(x)))
    return stated(level, omega, force, velocity * np.exp(gain + own))


@pytest.fixture(scope="module")
def fits():
    """Noisy tests of a curve that few knots cannot follow, families chosen by the data."""
    return [
        fit_jointly(near_resonance(seed), modes(), level_gain_std=0.01)
        for seed in range(repeats(1, 3))
    ]


@pytest.mark.long
def test_bands_hold_a_curve_that_few_knots_cannot_follow(fits):
    at = np.linspace(3.2e-4, 1.95e-3, 40)
    inside = []
    for fit in fits:
        assert fit.converged
        assert isinstance(fit.unknowns.squared_frequency, SmoothingSpline)
        assert not any("levels differ" in note for note in fit.notes)
        values = sj.identify.fitted_values(fit, displacement=at)
        off = np.asarray(values.natural_frequency) - np.sqrt(dipping(at))
        inside.append(np.abs(off / np.asarray(values.natural_frequency_std)) < 1.96)
    # Four free knots leave 38 % of these amplitudes outside.
    assert np.mean(inside) > 0.9


@pytest.mark.long
def test_implicit_derivatives_know_how_smooth_a_curve_is_expected_to_be(fits):
    std = np.sqrt(np.diag(sensitivity(fits[0]).covariance))
    # The residuals' curvature moves them by some per cent; without bends a knot would be unknown.
    n = len(fits[0].unknowns.squared_frequency.parameters)
    assert std[:n] == pytest.approx(np.sqrt(np.diag(fits[0].covariance))[:n], rel=0.2)


@pytest.mark.long
def test_a_smoothing_spline_comes_back_from_its_file(fits, tmp_path):
    write_joint_fit(tmp_path / "fit.json", fits[0])
    again = read_joint_fit(tmp_path / "fit.json")
    curve = fits[0].unknowns.squared_frequency
    same = again.unknowns.squared_frequency
    np.testing.assert_array_equal(same.prior_residuals(), curve.prior_residuals())
    assert again.corrected
    assert described(same) == f"smoothing_spline:{len(curve.parameters)}@displacement"
