"""Uncertainty of a joint fit: derivatives against refits, and its ways against each other."""

import dataclasses
import sys

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from truths.exact_states import CONSTANT, NOISE, OMEGA, TRUE, modes, noisy, stated
from truths.joint_fits import noisy_fit

import snrmjax as sj
from snrmjax.identify.inference import profiles
from snrmjax.identify.inference.profiles import IntervalEnd, profile
from snrmjax.identify.inference.resampling import (
    ComparedBand,
    ComparedBands,
    bootstrap,
    compare_bands,
)
from snrmjax.identify.inference.sensitivity import contributions, sensitivity


@pytest.fixture(scope="module")
def fit():
    """A fit of noisy states, level gains included."""
    return noisy_fit()


@pytest.mark.long
def test_derivatives_by_measurements_are_those_of_refits(fit):
    import optimistix as optx

    from snrmjax.identify.joint.family_fit import SOLVER
    from snrmjax.identify.joint.residuals import corrected_residuals

    slopes = sensitivity(fit).by_measurement
    vector, unravel = fit.vector()
    unit = np.sqrt(np.diag(fit.covariance))

    def refit(state, kind, change):
        """The same least squares with one record changed."""
        factor = jnp.ones(len(fit.data.level)).at[state].set(np.exp(change))
        name, by = {
            0: ("force", factor),
            1: ("velocity", factor),
            2: ("velocity", factor.astype(complex) ** 1j),
        }[kind]
        data = eqx.tree_at(lambda d: getattr(d, name), fit.data, getattr(fit.data, name) * by)
        return np.asarray(refitted(dataclasses.replace(fit.problem, data=data)))

    @eqx.filter_jit
    def refitted(problem):
        found = optx.least_squares(
            lambda y, own: corrected_residuals(vector + y * unit, unravel, own),
            *(SOLVER, jnp.zeros_like(vector)),
            args=problem,
        )
        return vector + found.value * unit

    for state, kind in ((3, 0), (20, 1), (41, 2)):
        step = 1e-4
        difference = (refit(state, kind, step) - refit(state, kind, -step)) / (2 * step)
        # Central differences are good to 1e-8, the solver's end to 1e-6 of a standard deviation.
        error = np.abs(slopes[:, state, kind] - difference) / unit
        assert np.max(error) < 2e-3 * np.max(np.abs(difference) / unit)


@pytest.mark.long
def test_the_implicit_covariance_is_gauss_newtons_where_residuals_are_small():
    exact = sj.fit_jointly(noisy(), modes(), level_gain_std=0.01, **TRUE)
    found = sensitivity(exact).covariance[:4, :4]
    # Without residuals the second-order terms vanish.
    np.testing.assert_allclose(found, exact.covariance[:4, :4], rtol=1e-6)


def test_contributions_sum_to_one_and_name_the_level_errors(fit):
    rows = contributions(fit)
    assert sum(row.frequency_share for row in rows) == pytest.approx(1, abs=1e-6)
    assert sum(row.damping_share for row in rows) == pytest.approx(1, abs=1e-6)
    # Levels are named as the data name them: here from 0 to 4.
    assert {row.source for row in rows} >= {"random error of phase", "gain of level 4"}
    # At resonance a level's gain counts as the velocities of its nine states do together; states
    # off resonance tell it, since stiffness against frequency has the same factor.
    near = contributions(sj.fit_jointly(noisy(1, widest=4), modes(), level_gain_std=0.01, **TRUE))
    gains, far = (
        sum(row.damping_share for row in found if row.source.startswith("gain"))
        for found in (near, rows)
    )
    (velocity,) = (r.damping_share for r in near if r.source == "random error of velocity")
    assert gains / velocity == pytest.approx(9, rel=0.1)
    assert far < 0.5 * gains


@pytest.mark.long
def test_contributions_near_resonance_of_a_linear_mode_are_known():
    rng, n, constant = np.random.default_rng(3), 60, 12.0
    omega = OMEGA + 0.5 * constant * np.tan(np.radians(np.linspace(-4, 4, n)))
    force = np.full(n, 2.0)
    velocity = 1j * omega * CONSTANT * force / (OMEGA**2 - omega**2 + 1j * omega * constant)
    own = NOISE["velocity"] * rng.normal(size=n) + 1j * NOISE["phase"] * rng.normal(size=n)
    data = stated(np.arange(n) % 5, omega, force, velocity * np.exp(own))
    rows = contributions(sj.fit_jointly(data, modes(), backbone="polynomial:0", damping="constant"))
    shares = {row.source.removeprefix("random error of "): row for row in rows}
    # 2ζω = A F cos φ/v: shares as the squares of 0.3 and 1 %, and of 4° of phase at most.
    assert shares["force"].damping_share / shares["velocity"].damping_share == pytest.approx(
        (NOISE["force"] / NOISE["velocity"]) ** 2, rel=0.01
    )
    # Beside them stands what levels seem to scatter: shares are compared with one another.
    assert shares["phase"].damping_share < 0.01 * shares["velocity"].damping_share
    # tan φ = (ω² − Ω²)/(Ω 2ζω): the natural frequency hinges on the phase.
    for other in ("force", "velocity"):
        assert shares[other].frequency_share < 0.01 * shares["phase"].frequency_share


