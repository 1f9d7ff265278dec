"""Multisines through systems whose linear part is known."""

import numpy as np
import pytest

import snrmjax as sj
from snrmjax.measure import Channel, time_recording

RATE, SAMPLES, PERIODS = 512.0, 1024, 6
LINES = np.array([k for k in range(21, 200, 2) if k % 8 != 5])  # odd, some of them left out
HERTZ = 2 * np.pi


def multisine(seed, amplitude=1.0):
    rng = np.random.default_rng(seed)
    phase = rng.uniform(0, 2 * np.pi, len(LINES))
    turn = 2 * np.pi * np.outer(np.arange(SAMPLES), LINES) / SAMPLES
    return amplitude * np.cos(turn + phase).sum(axis=1)


def through(signal, squared=0.0, cubed=0.0):
    """A linear filter with an exact circular answer, and a additional static nonlinearity."""
    k = np.arange(SAMPLES // 2 + 1)
    gain = 1 / (1 - (k / 90.0) ** 2 + 0.06j * k / 90.0)
    linear = np.fft.irfft(np.fft.rfft(signal) * gain, SAMPLES)
    return linear + squared * signal**2 + cubed * signal**3, gain


def recorded(force, motion, noise=0.0, seed=0):
    both = np.tile(np.stack([force, motion]), PERIODS)
    both = both + noise * np.random.default_rng(seed).standard_normal(both.shape)
    return time_recording(both, [Channel("F", "force"), Channel("x", "displacement")], RATE)


def test_a_linear_system_is_found_with_its_period_and_lines():
    force = multisine(1)
    motion, gain = through(force)
    result = sj.measure.multisine_responses(recorded(force, motion), "F", ["x"])
    assert result.period == SAMPLES / RATE
    assert result.periods == PERIODS - 1
    np.testing.assert_allclose(result.responses.frequency, LINES * HERTZ * RATE / SAMPLES)
    np.testing.assert_allclose(result.responses.values[0, 0], gain[LINES], rtol=1e-9)
    assert np.isnan(result.total_std).all()


def test_noise_is_told_from_nonlinear_scatter():
    """Gaussian theory: the linear approximation of u³ is 3 σ² u, with σ² the input's variance."""
    squared, cubed, noise = 4e-3, 2e-4, 0.02
    records, forces = [], []
    for seed in range(16):
        force = multisine(seed)
        motion, gain = through(force, squared, cubed)
        records.append(recorded(force, motion, noise, seed))
        forces.append(force)
    result = sj.measure.multisine_responses(records, "F", ["x"])
    expected = gain[LINES] + 3 * cubed * np.var(forces)
    error = result.responses.values[0, 0] - expected
    # Realisations scatter about the linear approximation; a finite number of lines leaves 1/lines.
    score = np.abs(error) / result.total_std[0]
    assert 0.7 < np.sqrt(np.mean(score**2)) < 1.4
    # Noise alone: so many periods of so many realisations, of both channels.
    floor = noise * np.sqrt(4 / SAMPLES / (PERIODS - 1) / 16)
    np.testing.assert_allclose(
        np.sqrt(np.mean(result.noise_std[0] ** 2 / (1 + np.abs(gain[LINES]) ** 2))), floor, rtol=0.1
    )
    assert "nonlinear scatter" in repr(result)


def test_noise_errors_cover_the_truth():
    force = multisine(4)
    motion, gain = through(force)
    scores = []
    for seed in range(50):
        result = sj.measure.multisine_responses(
            recorded(force, motion, 0.1, seed),
            "F",
            ["x"],
            period=2.0,
            lines=LINES * HERTZ * RATE / SAMPLES,
        )
        error = result.responses.values[0, 0] - gain[LINES]
        scores += [*(error.real / result.noise_std[0]), *(error.imag / result.noise_std[0])]
    # The rms of a complex error is √2 that of either part.
    assert 0.90 < np.mean(np.abs(scores) * np.sqrt(2) < 1.96) < 0.98


FORCE = multisine(1)
GOOD = recorded(FORCE, through(FORCE)[0])
CHANNELS = [Channel("F", "force"), Channel("x", "displacement")]
NOISE = time_recording(np.random.default_rng(1).standard_normal((2, 8192)), CHANNELS, RATE)
BAD = {
    "no channel": (GOOD, {"force": "load"}, "no channel 'load'"),
    "no responses": (GOOD, {"responses": []}, "name a force and other channels"),
    "no period": (NOISE, {}, "no period in channel"),
    "period between samples": (GOOD, {"period": 2.001}, "whole number of samples"),
    "one period": (GOOD, {"period": 2.0, "skip": 5}, "two periods are needed after the 5"),
    "skip": (GOOD, {"skip": -1}, "`skip` must be a whole number"),
    "lines between": (GOOD, {"lines": [HERTZ * 0.3]}, "multiples of 1/period"),
    "lines too high": (GOOD, {"lines": [HERTZ * 400]}, "between 0 and half"),
    "no realisation": ((), {}, "at least one realisation"),
    "rates": (
        (GOOD, time_recording(np.ones((2, 64)), CHANNELS, 100.0)),
        {},
        "one sampling rate",
    ),
    "nothing excited": (
        *(time_recording(np.zeros((2, 4096)), CHANNELS, RATE), {"period": 2.0}),
        "nothing is excited",
    ),
    "off the clock": (
        time_recording(np.tile(np.cos(np.arange(9000) / 9.13)[None], (2, 1)), CHANNELS, RATE),
        *({}, "not a whole number"),
    ),
    "dropouts": (
        time_recording(
            np.where(np.arange(6144) == 3000, np.nan, np.tile(FORCE, 6))[None].repeat(2, 0),
            *(CHANNELS, RATE),
        ),
        *({"period": 2.0}, "not finite"),
    ),
}


@pytest.mark.parametrize(("records", "settings", "words"), BAD.values(), ids=BAD)
def test_bad_input_is_refused(records, settings, words):
    given = {"force": "F", "responses": ["x"]} | settings
    with pytest.raises(ValueError, match=words):
        sj.measure.multisine_responses(records, **given)
