"""Steady states from stepped sines whose transients and answers are known in closed form."""

import numpy as np
import pytest
from scipy.signal import lfilter

import snrmjax as sj
from snrmjax.measure import Channel, time_recording

RATE, REST, RATIO = 2000.0, 2 * np.pi * 40.0, 0.01
FREQUENCIES = np.array([38.5, 39.2, 39.8, 40.0, 40.3, 41.2])  # Hz
HERTZ = 2 * np.pi


def stepped(frequencies, forces, dwell, *, jump=None):
    """Force and displacement of a linear oscillator: steady motion and free decay, exact.

    `jump` is a generator of phases with which each step begins; without it the phase goes on.
    """
    pole = RATIO * -REST + 1j * REST * np.sqrt(1 - RATIO**2)
    state, phase, record, truth = np.zeros(2), 0.0, [], []
    for hertz, force in zip(frequencies, forces, strict=True):
        if jump is not None:
            phase = jump.uniform(0, 2 * np.pi)
        omega, time = HERTZ * hertz, np.arange(round(dwell * RATE) + 1) / RATE
        steady = force / (REST**2 - omega**2 + 2j * RATIO * REST * omega)
        turning = np.exp(1j * (omega * time + phase))
        rest = state - [(steady * turning[0]).real, (1j * omega * steady * turning[0]).real]
        free = rest[0] + 1j * (pole.real * rest[0] - rest[1]) / pole.imag
        motion, decay = steady * turning, free * np.exp(pole * time)
        record.append(np.stack([force * turning, motion + decay]).real[:, :-1])
        state = np.array([motion[-1] + decay[-1], 1j * omega * motion[-1] + pole * decay[-1]]).real
        phase += omega * time[-1]
        truth.append(1j * omega * steady)
    return np.concatenate(record, axis=1), np.array(truth)


def recorded(values, quantities=("force", "displacement"), rate=RATE, **settings):
    channels = [Channel(f"CH{k + 1}", one) for k, one in enumerate(quantities)]
    return time_recording(np.asarray(values), channels, rate, **settings)


def matched(states, frequencies, forces):
    """Which step each state is: by frequency and force together."""
    near = np.abs(np.asarray(states.frequency)[:, None] / HERTZ - frequencies)
    near += np.abs(np.log(np.asarray(states.force)[:, None] / forces))
    assert near.min(axis=1).max() < 0.02
    return near.argmin(axis=1)


def test_steps_up_and_down_at_two_levels_are_found_and_settled():
    frequencies = np.tile(np.concatenate([FREQUENCIES, FREQUENCIES[-2:0:-1]]), 2)
    forces = np.repeat([1.0, 2.5], 10)
    values, truth = stepped(frequencies, forces, 5.0, jump=np.random.default_rng(3))
    # The same motion as displacement, velocity and acceleration of three channels.
    result = sj.measure.stepped_sine_states(recorded(values), "CH1", ["CH2"], sensors=["tip"])
    states = result.states
    assert states.sensors == ("tip",)
    assert states.n_states == len(frequencies)
    np.testing.assert_allclose(np.asarray(states.frequency), HERTZ * frequencies, rtol=1e-6)
    assert set(np.asarray(states.level)[np.asarray(states.force) < 1.5]) == {1}
    assert set(np.asarray(states.level)[np.asarray(states.force) > 1.5]) == {2}
    # What may be left of a transient after 5 s (12.5 decay times) is at most the tolerance.
    error = np.abs(np.asarray(states.velocity)[:, 0] / truth - 1)
    assert error.max() < 2e-3
    assert np.all(np.diff(np.asarray(states.order)) > 0)
    assert "20 steps" in repr(result)
    # A transient's decay time is the mode's, 1/(ζω).
    seen = result.decay_time[np.isfinite(result.decay_time)]
    assert abs(np.median(seen) * RATIO * REST - 1) < 0.05