@pytest.mark.long
def test_a_profile_of_a_quadratic_unknown_is_its_standard_deviation(fit):
    found = profile(fit, "damping.viscous")
    std = np.sqrt(fit.covariance[2, 2])
    value = float(fit.vector()[0][2])
    assert found.lower == pytest.approx(value - 1.96 * std, abs=0.1 * std)
    assert found.upper == pytest.approx(value + 1.96 * std, abs=0.1 * std)
    assert np.all(found.rise > -1e-6)
    with pytest.raises(ValueError, match="no unknown"):
        profile(fit, "damping.dry")


@pytest.mark.parametrize(
    ("failed", "end", "status"),
    [
        ([8], 2.0, IntervalEnd.BRACKETED),  # within: neighbours bracket the end all the same
        ([9], 1.75, IntervalEnd.BRACKETED),  # between χ² of 0.96 at 1 and of 8.64 at 3
        ([12], 2.0, IntervalEnd.BRACKETED),  # beyond it
        ([*range(9, 15)], np.nan, IntervalEnd.NOT_COMPUTED),
        ([], np.inf, IntervalEnd.BEYOND_REACH),
    ],
)
def test_a_profile_does_not_pass_through_refits_that_failed(fit, monkeypatch, failed, end, status):
    """χ² that rises by 3.84 two values from the best one, with refits that failed."""
    offsets = np.arange(-7, 8)
    rise = 3.84 * (offsets / 2) ** 2 if end != np.inf else 0.01 * offsets**2.0
    rise[failed] = np.nan
    monkeypatch.setattr(profiles, "_pinned", lambda *_: 100.0 + rise)
    found = profile(fit, "damping.viscous", n_points=15, reach=7.0)
    middle, std = float(fit.vector()[0][2]), np.sqrt(fit.covariance[2, 2])
    assert found.upper_status == status
    assert (found.upper - middle) / std == pytest.approx(end, nan_ok=True)
    lower = -np.inf if end == np.inf else -2.0
    assert (found.lower - middle) / std == pytest.approx(lower)
    assert found.lower_status != IntervalEnd.NOT_COMPUTED


@pytest.mark.long
def test_bootstrap_and_posterior_agree_with_the_covariance_for_independent_noise():
    independent = sj.fit_jointly(noisy(3, per_level=25), modes(), **TRUE)
    assert not independent.noise.level_std.any()  # the bootstrap would not see what levels share
    rows = compare_bands(independent, np.array([0.3, 0.7]), n_samples=150, posterior=True)
    for row in rows:
        assert row.implicit == pytest.approx(row.gauss_newton, rel=0.1)
        # 150 draws know a spread to 6 %, drawing 25 states a level adds as much.
        assert row.bootstrap == pytest.approx(row.gauss_newton, rel=0.3)
        assert row.posterior == pytest.approx(row.gauss_newton, rel=0.25)


@pytest.mark.long
def test_a_bootstrap_of_levels_sees_their_scatter():
    # Gains of 5 % outweigh 1 % of nine states near resonance, where the states do not tell them.
    scattered = sj.fit_jointly(noisy(1, gain=0.05, widest=4), modes(), level_gain_std=0.05, **TRUE)
    found = bootstrap(scattered, 60, levels=True)
    inside = bootstrap(scattered, 60)
    good = np.all(np.isfinite(found), axis=1)
    assert np.mean(good) > 0.5
    assert np.std(found[good, 3]) > np.std(inside[:, 3])


def test_samples_become_inference_data(fit, monkeypatch):
    pytest.importorskip("arviz")
    value, std = np.asarray(fit.vector()[0]), np.sqrt(np.diag(fit.covariance))
    samples = value + std * np.random.default_rng(0).normal(size=(50, len(value)))
    samples[3] = np.nan  # a refit that failed
    posterior = sj.identify.inference_data(fit, samples).posterior
    viscous = posterior["damping.viscous"]
    assert viscous.attrs["units"] == "1/s"
    assert viscous.sizes == {"chain": 1, "draw": 49}
    np.testing.assert_array_equal(viscous.values[0], np.delete(samples[:, 2], 3))
    with pytest.raises(ValueError, match="unknowns"):
        sj.identify.inference_data(fit, samples[:, :2])
    monkeypatch.setitem(sys.modules, "arviz", None)
    with pytest.raises(ImportError, match="posterior"):
        sj.identify.inference_data(fit, samples)


def test_a_profile_says_itself_and_is_drawn(fit, monkeypatch):
    monkeypatch.setattr(profiles, "_pinned", lambda *_: 3.84 * (np.arange(-7, 8) / 2) ** 2)
    found = profile(fit, "damping.viscous", n_points=15, reach=7.0)
    assert "between two computed values" in repr(found)
    assert found.to_xarray()["value"].attrs["units"] == "1/s"
    assert list(found.to_pandas()["rise"]) == list(found.rise)
    assert found.plot().axes


def test_compared_bands_are_a_table():
    rows = (ComparedBand(0.3, "natural_frequency", 2 * np.pi, 6.0, 6.0, np.nan),)
    table = ComparedBands(rows, 2).to_pandas()
    assert table["gauss_newton"][0] == pytest.approx(1.0)  # Hz
    assert "2 refits" in repr(ComparedBands(rows, 2))
