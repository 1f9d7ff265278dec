"""Resonant decay against decays of known frequency and damping."""

import numpy as np
import pytest
from scipy.special import ellipk
from truths import duffing

import snrmjax as sj

REST, DAMPING, CUBIC = duffing.REST, duffing.DECAY_RATE, duffing.DECAY_CUBIC
READINGS = ("peaks", "zero_crossings", "hilbert")
# Relative errors of frequency and damping: the analytic signal is wrong by 1/cycles near its ends.
ACCURACY = {"peaks": (2e-5, 0.025), "zero_crossings": (2e-5, 0.025), "hilbert": (2e-4, 0.04)}


@pytest.fixture(scope="module")
def decay():
    return duffing.decay(4000)


def free_motion(amplitude):
    """Exact frequency, peak and fundamental velocity of the undamped oscillator, X cn(u | m)."""
    stiff = REST**2 + CUBIC * amplitude**2
    m = CUBIC * amplitude**2 / (2 * stiff)
    omega = np.pi * np.sqrt(stiff) / (2 * ellipk(m))
    nome = np.exp(-np.pi * ellipk(1 - m) / ellipk(m))
    fundamental = 2 * np.pi / (np.sqrt(m) * ellipk(m)) * np.sqrt(nome) / (1 + nome)
    peak = np.sqrt(REST**2 * amplitude**2 + CUBIC * amplitude**4 / 2)
    return omega, peak, omega * amplitude * fundamental


@pytest.mark.parametrize("reading", READINGS)
def test_duffing_decays_along_its_backbone(decay, reading):
    result = sj.methods.resonant_decay(*decay, reading=reading)
    assert result.has_result.all()
    omega, peak, fundamental = free_motion(np.linspace(1e-5, 2.1e-3, 4000))
    velocity = fundamental if reading == "hilbert" else peak
    true = np.interp(result.velocity, velocity, omega)
    assert true.max() / true.min() > 1.08
    np.testing.assert_allclose(result.natural_frequency, true, rtol=1e-3)
    modal = 2 * result.damping_ratio * result.natural_frequency
    np.testing.assert_allclose(modal, DAMPING, rtol=ACCURACY[reading][1])


@pytest.mark.parametrize("reading", READINGS)
def test_a_linear_decay_in_noise_with_its_error(reading):
    time = np.arange(0, 3, 1 / 2000)
    ratio = 0.004
    rng = np.random.default_rng(2)
    signal = np.exp(-ratio * REST * time) * np.cos(REST * np.sqrt(1 - ratio**2) * time)
    noisy = 0.3 * (signal + 1e-3 * rng.standard_normal(len(time)))
    result = sj.methods.resonant_decay(
        time, noisy, reading=reading, band=(30.0, 50.0), least_amplitude=0.02
    )
    assert abs(np.median(result.natural_frequency) / REST - 1) < ACCURACY[reading][0]
    assert abs(np.median(result.damping_ratio) / ratio - 1) < 0.01
    score = (result.damping_ratio - ratio) / result.damping_ratio_std
    assert 0.5 < np.sqrt(np.mean(score**2)) < 2.0


@pytest.mark.parametrize(("softening", "width"), [(0.0, 10.0), (-0.1, 7.0)])
def test_the_bias_of_a_filter_is_estimated_and_within_the_error(softening, width):
    """A decay e^{−Dt/2} whose frequency is ω₀ (1 + κ a²), so that nothing but the filter errs."""
    time = np.arange(0, 6, 1 / 2000)
    phase = REST * (time + softening * (1 - np.exp(-DAMPING * time)) / DAMPING)
    band = (40.5 - width / 2, 40.5 + width / 2)
    signal = np.exp(-DAMPING / 2 * time) * np.cos(phase)
    result = sj.methods.resonant_decay(time, signal, band=band, reading="zero_crossings")
    (stated,) = [note for note in result.notes if note.kind == "bias_of_filter"]
    modal = 2 * result.damping_ratio * result.natural_frequency
    # The action a²/ω decays by D + d(ln ω)/dt.
    squared = softening * result.velocity**2
    error = np.abs(modal / (DAMPING * (1 - squared / (1 + squared))) - 1)
    assert 0.4 < stated["damping"] / error.max() < 2.5
    # In addition to the filter's, the curvature within a window adds a few 1e-4.
    assert np.all(error < 3 * result.damping_ratio_std / result.damping_ratio + 1e-3)


def test_bad_records_are_refused(decay):
    time, velocity = decay
    for times, record, words in (
        (time[:300], velocity[:300], "12 cycles are needed, or 5 in which"),
        (time, np.clip(velocity, -0.2, 0.2), "it is clipped"),
        (time[::20], velocity[::20], "samples a cycle"),
        (time**1.1, velocity, "evenly spaced"),
        (time, np.where(time > 1, np.nan, velocity), "NaN or inf"),
        (time, velocity[1:], "the same length"),
    ):
        with pytest.raises(ValueError, match=words):
            sj.methods.resonant_decay(times, record)
    with pytest.raises(ValueError, match="`band` must rise"):
        sj.methods.resonant_decay(time, velocity, band=(50.0, 30.0))
    with pytest.raises(ValueError, match="`reading` must be one of"):
        sj.methods.resonant_decay(time, velocity, reading="wavelet")


def test_growth_is_not_a_mode(decay):
    time, velocity = decay
    result = sj.methods.resonant_decay(time, velocity[::-1].copy())
    assert set(result.status) == {int(sj.methods.MethodStatus.NOT_A_MODE)}
