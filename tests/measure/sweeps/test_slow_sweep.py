"""Slow sweeps by time integration, against the steady states that they pass."""

import functools

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.signal import cont2discrete, lfilter

import snrmjax as sj
from snrmjax.measure import Channel, time_recording

HERTZ = 2 * np.pi
REST, RATIO, RATE = HERTZ * 10.0, 0.02, 400.0
LAWS = {
    "linear": lambda q, v: 0.0,
    "hardening": lambda q, v: 4e4 * q**3,
    "quadratic damping": lambda q, v: 0.15 * v * np.abs(v),
    "friction": lambda q, v: 8.0 * np.tanh(v / 0.2),
}
FORCE = 40.0  # N on 1 kg


def answer(law, force, turn, time, start=(0.0, 0.0)):
    """Displacement and velocity of an oscillator of 1 kg under a force with the phase `turn`."""

    def rate(t, state):
        q, v = state
        return v, force * np.cos(turn(t)) - 2 * RATIO * REST * v - REST**2 * q - law(q, v)

    result = solve_ivp(
        rate, (time[0], time[-1]), start, t_eval=time, rtol=1e-8, atol=1e-10, method="DOP853"
    )
    return result.y


def chirp(first, last, seconds, *, logarithmic=False):
    """Phase of a sweep between two frequencies in Hz as a function of time."""
    growth = np.log(last / first) / seconds
    if logarithmic:
        return lambda t: HERTZ * first * np.expm1(growth * t) / growth
    return lambda t: HERTZ * (first * t + (last - first) / (2 * seconds) * t**2)


def swept(law, first, last, seconds):
    """Force and displacement of a sweep, integrated."""
    time, turn = np.arange(round(seconds * RATE)) / RATE, chirp(first, last, seconds)
    return np.stack([FORCE * np.cos(turn(time)), answer(law, FORCE, turn, time)[0]])


@functools.cache
def linear(first, last, seconds, *, logarithmic=False):
    """Force, displacement and acceleration of the linear oscillator, exact but for the hold.

    A hold of first order at 32 times the rate: (ω/640 Hz)²/12, some 1e-5.
    """
    fine = 32
    time = np.arange(round(seconds * RATE) * fine) / (RATE * fine)
    push = FORCE * np.cos(chirp(first, last, seconds, logarithmic=logarithmic)(time))
    system = (
        [[1.0], [1.0, 2 * RATIO * REST, REST**2]],
        [[1.0, 0, 0], [1.0, 2 * RATIO * REST, REST**2]],
    )
    motion = []
    for over, under in system:
        above, below, _ = cont2discrete((over, under), 1 / (RATE * fine), method="foh")
        motion.append(lfilter(above.ravel(), below, push))
    return np.stack([push, *motion])[:, ::fine]


def recorded(values, *quantities):
    kinds = ("force", *(quantities or ("displacement", "acceleration")))[: len(values)]
    return time_recording(values, [Channel(f"CH{k + 1}", one) for k, one in enumerate(kinds)], RATE)


def steady(law, states, k):
    """Velocity phasor under the force of a state, integrated from that state until it is steady."""
    omega, force = float(states.frequency[k]), float(states.force[k])
    velocity = complex(states.velocity[k, 0])
    cycles, samples = 60, 32
    time = np.arange(cycles * samples + 1) / samples * HERTZ / omega
    start = ((velocity / (1j * omega)).real, velocity.real)
    _, v = answer(law, force, lambda t: omega * t, time, start)
    last = slice(-10 * samples - 1, -1)
    return 2 * np.mean(v[last] * np.exp(-1j * omega * time[last]))


