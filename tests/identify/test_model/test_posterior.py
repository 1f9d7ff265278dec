"""The posterior of a test, against curves and errors that made its states."""

import functools
from typing import NamedTuple

import numpy as np
import pytest
from truths.exact_states import CONSTANT, damping, squared

from snrmjax.identify.test_model import states as measured
from snrmjax.identify.test_model.gauss_newton import Rounds
from snrmjax.identify.test_model.posterior import fit_test, levels_in_order, students_factor
from snrmjax.numerics.blocks import on_one_core

LEVELS, PER_LEVEL, NOISE, SPREAD = 6, 15, 0.005, 0.005
fitted = on_one_core(fit_test)
unasked = functools.partial(fitted, compare_levels=False)  # half the time


def loss(x):
    """δ(a) of a displacement amplitude: it grows with the velocity of resonance."""
    return damping(x * np.sqrt(squared(x)))


class Made(NamedTuple):
    """States and the level errors that they were made with."""

    states: measured.TestStates
    stiffness: np.ndarray  # relative deviation of ω̃² of every level
    gain: np.ndarray

    def fit(self, **settings):
        return unasked(self.states, **settings)


def made(seed, *, spread=SPREAD, gain=0.0, noise=NOISE, stated=True, outliers=0, tips=(2e-4, 2e-3)):
    """Levels of states within 50° of resonance, hardening by 30 %, in closed form.

    The natural frequency of levels differs by `spread` (1σ, relative), their gain by `gain`.
    """
    rng = np.random.default_rng(seed)
    stiffness, gains = 2 * spread * rng.normal(size=LEVELS), gain * rng.normal(size=LEVELS)
    rows = []
    for level, tip in enumerate(np.geomspace(*tips, LEVELS)):
        for phase in np.radians(np.linspace(-50, 50, PER_LEVEL)):
            x = tip * np.cos(phase)
            own = squared(x) * (1 + stiffness[level])
            # (ω̃² − Ω²) = Ωδ tan φ, solved for Ω.
            b = 0.5 * loss(x) * np.tan(phase)
            omega = -b + np.sqrt(b**2 + own)
            needed = (own - omega**2 + 1j * omega * loss(x)) * x / CONSTANT
            rows.append((level, omega, abs(needed), 1j * omega * x * abs(needed) / needed))
    level, omega, force, velocity = (np.array(column) for column in zip(*rows, strict=True))
    n = len(level)
    std = np.tile([0.1 * noise, noise, noise], (n, 1))
    own = std * rng.normal(size=(n, 3))
    own[rng.choice(n, outliers, replace=False)] *= 15
    level = level.real.astype(int)
    velocity = velocity * np.exp(own[:, 1] + 1j * own[:, 2] + gains[level])
    errors = std if stated else std / noise
    states = measured.TestStates(
        *(level, omega.real, force.real * np.exp(own[:, 0]), velocity),
        *(errors, stated, CONSTANT, (0.0,) * 4, 0.05),
    )
    return Made(states, stiffness, gains)


AT = np.geomspace(1.5e-4, 2e-3, 20)


def off(found, at=AT):
    """Errors of both curves in their 1σ, and relative."""
    curves = found.curves(at)
    truth = np.stack([squared(at), loss(at)], axis=1)
    values = np.stack([curves.squared_frequency, curves.modal_damping], axis=1)
    std = np.sqrt(np.einsum("nii->ni", curves.covariance))
    return (values - truth) / std, values / truth - 1, std / truth


@pytest.fixture(scope="module")
def known():
    return made(0)


@pytest.fixture(scope="module")
def found(known):
    return known.fit(compare_levels=True)


def test_curves_levels_and_noise_are_those_that_made_the_states(known, found):
    in_std, relative, band = off(found)
    assert np.abs(in_std).max() < 3
    assert np.abs(relative).max() < 0.01
    assert band[:, 0].max() < 0.005  # half of the level scatter, whose mean is unknown
    assert band[:, 1].max() < 0.02
    # 180 rows determine the noise to 5 %.
    assert found.hyper.noise == pytest.approx(1.0, abs=0.15)
    assert np.mean(found.residuals**2) == pytest.approx(1.0, abs=0.25)
    mass, std = found.modal_mass
    assert abs(mass - 1) < 3 * std < 0.02
    assert found.differing == (False, False, True, False)
    estimated = found.level_errors[:, 2]
    # Six level errors, up to their mean and what a smooth curve absorbs.
    assert np.corrcoef(estimated, known.stiffness)[0, 1] > 0.99
    assert np.std(estimated - known.stiffness) < 0.1 * np.std(known.stiffness)
    assert found.hyper.level_std[2] == pytest.approx(np.std(known.stiffness, ddof=1), rel=0.35)


