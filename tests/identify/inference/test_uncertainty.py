"""Uncertainty of a joint fit: contributions in closed form, and the bootstrap."""

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
    assert sum(row.frequency_fraction for row in rows) == pytest.approx(1, abs=1e-6)
    assert sum(row.damping_fraction for row in rows) == pytest.approx(1, abs=1e-6)
    # Levels are named as the data name them: here from 0 to 4.
    assert {row.source for row in rows} >= {"random error of phase", "gain of level 4"}
    # At resonance a level gain counts as much as the velocities of its nine states together; states
    # off resonance determine it, since it scales stiffness against frequency too.
    near = contributions(sj.fit_jointly(noisy(1, widest=4), modes(), level_gain_std=0.01, **TRUE))
    at_resonance, off_it = (
        sum(row.damping_fraction for row in found if row.source.startswith("gain"))
        / sum(row.damping_fraction for row in found if row.source == "random error of velocity")
        for found in (near, rows)
    )
    assert at_resonance == pytest.approx(9, rel=0.1)
    assert off_it < 0.5 * at_resonance


ALIKE = dict.fromkeys(("level_gain_std", "level_phase_std", "level_damping_std"), 1e-8)
ALIKE["level_frequency_std"] = 1e-8 * OMEGA


@pytest.mark.parametrize("levels", [{}, ALIKE], ids=["levels may differ", "levels are alike"])
def test_contributions_near_resonance_of_a_linear_mode_are_known(levels):
    rng, n, constant = np.random.default_rng(3), 60, 12.0
    level, tangent = np.arange(n) % 5, np.tan(np.radians(np.repeat(np.linspace(-4, 4, n // 5), 5)))
    omega, force = OMEGA + 0.5 * constant * tangent, np.linspace(1.0, 3.0, 5)[level]
    velocity = 1j * omega * CONSTANT * force / (OMEGA**2 - omega**2 + 1j * omega * constant)
    own = NOISE["velocity"] * rng.normal(size=n) + 1j * NOISE["phase"] * rng.normal(size=n)
    force = force * np.exp(NOISE["force"] * rng.normal(size=n))
    data = stated(level, omega, force, velocity * np.exp(own))
    structure = sj.model.structure(modes(), **levels)
    fit = sj.fit_jointly(data, structure, backbone="polynomial:0", damping="constant")
    fractions = {row.source.removeprefix("random error of "): row for row in contributions(fit)}
    values = sj.identify.fitted_values(fit, np.array([1.0]))
    damping_variance = float((values.modal_damping_std / values.modal_damping)[0]) ** 2
    frequency_variance = float((values.natural_frequency_std / values.natural_frequency)[0]) ** 2
    # The stated noise is known to 10 %: bands use the estimate.
    found = np.asarray(fit.data.std)[0, :3]
    noise = dict(zip(("force", "velocity", "phase"), found, strict=True))
    assert noise["velocity"] == pytest.approx(NOISE["velocity"], rel=0.2)
    # 2ζω = A F cos φ/v: the mean of n states has their error over √n. Fractions are of the whole
    # band, level errors included.
    for kind in ("velocity", "force"):
        wanted = noise[kind] ** 2 / n
        assert fractions[kind].damping_fraction * damping_variance == pytest.approx(wanted, rel=0.1)
    # tan φ = (ω² − Ω²)/(Ω 2ζω): phase errors shift the frequency by half a bandwidth per rad.
    by_phase = (noise["phase"] * 0.5 * constant / OMEGA) ** 2 / n
    assert fractions["phase"].frequency_fraction * frequency_variance == pytest.approx(
        by_phase, rel=0.1
    )
    if levels:
        # Weighted means, to first order in tan φ: cross terms scale with its mean square. The
        # frequency exponents, which are unknowns, absorb a little of it.
        across, along = noise["phase"] ** 2, noise["velocity"] ** 2 + noise["force"] ** 2
        tilt = np.mean(tangent**2) * along**2 / (across * noise["velocity"] ** 2)
        ratio = fractions["phase"].damping_fraction / fractions["velocity"].damping_fraction
        assert ratio == pytest.approx(tilt, rel=0.08)
        tilt = np.mean(tangent**2) * across * noise["velocity"] ** 2 / along**2
        ratio = fractions["velocity"].frequency_fraction / fractions["phase"].frequency_fraction
        assert ratio == pytest.approx(tilt, rel=0.08)
    else:
        assert fractions["velocity"].damping_fraction + fractions["force"].damping_fraction < 0.5


def test_the_bootstrap_covers_state_errors_but_not_level_errors():
    independent = sj.fit_jointly(noisy(3, per_level=25), modes(), **TRUE)
    samples = bootstrap(independent, 40)
    assert np.all(np.isfinite(samples))
    covariance, n = independent.covariance, 4  # the curves' own parameters come first
    across = covariance[:n, n:]
    given = covariance[:n, :n] - across @ np.linalg.pinv(covariance[n:, n:]) @ across.T
    ratio = np.std(samples[:, :n], axis=0) / np.sqrt(np.diag(given))
    # 40 draws determine a standard deviation to 11 %; resampling 25 states a level adds as much.
    # The spread with known level errors is the least, that with their prior the most.
    assert np.all(ratio > 0.8)
    assert np.all(np.std(samples[:, :n], axis=0) < np.sqrt(np.diag(covariance))[:n])
