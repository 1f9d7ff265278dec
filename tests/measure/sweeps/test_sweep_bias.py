"""What a sweep does to a resonance, against published fits and time integration."""

import numpy as np
import pytest

import snrmjax as sj


@pytest.mark.parametrize("rate", [0.3, 1.0, 3.0, 8.0])
def test_the_lowered_peak_is_that_of_the_published_fit(rate):
    """Lollock's fit to time integrations, 1 − exp(−2.86 η^−0.445), holds to about 1 %."""
    omega, ratio = 100.0, 0.01
    result = sj.measure.sweep_bias(omega, ratio, rate * 2 / np.pi * (ratio * omega) ** 2)
    assert abs(result.normalised_rate - rate) < 1e-9
    assert abs(result.peak_ratio - (1 - np.exp(-2.86 * rate**-0.445))) < 0.01


def test_slow_sweeps_are_shifted_in_proportion_and_down_as_up():
    up = sj.measure.sweep_bias(100.0, 0.01, 0.01)
    down = sj.measure.sweep_bias(100.0, 0.01, -0.01)
    assert up.frequency_shift == -down.frequency_shift
    # First order: the peak lags by the decay time 1/(ζω) times twice the rate.
    assert abs(up.frequency_shift / (2 * 0.01 / (0.01 * 100.0)) - 1) < 0.01
    assert abs(up.damping_ratio / 0.01 - 1) < 1e-3


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ((-1.0, 0.01, 1.0), "must be positive"),
        ((1.0, 1.5, 1.0), "between 0 and 1"),
        ((1.0, 0.01, np.inf), "`rate`.*must be finite"),
        ((100.0, 0.01, 100.0), "too fast for a resonance"),
    ],
)
def test_bad_numbers_are_refused(values, words):
    with pytest.raises(ValueError, match=words):
        sj.measure.sweep_bias(*values)
