"""Records of steps folded to a period: known harmonics come back, phases count from the force."""

import numpy as np
import pytest

from snrmjax.measure.recordings.channels import Channel
from snrmjax.measure.recordings.stepped_sine import stepped_sine_states
from snrmjax.measure.recordings.time_recording import time_recording
from snrmjax.pipelines.whole_test import folded_records


def test_every_state_has_its_record_with_the_harmonics_that_it_was_made_of():
    time = np.arange(6000) / 1000
    # 20 and 21 Hz, three seconds each, without a jump of phase.
    turn = 2 * np.pi * np.where(time < 3, 20 * time, 21 * time - 3) + 0.7
    force = 2 * np.cos(turn) + 0.1 * np.cos(2 * turn + 0.3)
    response = 5 * np.cos(turn - 0.4) + 0.5 * np.cos(3 * turn + 0.9)
    record = time_recording(
        np.stack([force, response]),
        [Channel("cell", "force", "N"), Channel("pin", "acceleration", "g", 9.80665)],
        1000.0,
        start_time=10.0,
    )
    found = stepped_sine_states(record, "cell", ["pin"])
    folded = folded_records(record, found, "cell", "pin")
    assert len(folded) == found.states.n_states == 2
    for one in folded:
        assert (one.quantity, one.unit) == ("acceleration", "m/s^2")
        harmonics = one.response_harmonics / 9.80665
        expected = np.array([0, 5 * np.exp(-0.4j), 0, 0.5 * np.exp(0.9j), 0, 0])
        # The frequency is estimated: over a step its error turns phases by some 1e-6.
        np.testing.assert_allclose(harmonics, expected, atol=1e-4)
        assert one.force_harmonics[1] == pytest.approx(2.0, abs=1e-4)
        assert one.force_harmonics[2] == pytest.approx(0.1 * np.exp(0.3j), abs=1e-4)
        at = one.phase
        drawn = 5 * np.cos(at - 0.4) + 0.5 * np.cos(3 * at + 0.9)
        np.testing.assert_allclose(one.response / 9.80665, drawn, atol=1e-3)
