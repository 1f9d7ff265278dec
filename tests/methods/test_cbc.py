"""Control-based continuation in the virtual laboratory, against the forced Duffing oscillator."""

import numpy as np
import pytest
from truths.duffing import CUBIC, MASS, RATIO, REST, beam

import snrmjax as sj
from snrmjax.methods import MethodStatus


@pytest.fixture(scope="module")
def laboratory():
    shaker = sj.simulate.Shaker(3.0, 8.0, mass=0.05, damping=1.0, stiffness=500.0)
    return sj.simulate.Laboratory(beam(), shaker, sj.simulate.Instruments(), 6000.0)


def stiffness(velocity, omega):
    """F/v of one term of harmonic balance, N s/m."""
    amplitude = velocity / omega
    square = REST**2 + 0.75 * CUBIC * amplitude**2 - omega**2
    return MASS * (2 * RATIO * REST + square / (1j * omega))


def test_it_stabilises_the_branch_that_an_open_loop_jumps_over(laboratory):
    omega = 1.03 * REST
    settings = sj.simulate.FeedbackSettings(20.0)
    curve = sj.simulate.s_curve(laboratory, omega, np.linspace(0.1, 1.2, 12), settings)
    assert (curve.invasive < settings.invasive).all()
    exact = np.abs(stiffness(curve.velocity, omega)) * curve.velocity
    np.testing.assert_allclose(curve.force, exact, rtol=0.02, atol=0.01 * exact.max())
    falls = np.diff(curve.force) < 0
    assert falls.any()
    assert (np.diff(curve.force) > 0)[: int(np.argmax(falls))].all()
    assert np.diff(curve.force)[-1] > 0  # up, down and up again


def test_the_backbone_does_not_depend_on_the_gain(laboratory):
    found = [
        sj.methods.control_based_continuation(
            laboratory, np.array(targets), sj.simulate.FeedbackSettings(gain)
        )
        for gain, targets in ((20.0, [0.3, 0.6]), (40.0, [0.25, 0.5]))
    ]
    for result in found:
        assert result.has_result.all()
        half = REST**2 / 2
        amplitude = result.velocity
        true = np.sqrt(half + np.sqrt(half**2 + 0.75 * CUBIC * amplitude**2))
        np.testing.assert_allclose(result.natural_frequency, true, rtol=3e-4)
        modal = 2 * result.damping_ratio * result.natural_frequency
        np.testing.assert_allclose(modal, 2 * RATIO * REST, rtol=5e-3)


def test_an_uncontrolled_motion_is_reported(laboratory):
    impatient = sj.simulate.FeedbackSettings(20.0, invasive=1e-9)
    result = sj.methods.control_based_continuation(laboratory, np.array([0.3]), impatient)
    assert list(result.status) == [int(MethodStatus.NOT_LOCKED)]
    with pytest.raises(ValueError, match="`amplitudes` must be positive"):
        sj.methods.control_based_continuation(laboratory, np.array([-0.3]), impatient)
    with pytest.raises(ValueError, match="settings of the feedback must be positive"):
        sj.simulate.s_curve(laboratory, REST, np.array([0.3]), sj.simulate.FeedbackSettings(0.0))


def test_a_tracked_fundamental_gives_the_same_branch_and_too_fast_a_filter_is_detected(laboratory):
    omega = 1.03 * REST
    settings = sj.simulate.FeedbackSettings(20.0, filter_rate=80.0)
    curve = sj.simulate.s_curve(laboratory, omega, np.linspace(0.1, 1.2, 6), settings)
    exact = np.abs(stiffness(curve.velocity, omega)) * curve.velocity
    np.testing.assert_allclose(curve.force, exact, rtol=0.02, atol=0.01 * exact.max())
    assert curve.invasive.max() < 1e-3
    wild = settings._replace(gain=200.0, filter_rate=800.0)
    lost = sj.simulate.s_curve(laboratory, omega, np.array([0.3, 0.6]), wild)
    assert np.isnan(lost.force).all()


@pytest.fixture(scope="module")
def linear():
    shape = 1 / np.sqrt(MASS)
    modes = sj.model.linear_modes([REST], [RATIO], [[shape]], [shape])

    def at(force_noise, velocity_noise, potential=None):
        instruments = sj.simulate.Instruments(
            force_noise=force_noise, velocity_noise=velocity_noise
        )
        shaker = sj.simulate.Shaker(0.1, 0.1)
        return sj.simulate.Laboratory(
            sj.model.structure(modes, potential), shaker, instruments, 2000.0
        )

    return at


FILTERED = sj.simulate.FeedbackSettings(20.0, filter_rate=60.0)


def test_a_residual_phase_error_does_not_bias_the_frequency(linear):
    shape, cubic = 1 / np.sqrt(MASS), 2e6
    potential = sj.model.polynomial_potential({"1111": cubic * shape**2 / 4}, 1)
    lab = linear(0.0, 0.0, potential)
    result = sj.methods.control_based_continuation(lab, np.array([0.8]), FILTERED)
    # Less than half a degree from the linear mode: the first controlled motion is the last.
    shift = 0.375 * cubic * (result.velocity / REST**2) ** 2
    assert (shift > 3e-5).all()
    np.testing.assert_allclose(result.natural_frequency / REST - 1, shift, rtol=0, atol=2e-6)
    np.testing.assert_allclose(result.damping_ratio, RATIO, rtol=2e-4)


def test_bands_are_as_wide_as_the_scatter_of_repeated_tests(linear):
    noisy, targets = linear(0.01, 0.002), np.array([0.3, 0.6])
    scores = []
    for seed in range(12):
        one = sj.methods.control_based_continuation(noisy, targets, FILTERED, seed=seed)
        scores.append((one.natural_frequency - REST) / one.natural_frequency_std)
        scores.append((one.damping_ratio - RATIO) / one.damping_ratio_std)
    # Of 48 normal numbers ±10 %; the larger of two estimates of the noise makes them smaller.
    assert 0.5 < np.sqrt(np.mean(np.square(scores))) < 1.3
