"""The smoothing spline: its roughness, and bands that cover the curve between levels."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.interpolate import CubicSpline
from truths.exact_states import CONSTANT, NOISE, OMEGA, modes, stated
from truths.sizes import repeats

import snrmjax as sj
from snrmjax.identify.curves.splines import SmoothingSpline
from snrmjax.identify.joint.joint_fit import fit_jointly
from snrmjax.io.joint_results import read_joint_fit, write_joint_fit

KNOTS = np.array([0.0, 0.02, 0.05, 0.2, 0.3, 0.7, 1.0])
AT = np.linspace(3.2e-4, 1.95e-3, 40)  # m


def curve(values, roughness_std=1.0):
    """A smoothing spline through values at `KNOTS`."""
    spline = SmoothingSpline.through(KNOTS, values, jnp.asarray(2.0), "displacement")
    return SmoothingSpline(**(vars(spline) | {"roughness_std": jnp.asarray(roughness_std)}))


def test_a_straight_line_has_no_roughness_and_a_corner_has_one():
    line = curve(3.0 - 2.0 * KNOTS)
    np.testing.assert_allclose(line.prior_residuals(), 0.0, atol=1e-12)
    corner = np.asarray(curve(np.maximum(KNOTS - 0.3, 0.0)).prior_residuals())
    assert np.flatnonzero(np.abs(corner) > 1e-9).tolist() == [3]  # the inner knot at 0.3
    wide, narrow = (np.asarray(curve(KNOTS**2, std).prior_residuals()) for std in (1.0, 0.1))
    np.testing.assert_allclose(narrow, 10 * wide, rtol=1e-12)


def dipping(x):
    """ω̃² that falls to a sharp minimum and rises again, as a curved beam's does."""
    return OMEGA**2 * (0.25 + np.sqrt((x / 1e-3 - 1.0) ** 2 + 0.1**2))


def near_resonance(seed, n_levels=14):
    """Noisy states within 1.2° of resonance; level gains have errors of 1 %."""
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
    """Fits to noisy tests of a curve that few knots cannot follow."""
    return [
        fit_jointly(near_resonance(seed), modes(), level_gain_std=0.01)
        for seed in range(repeats(1, 12))
    ]


def inside(fit):
    """Where the 95 % band covers the curve."""
    values = sj.identify.fitted_values(fit, displacement=AT)
    off = np.asarray(values.natural_frequency) - np.sqrt(dipping(AT))
    return np.abs(off / np.asarray(values.natural_frequency_std)) < 1.96


@pytest.mark.long
def test_bands_cover_a_curve_that_few_knots_cannot_follow(fits):
    for fit in fits:
        curve = fit.unknowns.squared_frequency
        assert fit.converged
        assert isinstance(curve, SmoothingSpline)
        # Knots are a tenth of the amplitude apart and the dip as wide: the interpolation error of
        # the best curve is fitted as level errors of the stiffness, and no more than that.
        scale, knots = float(curve.scale), np.asarray(curve.knots)
        best = CubicSpline(knots, dipping(scale * np.sqrt(knots)), bc_type="natural")
        missed = np.abs(best((AT / scale) ** 2) / dipping(AT) - 1).max()
        assert fit.noise.level_std[2] < missed < 0.03
    # Level gains shift the curve near the level: errors of a test are correlated, and twelve tests
    # determine the coverage to some 3 %.
    assert np.mean([inside(fit) for fit in fits]) > 0.9
    few = fit_jointly(
        near_resonance(0), modes(), level_gain_std=0.01, backbone="spline:4", damping="constant"
    )
    # The remainder of four knots is fitted, and noted.
    assert "family_leaves" in {note.kind for note in few.notes}
    assert np.mean(inside(few)) > 0.9


@pytest.mark.long
def test_a_smoothing_spline_round_trips_through_its_file(fits, tmp_path):
    write_joint_fit(tmp_path / "fit.json", fits[0])
    again = read_joint_fit(tmp_path / "fit.json")
    curve = fits[0].unknowns.squared_frequency
    same = again.unknowns.squared_frequency
    np.testing.assert_array_equal(same.prior_residuals(), curve.prior_residuals())
    assert same.label == f"smoothing_spline:{len(curve.parameters)}@displacement"
