"""Uncertainty of a joint fit: derivatives against refits, and its ways against each other."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import snrmjax as sj
from snrmjax.identify.uncertainty import (
    bootstrap,
    compare_bands,
    contributions,
    profile,
    sensitivity,
)

from .exact_states import modes, noisy

TRUE = {"backbone": "polynomial:1@displacement", "damping": "viscous_quadratic@velocity"}


@pytest.fixture(scope="module")
def fit():
    """A fit of noisy states, level gains included."""
    return sj.fit_jointly(noisy(1, gain=0.01), modes(), level_gain_std=0.01, **TRUE)


def test_derivatives_by_measurements_are_those_of_refits(fit):
    import optimistix as optx

    from snrmjax.identify.joint_fit import SOLVER, Restore, all_residuals, whitener_at

    slopes = sensitivity(fit).by_measurement
    vector, restore = fit.vector()
    whiten = whitener_at(restore(vector), fit.data, fit.modes, fit.spread)
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
        found = optx.least_squares(
            lambda y, _: all_residuals(
                vector + y * unit, Restore(fit.unknowns, ()), data, fit.modes, fit.spread, whiten
            ),
            *(SOLVER, jnp.zeros_like(vector)),
        )
        return np.asarray(vector + found.value * unit)

    for state, kind in ((3, 0), (20, 1), (41, 2)):
        step = 1e-4
        difference = (refit(state, kind, step) - refit(state, kind, -step)) / (2 * step)
        # Central differences are good to 1e-8, the solver's end to 1e-6 of a standard deviation.
        error = np.abs(slopes[:, state, kind] - difference) / unit
        assert np.max(error) < 2e-3 * np.max(np.abs(difference) / unit)


def test_the_implicit_covariance_is_gauss_newtons_where_residuals_are_small():
    exact = sj.fit_jointly(noisy(), modes(), level_gain_std=0.01, **TRUE)
    found = sensitivity(exact).covariance[:4, :4]
    # Without residuals the second-order terms vanish.
    np.testing.assert_allclose(found, exact.covariance[:4, :4], rtol=1e-6)


def test_contributions_sum_to_one_and_name_the_level_errors(fit):
    rows = contributions(fit)
    assert sum(row.frequency_share for row in rows) == pytest.approx(1, abs=1e-6)
    assert sum(row.damping_share for row in rows) == pytest.approx(1, abs=1e-6)
    assert {row.source for row in rows} >= {"random error of phase", "gain of level 5"}
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


def test_contributions_near_resonance_are_those_of_force_over_velocity():
    near = contributions(sj.fit_jointly(noisy(1, widest=4), modes(), **TRUE))
    shares = {row.source: row for row in near}
    # There 2ζω = A F/v: shares as the squares of 0.3 and 1 %; the phase's 4° leave its share small.
    force, velocity = (shares[f"random error of {k}"].damping_share for k in ("force", "velocity"))
    assert force / velocity == pytest.approx(0.09, rel=0.02)
    assert force + velocity > 0.95
    # And tan φ = (ω² − Ω²)/(Ω 2ζω): the natural frequency hinges on the phase alone.
    assert shares["random error of phase"].frequency_share > 0.95


def test_a_profile_of_a_quadratic_unknown_is_its_standard_deviation(fit):
    found = profile(fit, "damping.viscous")
    std = np.sqrt(fit.covariance[2, 2])
    value = float(fit.vector()[0][2])
    assert found.lower == pytest.approx(value - 1.96 * std, abs=0.1 * std)
    assert found.upper == pytest.approx(value + 1.96 * std, abs=0.1 * std)
    assert np.all(found.rise > -1e-6)
    with pytest.raises(ValueError, match="no unknown"):
        profile(fit, "damping.dry")


def test_bootstrap_and_posterior_agree_with_the_covariance_for_independent_noise():
    independent = sj.fit_jointly(noisy(3, per_level=25), modes(), **TRUE)
    assert not independent.level_std.any()  # the bootstrap would not see what levels share
    rows = compare_bands(independent, np.array([0.3, 0.7]), n_samples=150, posterior=True)
    for row in rows:
        assert row.implicit == pytest.approx(row.gauss_newton, rel=0.1)
        # 150 draws know a spread to 6 %, drawing 25 states a level adds as much.
        assert row.bootstrap == pytest.approx(row.gauss_newton, rel=0.3)
        assert row.posterior == pytest.approx(row.gauss_newton, rel=0.25)


def test_a_bootstrap_of_levels_sees_their_scatter():
    # Gains of 5 % outweigh 1 % of nine states near resonance, where the states do not tell them.
    scattered = sj.fit_jointly(noisy(1, gain=0.05, widest=4), modes(), level_gain_std=0.05, **TRUE)
    found = bootstrap(scattered, 60, levels=True)
    inside = bootstrap(scattered, 60)
    good = np.all(np.isfinite(found), axis=1)
    assert np.mean(good) > 0.5
    assert np.std(found[good, 3]) > np.std(inside[:, 3])
