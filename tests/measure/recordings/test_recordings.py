"""Channels, time records and frequency responses: what they give and what they refuse."""

import numpy as np
import pytest

from snrmjax.measure.recordings.channels import Channel
from snrmjax.measure.recordings.frequency_responses import frequency_responses
from snrmjax.measure.recordings.time_recording import time_recording

FORCE = Channel("cell", "force", "kN", 1e3)
MOTION = Channel("acc", "acceleration", "g", 9.80665, "12", "+z")


def record(samples=None, channels=(FORCE, MOTION), rate=100.0, **settings):
    values = np.arange(20.0).reshape(2, 10) if samples is None else samples
    return time_recording(values, channels, rate, **settings)


def test_values_are_in_si_and_times_count_from_the_start():
    result = record(start_time=3.0)
    assert result.values(["acc"], 2, 4) == pytest.approx(9.80665 * np.array([[12.0, 13.0]]))
    assert result.values()[0] == pytest.approx(1e3 * np.arange(10.0))
    assert result.time(8, 99) == pytest.approx([3.08, 3.09])
    assert result.duration == pytest.approx(0.1)


def test_blocks_join_to_the_whole_record():
    result = record()
    blocks = list(result.blocks(4, ["cell"], overlap=1))
    assert [one.start for one in blocks] == [0, 3, 6]
    joined = np.concatenate([blocks[0].values, *(one.values[:, 1:] for one in blocks[1:])], axis=1)
    np.testing.assert_array_equal(joined, result.values(["cell"]))


def test_integers_of_a_memory_map_are_read_as_numbers_of_their_channels(tmp_path):
    raw = np.memmap(tmp_path / "raw.bin", np.int16, "w+", shape=(2, 10))
    raw[:] = np.arange(20).reshape(2, 10)
    np.testing.assert_array_equal(record(raw).values(), record().values())


def test_a_stretch_that_is_too_large_is_refused(tmp_path):
    huge = np.lib.stride_tricks.as_strided(np.zeros(1), (2, 2**25), (0, 0))
    with pytest.raises(ValueError, match="too many for memory"):
        record(huge).values()
    assert record(huge).values(stop=3).shape == (2, 3)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"channels": ()}, "at least one channel"),
        ({"channels": (FORCE, FORCE)}, "distinct names"),
        ({"channels": (FORCE,)}, "one row per channel, 1, but has 2"),
        ({"channels": (FORCE, Channel("x", "speed"))}, "must be one of force"),
        ({"channels": (FORCE, Channel("x", calibration=0.0))}, "calibration of channel x"),
        ({"samples": np.zeros((2, 0))}, "needs samples"),
        ({"samples": np.zeros(3)}, "channels by samples"),
        ({"samples": np.zeros((2, 3), complex)}, "real numbers"),
        ({"rate": 0.0}, "must be positive"),
        ({"start_time": np.nan}, "must be finite"),
    ],
)
def test_wrong_recordings_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        record(**change)


def test_a_name_that_no_channel_has_is_refused_with_those_there_are():
    with pytest.raises(ValueError, match="no channel 'CH3'; there are cell, acc"):
        record().values(["CH3"])
    with pytest.raises(ValueError, match="`overlap`"):
        list(record().blocks(4, overlap=4))


def responses(frequency=(1.0, 2.0), values=None, **settings):
    every = np.array([[[1.0, -4.0]]]) if values is None else values
    return frequency_responses(np.array(frequency), every, [MOTION], [FORCE], **settings)


def test_responses_are_in_si_and_become_receptances():
    result = responses()
    assert result.values[0, 0] == pytest.approx(9.80665e-3 * np.array([1.0, -4.0]))
    # −ω² x = a
    assert result.receptance()[0, 0] == pytest.approx(9.80665e-3 * np.array([-1.0, 1.0]))
    assert result.to_xarray()["value_re"].sizes == {
        "response": 1,
        "reference": 1,
        "frequency_hz": 2,
    }


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"frequency": (2.0, 1.0)}, "ascending"),
        ({"frequency": (1.0,)}, "must have shape"),
        ({"values": np.full((1, 1, 2), np.nan)}, "not all missing"),
        ({"values": np.full((1, 1, 2), np.inf)}, "must be finite"),
        ({"coherence": np.ones((1, 2))}, "`coherence`"),
    ],
)
def test_wrong_responses_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        responses(**change)


def test_a_force_is_no_response():
    with pytest.raises(ValueError, match="must be a displacement, velocity or acceleration"):
        frequency_responses(
            np.array([1.0]), np.ones((1, 1, 1)), [FORCE._replace(name="f")], [FORCE]
        ).receptance()