def test_every_kind_of_motion_gives_the_velocity():
    time = np.arange(6000) / RATE
    omega = HERTZ * np.where(time < 1.5, 40.0, 44.0)
    turn = omega * time + np.where(time < 1.5, 0.0, 0.7)
    motion = 1e-3 * np.exp(1j * (turn - 0.4)) + 1e-4 * np.exp(1j * (3 * turn + 0.3))
    speed = 1j * omega * (1e-3 * np.exp(1j * (turn - 0.4)) + 3e-4 * np.exp(1j * (3 * turn + 0.3)))
    push = -(omega**2) * (1e-3 * np.exp(1j * (turn - 0.4)) + 9e-4 * np.exp(1j * (3 * turn + 0.3)))
    values = np.stack([2 * np.exp(1j * turn), motion, speed, push]).real
    record = recorded(values, ("voltage", "displacement", "velocity", "acceleration"))
    states = sj.measure.stepped_sine_states(record, "CH1", ["CH2", "CH3", "CH4"]).states
    frequency = np.asarray(states.frequency)
    for sensor in range(3):
        first = 1j * frequency * 1e-3 * np.exp(-0.4j)
        third = 3j * frequency * 1e-4 * np.exp(0.3j)
        np.testing.assert_allclose(np.asarray(states.velocity)[:, sensor], first, rtol=1e-6)
        np.testing.assert_allclose(np.asarray(states.harmonics)[:, sensor, 1], third, rtol=1e-6)
    np.testing.assert_allclose(np.asarray(states.drive), 2.0, rtol=1e-6)
    assert np.isnan(np.asarray(states.force)).all()


@pytest.mark.parametrize(
    ("colour", "dwell"), [(0.0, 2.0), pytest.param(0.95, 4.0, marks=pytest.mark.long)]
)
def test_stated_errors_cover_the_truth(colour, dwell):
    """Share of 95 % intervals that hold the truth, over 60 seeds of white and coloured noise."""
    frequencies, forces = FREQUENCIES[::3], np.ones(2)
    values, truth = stepped(frequencies, forces, dwell + 3.0)
    values[1] *= 1e3  # of the size of the force
    table = [
        (k * (dwell + 3.0) + 3.0, (k + 1) * (dwell + 3.0), HERTZ * hertz)
        for k, hertz in enumerate(frequencies)
    ]
    inside = []
    for seed in range(60):
        noise = np.random.default_rng(seed).standard_normal((2, values.shape[1] + 500))
        noise = lfilter([0.05], [1, -colour], noise, axis=1)[:, 500:]
        result = sj.measure.stepped_sine_states(
            recorded(values + noise), "CH1", ["CH2"], frequencies=table, settle=0.0
        )
        states = result.states
        ratio = np.asarray(states.velocity)[:, 0] / (1e3 * truth[result.state >= 0])
        size = np.abs(ratio) - 1
        relative = np.asarray(states.velocity_std)[:, 0] / np.abs(np.asarray(states.velocity)[:, 0])
        inside += [*(np.abs(size) < 1.96 * relative)]
        inside += [*(np.abs(np.angle(ratio)) < 1.96 * np.asarray(states.phase_std)[:, 0])]
        inside += [*(np.abs(np.asarray(states.force) - 1) < 1.96 * np.asarray(states.force_std))]
    assert len(inside) > 300
    assert 0.90 < np.mean(inside) < 0.98


def test_unsettled_short_clipped_and_missing_steps_are_stated():
    values, _ = stepped(FREQUENCIES, np.ones(6), 5.0)
    each = round(5.0 * RATE)
    values[1, each + 3000] = np.nan
    part = values[1, 2 * each : 3 * each]
    part[:] = np.clip(part, -0.9 * part[-200:].max(), 0.9 * part[-200:].max())
    table = [(5.0 * k, 5.0 * k + 5.0, HERTZ * hertz) for k, hertz in enumerate(FREQUENCIES)]
    table[3] = (15.0, 15.2, table[3][2])
    table[4] = (20.0, 20.5, table[4][2])
    table[5] = (25.0, 30.0, table[5][2] * 1.02)
    result = sj.measure.stepped_sine_states(recorded(values), "CH1", ["CH2"], frequencies=table)
    names = result.variables()["status"].values.tolist()
    assert names == [
        *("settled", "not_finite", "clipped", "too_short", "unsettled", "not_found"),
    ]
    assert result.states.n_states == 1
    assert "it is clipped" in repr(result)