@pytest.mark.parametrize("seed", [1, 2])
def test_bands_hold_the_curves_of_other_tests_too(seed):
    in_std, _, _ = off(made(seed).fit())
    assert np.abs(in_std).max() < 3.3
    assert np.sqrt(np.mean(in_std**2)) < 1.6


def test_equal_levels_do_not_differ():
    found = made(3, spread=0.0).fit(compare_levels=True)
    assert found.differing == (False,) * 4
    assert off(found)[2].max() < 0.02


def test_level_gains_are_distinguished_from_level_stiffness():
    test = made(1, spread=0.0, gain=0.03)
    found = test.fit(compare_levels=True)
    assert found.differing[0]
    assert not found.differing[2]
    assert np.corrcoef(found.level_errors[:, 0], test.gain)[0, 1] > 0.95


def test_stated_errors_of_levels_are_kept(known):
    stated = known.states._replace(level_std=(0.0, 0.0, 0.01, 0.0))
    found = fitted(stated)
    assert found.hyper.level_std[2] == pytest.approx(0.01, rel=1e-12)
    assert not found.differing[2]  # by no more than is stated


def test_unstated_noise_is_estimated(known, found):
    silent = made(0, stated=False).fit()
    assert silent.hyper.noise == pytest.approx(NOISE, rel=0.15)
    both = [one.curves(AT).squared_frequency for one in (silent, found)]
    # Relative weights are the same, so the curves agree.
    np.testing.assert_allclose(*both, rtol=2e-4)


def test_units_and_the_order_of_rows_change_nothing(known, found):
    states, n = known.states, len(known.states.level)
    order = np.random.default_rng(4).permutation(n)
    rows = {
        name: getattr(states, name)[order]
        for name in ("level", "frequency", "force", "velocity", "errors")
    }
    shuffled = unasked(states._replace(**rows))
    scaled = unasked(states._replace(velocity=1e3 * states.velocity, force=1e3 * states.force))
    both = found.curves(AT)
    for one, length in ((shuffled, 1.0), (scaled, 1e3)):
        curves = one.curves(length * AT)
        # Hyperparameters converge to a gradient of 1e-3: curves change by far less than their band.
        for name in ("squared_frequency", "modal_damping"):
            np.testing.assert_allclose(getattr(curves, name), getattr(both, name), rtol=1e-3)
        assert one.hyper.noise == pytest.approx(found.hyper.noise, rel=1e-3)


def test_robust_noise_ignores_outliers():
    test = made(5, outliers=4)
    plain, robust = (off(test.fit(robust=one))[1] for one in (False, True))
    clean = off(made(5).fit())[1]
    assert np.abs(robust).max() < 2 * np.abs(clean).max() < np.abs(plain).max()


@pytest.mark.parametrize(("outliers", "preferred"), [(0, False), (4, True)])
def test_outliers_make_students_t_the_more_probable_noise(outliers, preferred):
    test = made(6, outliers=outliers)
    normal, heavy = (test.fit(robust=one).log_evidence for one in (False, True))
    assert (heavy > normal) == preferred
    weight = test.fit(robust=None).weight
    assert (weight.min() < 0.1) == preferred


def test_a_far_outlier_has_the_weight_of_students_t():
    """6/(4 + q) for the squared distance q of a state from the curves, in units of the noise."""
    test = made(5, outliers=4)
    found = test.fit(robust=True)
    square = np.sum(found.residuals**2, axis=1) / found.weight
    assert square.max() > 100
    # The weights of the last iteration belong to the curves of the one before.
    np.testing.assert_allclose(found.weight, 6 / (4 + square), rtol=0.05)


def test_level_errors_correlated_with_force_are_detected(known):
    # Fitted phases (deg) of a softening wire, for which one mode leaves correlated residuals, and
    # the same in another order: p = 0.002 and 0.8.
    force = np.array([1.96, 2.45, 2.94, 3.92, 4.9, 5.88])
    states = known.states._replace(force=force[known.states.level])
    phases = np.array([2.3, 1.1, 0.3, -0.7, -1.3, -1.8])
    errors = np.zeros((LEVELS, 4))
    errors[:, 1], errors[:, 2] = phases, phases[[3, 0, 5, 1, 4, 2]]
    assert levels_in_order(states, errors).tolist() == [False, True, False, False]
    stated = states._replace(level_std=(0.0, 0.01, 0.0, 0.0))
    assert not np.any(levels_in_order(stated, errors))
    alike = states._replace(force=np.ones_like(states.force))
    assert not np.any(levels_in_order(alike, errors))


