"""Ring-downs detected in a record, against the simulated oscillator."""

import numpy as np
import pytest

import snrmjax as sj
from snrmjax.measure import Channel, time_recording

HERTZ, RATE = 2 * np.pi, 2000.0
REST, RATIO = HERTZ * 40.0, 0.004
SHAPE = np.array([1.0, -0.6, 0.3])
TIME = np.arange(12000) / RATE
ON = 1.0  # s of drive in every 3 s


def record(kind="velocity", noise=1e-3, drive="voltage", seed=0):
    """Two bursts of a tone and the free decays after them; a hum of the drive stays."""
    since = TIME % 3.0
    push = np.where(since < ON, np.cos(REST * TIME), 0.0) * np.where(TIME < 3, 1.0, 0.5)
    turning = RATIO * -REST + 1j * REST * np.sqrt(1 - RATIO**2)
    free = np.exp(turning * np.maximum(since - ON, 0.0))
    size = np.where(TIME < 3, 0.2, 0.1)
    velocity = size * np.where(since < ON, np.exp(1j * REST * TIME), free)
    power = {"displacement": -1, "velocity": 0, "acceleration": 1}[kind]
    motion = (velocity * turning**power).real
    rng = np.random.default_rng(seed)
    scale = noise * REST**power * 0.2
    values = np.vstack([push, SHAPE[:, None] * motion])
    values[1:] += scale * rng.standard_normal((3, len(TIME)))
    values[0] += 0.002 * rng.standard_normal(len(TIME))
    names = [Channel("drive", drive), *(Channel(f"CH{k}", kind) for k in range(3))]
    return time_recording(values, names, RATE)


def test_the_free_part_begins_where_the_drive_ends():
    result = sj.measure.find_ring_downs(record(), "drive", "CH0")
    assert [abs(one.start - wanted) <= 25 for one, wanted in zip(result, (2000, 8000), strict=True)]
    assert result[0].stop == pytest.approx(6000, abs=150)
    assert result[1].stop == len(TIME)
    assert result[0].frequency == pytest.approx(REST, rel=1e-2)


STEADY = time_recording(
    np.stack([np.cos(REST * TIME), np.cos(REST * TIME)]),
    [Channel("drive", "voltage"), Channel("CH0", "velocity")],
    RATE,
)
BAD = {
    "never stops": (STEADY, {}, "channel drive never stops for 12 cycles"),
    "no drive": (STEADY, {"drive": "generator"}, "no channel 'generator'"),
    "nothing rings": (
        time_recording(np.zeros((2, 500)), STEADY.channels, RATE),
        *({}, "there is no free decay"),
    ),
    "quiet": (STEADY, {"quiet": 2.0}, "`quiet` must be between"),
}


@pytest.mark.parametrize(("recording", "settings", "words"), BAD.values(), ids=BAD)
def test_bad_input_is_refused(recording, settings, words):
    given = {"drive": "drive", "response": "CH0"} | settings
    with pytest.raises(ValueError, match=words):
        sj.measure.find_ring_downs(recording, given.pop("drive"), given.pop("response"), **given)