def test_a_force_that_drops_at_resonance_gives_levels_by_drive_or_by_runs():
    time = np.arange(round(6 * RATE)) / RATE
    hertz = np.array([38.0, 40.0, 42.0, 38.0, 40.0, 42.0])
    place = np.minimum((time).astype(int), 5)
    turn = HERTZ * hertz[place] * time
    volts = np.repeat([1.0, 2.0], 3)[place]
    force = volts * np.tile([1.0, 0.3, 1.0], 2)[place]
    values = np.stack([force, 0.1 * force, volts]) * np.cos(turn)
    record = recorded(values, ("force", "velocity", "voltage"))
    by_drive = sj.measure.stepped_sine_states(record, "CH1", ["CH2"], drive="CH3").states
    assert np.asarray(by_drive.level).tolist() == [1, 1, 1, 2, 2, 2]
    by_runs = sj.measure.stepped_sine_states(record, "CH1", ["CH2"], level="runs").states
    assert np.asarray(by_runs.level).tolist() == [1, 1, 1, 2, 2, 2]


def tones(*hertz, dwell=1.0, rate=RATE):
    time = np.arange(round(dwell * rate)) / rate
    return np.concatenate([np.cos(HERTZ * one * time) for one in hertz])


GOOD = tones(40.0, 44.0)
SWEEP = np.cos(HERTZ * (30 * np.arange(8000) / RATE + 5 * (np.arange(8000) / RATE) ** 2))
NOISE = np.random.default_rng(0).standard_normal(6000)
BAD = {
    "no force channel": (GOOD, {"force": "load"}, "force channel is missing.*no channel 'load'"),
    "no response": (GOOD, {"responses": []}, "`responses` must name at least one channel"),
    "unknown response": (GOOD, {"responses": ["tip"]}, "response channel is missing"),
    "force twice": (GOOD, {"responses": ["CH2", "CH2"]}, "named once"),
    "force is motion": (GOOD, {"force": "CH2", "responses": ["CH2"]}, "must be a force"),
    "response is force": (GOOD, {"responses": ["CH1"]}, "must be a displacement"),
    "no drive": (GOOD, {"drive": "generator"}, "drive channel is missing"),
    "sensors": (GOOD, {"sensors": ["a", "b"]}, "`sensors` must name each of the 1"),
    "rate": (tones(900.0, 950.0), {}, "has no tone"),
    "rate of a table": (
        *(GOOD, {"frequencies": [(0, 1, HERTZ * 600)]}),
        "4 samples per cycle, but channel CH1 has 3.33",
    ),
    "no steps": (SWEEP, {}, "the record has no steps"),
    "no tone": (NOISE, {}, "does not dwell at one frequency"),
    "silence": (0 * NOISE, {}, "has no tone"),
    "one step": (tones(40.0), {}, "one step only, of 40 Hz"),
    "all clipped": (np.clip(GOOD, -0.6, 0.6), {}, "none of the 2 steps.*clipped"),
    "dropouts": (
        *(np.where(np.arange(len(GOOD)) % 200 == 0, np.nan, GOOD), {"frequencies": [(0, 1, 251)]}),
        "none of the 1 steps.*not finite",
    ),
    "table beyond": (GOOD, {"frequencies": [(1, 3, 251.0)]}, "row 0.*beyond the record"),
    "table turned": (GOOD, {"frequencies": [(1, 0.5, 251.0)]}, "row 0.*must have start"),
    "table of another shape": (GOOD, {"frequencies": [251.0, 260.0]}, "must have rows of start"),
    "table is empty": (GOOD, {"frequencies": []}, "must have rows of start"),
    "harmonics": (GOOD, {"harmonic_order": (1, 30)}, "harmonic 30 of 4.* Hz lies above half"),
    "no fundamental": (GOOD, {"harmonic_order": (2, 3)}, "must contain the fundamental"),
    "settle": (GOOD, {"settle": -1.0}, "`settle` must be a time"),
    "level": (GOOD, {"level": "amplitude"}, "`level` must be one of"),
    "level without drive": (GOOD, {"level": "drive"}, "needs the channel of the drive"),
    "amplitude step": (GOOD, {"least_amplitude_step": 0.0}, "must be between 0 and 1"),
    "all too short": (GOOD, {"frequencies": [(0, 0.1, 251.0)]}, "fewer than 10 cycles"),
}