def test_slopes_of_curves_are_finite_differences(found):
    step = 1e-5
    ends = [found.curves(AT * np.exp(sign * step)) for sign in (1, -1)]
    slopes = found.curves(AT).slopes
    for k, name in enumerate(("squared_frequency", "modal_damping")):
        change = (getattr(ends[0], name) - getattr(ends[1], name)) / (2 * step)
        np.testing.assert_allclose(slopes[:, k], change, rtol=1e-5, atol=1e-5 * np.ptp(change))


def test_a_single_state_is_no_test(known):
    with pytest.raises(ValueError, match="at least two states, not 1"):
        fit_test(known.states._replace(level=known.states.level[:1]))


def test_a_force_without_stated_error_gets_a_fraction_of_the_velocitys():
    stated = np.array([[np.nan, 0.01, 0.02], [0.003, 0.01, 0.02]])
    stated[0, 0] = 0.0
    errors, known = measured.state_errors(stated)
    assert known
    assert errors == pytest.approx(np.array([[0.001, 0.01, 0.02], [0.003, 0.01, 0.02]]))
    errors, known = measured.state_errors(np.array([[0.0, np.nan, 0.02], [0.003, 0.01, 0.02]]))
    assert not known
    assert errors == pytest.approx(np.tile([0.1, 1.0, 1.0], (2, 1)))


@pytest.mark.parametrize("n_levels", [2, 3, 4, 8])
def test_few_levels_widen_a_band_as_students_t_does(n_levels):
    """Means of draws with their sample standard deviation: 95 % of 20 000 lie inside."""
    draws = np.random.default_rng(n_levels).normal(size=(20000, n_levels))
    spread = draws.std(axis=1, ddof=1)
    band = 1.96 * students_factor(n_levels - 1) * spread / np.sqrt(n_levels)
    # Two levels count as three: t = 4.303 of one degree of freedom holds 85.5 %.
    wanted = 2 / np.pi * np.arctan(4.303) if n_levels == 2 else 0.95
    assert np.mean(np.abs(draws.mean(axis=1)) < band) == pytest.approx(wanted, abs=0.006)


def test_states_with_correlated_residuals_count_as_fewer(known, found):
    """A slow misfit of 3 % along every level: the curves' bands must not shrink with its states."""
    slow = 0.03 * np.sin(np.tile(np.linspace(-4, 4, PER_LEVEL), LEVELS))
    states = known.states._replace(velocity=known.states.velocity * np.exp(slow), stated=False)
    states = states._replace(errors=np.tile([0.1, 1.0, 1.0], (len(slow), 1)))
    plain, power_likelihood = (unasked(states, power_likelihood=one) for one in (False, True))
    wide, narrow = (np.median(off(one)[2], axis=0) for one in (power_likelihood, plain))
    assert wide[1] > 1.15 * narrow[1]
    assert wide[0] > narrow[0]
    white = unasked(known.states, power_likelihood=True)
    same = np.median(off(white)[2], axis=0) / np.median(off(found)[2], axis=0)
    assert same == pytest.approx(1.0, abs=0.15)


def test_a_phase_error_of_all_records_is_no_level_error():
    clean = made(3, spread=0.0, noise=0.002)
    with_phase_error = clean.states._replace(
        velocity=clean.states.velocity * np.exp(0.05j), phase_std=0.1
    )
    found = fitted(with_phase_error)
    assert found.instrument_phase == pytest.approx(0.05, abs=0.004)
    assert not found.differing[1]


def test_a_natural_frequency_that_moves_along_the_test_is_a_trend():
    """Frequencies and velocities times eᶜᵖ, forces times e²ᶜᵖ: K, Ω² and Ωδ of a drifting mode."""
    states = made(0, spread=0.0).states
    position, change = np.linspace(-0.5, 0.5, len(states.level)), 0.01
    factor = np.exp(change * position)
    moved = states._replace(
        frequency=states.frequency * factor,
        velocity=states.velocity * factor,
        force=states.force * factor**2,
    )
    without = unasked(moved)
    found = unasked(moved._replace(trend=position, trend_std=0.1))
    trend, std = found.trend
    assert abs(trend - 2 * change) < 3 * std + change**2
    assert found.log_evidence > without.log_evidence + 12
    # Without drift there is no trend.
    still, std = unasked(states._replace(trend=position, trend_std=0.1)).trend
    assert abs(still) < 3 * std
    assert unasked(states).trend == (0.0, 0.0)


def test_levels_bandwidths_apart_need_the_start_that_frees_them():
    """Natural frequencies 2 % apart, where 2ζ is 1 %: the residual noise is the true one."""
    states = made(0, spread=0.02).states
    four = Rounds(most=4)
    found = unasked(states, rounds=four._replace(levels_apart=True))
    assert found.hyper.noise == pytest.approx(1.0, abs=0.15)  # 180 rows determine it to 5 %
    assert found.log_evidence >= unasked(states, rounds=four).log_evidence - 0.1
    assert found.differing == (False,) * 4
