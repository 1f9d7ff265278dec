"""Noise with a floor, and level errors independent of the force."""

import numpy as np
import pytest
from scipy.optimize import brentq

import snrmjax as sj

OWN, MASS, RATIO = 80.0 * 2 * np.pi, 2.0, 2e-3  # rad/s, kg, 1
SOFTENING = 0.02  # of ω̃², at the largest amplitude
LARGEST = 1e-4  # m


def squared_frequency(amplitude):
    """ω̃² of a cubic spring (rad²/s²)."""
    return OWN**2 * (1 - SOFTENING * (amplitude / LARGEST) ** 2)


def state(force, phase):
    """Frequency (rad/s) and velocity (m/s) at this force (N) and phase (rad)."""

    def frequency(amplitude):
        half = OWN * RATIO * np.tan(phase)
        return -half + np.sqrt(half**2 + squared_frequency(amplitude))

    def excess(amplitude):
        needed = MASS * 2 * OWN * RATIO * frequency(amplitude) * amplitude
        return needed - force * np.cos(phase)

    amplitude = brentq(excess, 1e-12, 2 * LARGEST, xtol=1e-20)
    return frequency(amplitude), frequency(amplitude) * amplitude


def rows_of_a_test(tips, level_phase, noise, floor, seed):
    """Columns of a test: levels of these amplitudes at resonance (m), with these phase errors."""
    rng = np.random.default_rng(seed)
    rows = [
        (level, *state(force, phase), force, phase, phase_error)
        for level, (tip, phase_error) in enumerate(zip(tips, level_phase, strict=True), start=1)
        for force in [
            MASS * 2 * OWN * RATIO * OWN * tip * np.sqrt(1 - SOFTENING * (tip / LARGEST) ** 2)
        ]
        for phase in np.radians(np.linspace(65, -65, 15))
    ]
    level, frequency, speed, force, phase, phase_error = np.array(rows).T
    own = rng.normal(size=(2, len(rows))) + 1j * rng.normal(size=(2, len(rows)))
    velocity = speed * np.exp(1j * (phase + phase_error)) * (1 + noise * own[0]) + floor * own[1]
    return level.astype(int), frequency, force, velocity


def fitted(*rows):
    """The joint fit of such a test."""
    modes = sj.model.linear_modes([OWN], [RATIO], [[MASS**-0.5]], [MASS**-0.5])
    return sj.fit_jointly(sj.measure.steady_states(*rows), modes)


def errors_of(fit, tips):
    """Errors of frequency and damping at resonance over their 1σ, and the damping's relative 1σ."""
    tips = np.asarray(tips)
    own = np.sqrt(squared_frequency(tips))
    found = sj.identify.fitted_values(fit, tips * own)
    ratio = RATIO * OWN / own
    off = (found.natural_frequency - own) / found.natural_frequency_std
    damping_error = (found.damping_ratio - ratio) / found.damping_ratio_std
    return np.array([off, damping_error]), np.asarray(found.damping_ratio_std) / ratio


@pytest.mark.parametrize("seed", [1, 2])
def test_a_noise_floor_is_estimated_over_60_db(seed):
    # Floor of 2 % of the lowest level's velocity, 0.002 % of the highest's; relative noise 0.2 %.
    tips = np.geomspace(1e-3, 1.0, 8) * LARGEST
    noise, floor = 2e-3, 0.02 * tips[0] * OWN
    fit = fitted(*rows_of_a_test(tips, np.zeros(8), noise, floor, seed))
    off, band = errors_of(fit, tips)
    assert np.max(np.abs(off)) < 3.3
    # With relative noise alone: 0.22 to 0.56 %.
    assert np.max(band[1:-1]) < 0.0015


def test_independent_level_errors_are_attributed_to_levels():
    tips = np.geomspace(0.15, 1.0, 6) * LARGEST
    level_phase = np.radians([0.5, -0.8, 0.9, -0.3, 0.6, -0.7])
    fit = fitted(*rows_of_a_test(tips, level_phase, 1e-3, 0.0, 3))
    off, _ = errors_of(fit, tips)
    assert np.max(np.abs(off)) < 3.3
    assert fit.noise.level_std[1] == pytest.approx(np.std(level_phase, ddof=1), rel=0.5)
