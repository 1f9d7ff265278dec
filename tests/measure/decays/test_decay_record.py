"""Which records of a free decay are read, and which are refused."""

import numpy as np
import pytest

from snrmjax.measure.decays.decay_record import even_record

TIME = np.arange(0.0, 20.0, 1e-3)


def decay(digit):
    """1.7 Hz, 2 % of critical, rounded by a converter."""
    whole = np.exp(-0.02 * 2 * np.pi * 1.7 * TIME) * np.cos(2 * np.pi * 1.7 * TIME + 0.4)
    return digit * np.round(whole / digit) if digit else whole


@pytest.mark.parametrize("digit", [0.0, 1e-4, 5e-3, 5e-2])
def test_digits_of_a_converter_are_no_clipping(digit):
    """An encoder of 5e-3 of the range stays at a slow extreme for 20 samples of 1 ms."""
    signal = decay(digit)
    times, same = even_record(TIME, signal)
    np.testing.assert_array_equal(times, TIME)
    np.testing.assert_array_equal(same, signal)


@pytest.mark.parametrize("digit", [0.0, 1e-4, 5e-3])
@pytest.mark.parametrize("limit", [0.5, 0.8])
def test_a_clipped_record_is_refused_however_it_is_rounded(digit, limit):
    with pytest.raises(ValueError, match="it is clipped"):
        even_record(TIME, np.clip(decay(digit), -limit, limit))