@pytest.mark.long
@pytest.mark.parametrize("name", LAWS)
@pytest.mark.parametrize(("first", "last"), [(8.5, 12.0), (12.0, 8.5)])
def test_swept_states_are_those_of_a_stepped_sine(name, first, last):
    """A bias of the sweep of several per cent is gone to 0.3 % where the motion is no jump."""
    record = recorded(swept(LAWS[name], first, last, 60.0))
    result = sj.measure.sweep_states(record, "CH1", ["CH2"])
    plain = sj.measure.sweep_states(record, "CH1", ["CH2"], correct=False)
    assert result.corrected
    size = np.abs(np.asarray(result.states.velocity)[:, 0])
    # Close to a jump no force holds the state for long: it is not what a stepped sine could do.
    slow = np.abs(result.sweep_inertia_fraction) < (0.08 if name == "hardening" else 1.0)
    loud = np.flatnonzero((size > 0.3 * size.max()) & slow)
    error, before = [], []
    for k in loud[:: max(1, len(loud) // 4)]:
        error.append(
            abs(complex(result.states.velocity[k, 0]) / steady(LAWS[name], result.states, k) - 1)
        )
        near = int(np.argmin(np.abs(plain.time - result.time[k])))
        before.append(
            abs(
                complex(plain.states.velocity[near, 0]) / steady(LAWS[name], plain.states, near) - 1
            )
        )
    assert max(before) > 0.05 or name == "hardening"
    assert max(error) < 3e-3
    # The modal constant of 1 kg.
    assert abs(result.balance.constant - 1) < 3 * result.balance.constant_std


def test_a_linear_sweep_in_exact_numbers_and_its_predicted_bias():
    record = recorded(linear(8.5, 12.0, 60.0, logarithmic=True))
    for channel in ("CH2", "CH3"):
        result = sj.measure.sweep_states(record, "CH1", [channel])
        omega = np.asarray(result.states.frequency)
        inside = (omega > HERTZ * 9.4) & (omega < HERTZ * 11.5)
        true = 1j * omega / (REST**2 - omega**2 + 2j * RATIO * REST * omega)
        error = (
            np.asarray(result.states.velocity)[:, 0] / np.asarray(result.states.force) / true - 1
        )
        assert np.abs(error[inside]).max() < 3e-4
        plain = sj.measure.sweep_states(record, "CH1", [channel], correct=False)
        omega = np.asarray(plain.states.frequency)
        size = np.abs(np.asarray(plain.states.velocity)[:, 0] / omega)
        top = int(np.argmax(size))
        a, b, c = np.polyfit(omega[top - 2 : top + 3] - omega[top], size[top - 2 : top + 3], 2)
        bias = result.bias[0]
        shift = omega[top] - b / (2 * a) - REST * np.sqrt(1 - 2 * RATIO**2)
        assert abs(shift / bias.frequency_shift - 1) < 0.05
        peak = (c - b**2 / (4 * a)) / (FORCE / (2 * RATIO * REST**2))
        assert abs((1 - peak) / (1 - bias.peak_ratio) - 1) < 0.1


def test_both_directions_give_the_steady_answer_where_it_is_wanted():
    up, down = (linear(*ends, 60.0) for ends in ((8.5, 12.0), (12.0, 8.5)))
    record = recorded(np.concatenate([up, down], axis=1))
    wanted = HERTZ * np.array([9.5, 10.0, 10.5])
    settings = {"frequencies": wanted, "harmonic_order": (1,), "level": 3}
    both = sj.measure.sweep_states(record, "CH1", ["CH2"], **settings)
    assert both.sweep.tolist() == [0, 0, 0, 1, 1, 1]
    omega = np.asarray(both.states.frequency)
    np.testing.assert_allclose(omega, np.tile(wanted, 2), rtol=1e-6)
    true = 1j * omega / (REST**2 - omega**2 + 2j * RATIO * REST * omega)
    ratio = np.asarray(both.states.velocity)[:, 0] / np.asarray(both.states.force) / true
    # Each direction by itself is as good as the correction: a thousandth.
    assert np.abs(ratio - 1).max() < 1e-3
    assert set(np.asarray(both.states.level)) == {3}


@pytest.mark.long
def test_stated_errors_of_a_sweep_cover_the_truth():
    """Share of 95 % intervals that hold the truth, over 50 seeds of noise."""
    clean = linear(8.5, 12.0, 60.0)[:2]
    wanted = HERTZ * np.array([9.6, 10.2])
    true = 1j * wanted / (REST**2 - wanted**2 + 2j * RATIO * REST * wanted)
    size = np.abs(clean).max(axis=1, keepdims=True)
    inside = []
    for seed in range(50):
        noise = 0.01 * size * np.random.default_rng(seed).standard_normal(clean.shape)
        record = recorded(clean + noise)
        result = sj.measure.sweep_states(record, "CH1", ["CH2"], frequencies=wanted).states
        velocity, force = np.asarray(result.velocity)[:, 0], np.asarray(result.force)
        ratio = velocity / force / true
        spread = np.hypot(
            np.asarray(result.velocity_std)[:, 0] / np.abs(velocity),
            np.asarray(result.force_std) / force,
        )
        inside += [*(np.abs(np.abs(ratio) - 1) < 1.96 * spread)]
        inside += [*(np.abs(np.angle(ratio)) < 1.96 * np.asarray(result.phase_std)[:, 0])]
    assert 0.90 < np.mean(inside) < 0.99


TIME = np.arange(8000) / RATE
CHIRP = np.cos(HERTZ * (8 * TIME + 0.2 * TIME**2))
BAD = {
    "no sweep": (np.cos(HERTZ * 10 * TIME), {}, "the record has no sweep"),
    "no tone": (np.random.default_rng(0).standard_normal(len(TIME)), {}, "no sweep|no tone"),
    "cycles": (CHIRP, {"cycles": 3}, "`cycles` must be 6"),
    "beyond": (CHIRP, {"frequencies": [HERTZ * 30]}, "must lie within the sweeps, .*one is 30 Hz"),
    "negative": (CHIRP, {"frequencies": [-1.0]}, r"`frequencies` \(rad/s\) must be positive"),
    "missing": (np.where(TIME < 19, CHIRP, np.nan), {"force": "load"}, "force channel is missing"),
    "rate": (CHIRP, {"harmonic_order": (1, 40)}, "needs 4 samples per cycle"),
    "clipped": (np.clip(CHIRP, -0.5, 0.5), {"frequencies": [HERTZ * 12]}, "it is clipped"),
    "dropouts": (
        *(np.where(np.abs(TIME - 10) < 0.2, np.nan, CHIRP), {"frequencies": [HERTZ * 12]}),
        "samples are missing",
    ),
}


BAD["clipped"][1]["correct"] = BAD["dropouts"][1]["correct"] = False


@pytest.mark.parametrize(("signal", "settings", "words"), BAD.values(), ids=BAD)
def test_bad_input_is_refused_in_one_sentence(signal, settings, words):
    given = {"force": "CH1", "responses": ["CH2"]} | settings
    record = recorded(np.stack([signal, 0.1 * signal]), "velocity")
    with pytest.raises(ValueError, match=words) as caught:
        sj.measure.sweep_states(record, **given)
    assert "\n" not in str(caught.value)
