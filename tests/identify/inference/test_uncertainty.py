"""Uncertainty of a joint fit: derivatives against refits, and its ways against each other."""

import numpy as np
import pytest
from truths.exact_states import CONSTANT, NOISE, OMEGA, TRUE, modes, noisy, stated
from truths.joint_fits import noisy_fit

import snrmjax as sj
from snrmjax.identify.inference.contributions import contributions
from snrmjax.identify.inference.refits import bootstrap


@pytest.fixture(scope="module")
def fit():
    """A fit of noisy states, level gains included."""
    return noisy_fit()


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


def test_the_bootstrap_knows_the_states_but_not_what_levels_share():
    independent = sj.fit_jointly(noisy(3, per_level=25), modes(), **TRUE)
    drawn = bootstrap(independent, 40)
    assert np.all(np.isfinite(drawn))
    covariance, n = independent.covariance, 4  # the curves' own parameters come first
    across = covariance[:n, n:]
    given = covariance[:n, :n] - across @ np.linalg.pinv(covariance[n:, n:]) @ across.T
    ratio = np.std(drawn[:, :n], axis=0) / np.sqrt(np.diag(given))
    # 40 draws know a spread to 11 %, drawing 25 states a level adds as much. Levels that are known
    # give the least spread, their errors' stated and estimated sizes the most.
    assert np.all(ratio > 0.8)
    assert np.all(np.std(drawn[:, :n], axis=0) < np.sqrt(np.diag(covariance))[:n])


@pytest.mark.long
def test_a_bootstrap_of_levels_sees_their_scatter():
    # Gains of 5 % outweigh 1 % of nine states near resonance, where the states do not tell them.
    scattered = sj.fit_jointly(noisy(1, gain=0.05, widest=4), modes(), level_gain_std=0.05, **TRUE)
    found = bootstrap(scattered, 60, levels=True)
    inside = bootstrap(scattered, 60)
    good = np.all(np.isfinite(found), axis=1)
    assert np.mean(good) > 0.5
    assert np.std(found[good, 3]) > np.std(inside[:, 3])