@pytest.mark.parametrize(("signal", "settings", "words"), BAD.values(), ids=BAD)
def test_bad_input_is_refused_in_one_sentence(signal, settings, words):
    given = {"force": "CH1", "responses": ["CH2"]} | settings
    record = recorded(np.stack([signal, 0.1 * signal]), ("force", "velocity"))
    with pytest.raises(ValueError, match=words) as caught:
        sj.measure.stepped_sine_states(record, **given)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("hertz", "dwell", "noise"),
    [
        # Two octaves and more.
        pytest.param(np.linspace(20, 100, 41), 1.0, 0.05, marks=pytest.mark.long),
        (np.linspace(70, 90, 41), 0.3, 0.02),  # twenty cycles each
        (np.arange(78, 79.5, 0.05), 1.25, 0.05),  # a sixteenth of the line spacing of a dwell
    ],
)
def test_steps_are_found_in_noise_with_and_without_jumps_of_phase(hertz, dwell, noise):
    rng = np.random.default_rng(5)
    time = np.arange(round(dwell * 5000)) / 5000
    on = np.concatenate([[0.0], np.cumsum(HERTZ * hertz[:-1] * len(time) / 5000)])
    for phases in (on, rng.uniform(0, 2 * np.pi, len(hertz))):
        turn = np.concatenate(
            [HERTZ * one * time + phase for one, phase in zip(hertz, phases, strict=True)]
        )
        values = np.cos(turn) + noise * rng.standard_normal((2, len(turn)))
        record = recorded(values, ("force", "velocity"), 5000.0)
        result = sj.measure.stepped_sine_states(record, "CH1", ["CH2"])
        off = np.abs(np.asarray(result.states.frequency)[:, None] / HERTZ - hertz)
        assert np.array_equal(np.unique(off.argmin(axis=1)), np.arange(len(hertz)))
        assert off.min(axis=1).max() < 0.04 / dwell


@pytest.mark.parametrize(
    ("noise", "words"), [(0.0, "does not dwell at one frequency"), (0.1, "drifts within them")]
)
def test_a_sweep_is_no_steps_and_fine_noisy_steps_are_no_sweep(noise, words):
    """Straight lines of phase fit a sweep piece by piece; within each piece it moves on."""
    rng, rate = np.random.default_rng(7), 400.0
    hertz = 10 + 0.02 * np.arange(25)  # of 30 cycles: the width of a bin is 0.3 Hz
    held = np.concatenate([np.full(round(30 / one * rate), one) for one in hertz])
    swept = np.geomspace(8.5, 12.0, round(90 * rate))
    for law in (held, swept):
        turn = HERTZ * np.cumsum(law) / rate
        values = np.cos(turn) + noise * rng.normal(size=(2, len(turn)))
        record = recorded(values, rate=rate)
        if law is held:
            result = sj.measure.stepped_sine_states(record, "CH1", ["CH2"])
            # Neighbours that noise joins are fewer: 24 to 25 of them, all at frequencies of steps.
            assert len(result.status) >= 24
        else:
            with pytest.raises(ValueError, match=rf"{words}.*a sweep\? `sweep_states`"):
                sj.measure.stepped_sine_states(record, "CH1", ["CH2"])
