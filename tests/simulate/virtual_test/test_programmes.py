"""Programmes in the virtual laboratory: controlled motions against Duffing's oscillator."""

import jax.numpy as jnp
import numpy as np
import pytest
from truths.duffing import CUBIC, MASS, RATIO, REST, beam

import snrmjax as sj

RATE = 3000.0


@pytest.fixture(scope="module")
def laboratory():
    shaker = sj.simulate.Shaker(30.0, 8.0, mass=0.05, damping=1.0, stiffness=500.0)
    # The sensor has the opposite sign: states must come out with the model's sign.
    return sj.simulate.Laboratory(beam(sign=-1.0), shaker, sj.simulate.Instruments(), RATE)


def impedance(amplitude, omega):
    """F/v of one term of harmonic balance at a displacement amplitude, N s/m."""
    square = REST**2 + 0.75 * CUBIC * amplitude**2 - omega**2
    return MASS * (2 * RATIO * REST + square / (1j * omega))


def test_a_stepped_sine_settles_on_the_balance(laboratory):
    omega = 2 * np.pi * np.linspace(39.0, 42.6, 5)
    test = sj.simulate.stepped_sine_test(laboratory, 6.0, omega, record_cycles=20)
    states = sj.simulate.steady_states_of(laboratory, test, level=3)
    velocity, force = np.asarray(states.velocity)[:, 0], np.asarray(states.force)
    needed = impedance(np.abs(velocity) / omega, omega) * -velocity  # N; in phase with the force
    np.testing.assert_allclose(needed, force, atol=0.01 * force.max())
    assert list(states.level) == 5 * [3]
    assert test.seconds == pytest.approx(len(test.record.time) / RATE)


@pytest.mark.long
def test_an_open_loop_jumps_down_later_than_up(laboratory):
    omega = 2 * np.pi * np.linspace(39.0, 42.0, 7)
    sizes = []
    for way in (omega, omega[::-1]):
        test = sj.simulate.stepped_sine_test(
            laboratory, 10.0, way, settle_cycles=120, record_cycles=20
        )
        found = np.abs(np.asarray(sj.simulate.steady_states_of(laboratory, test).velocity)[:, 0])
        sizes.append(found[np.argsort(way)])
    up, down = sizes
    assert (up > 1.5 * down).any()
    np.testing.assert_allclose(up[[0, -1]], down[[0, -1]], rtol=0.01)


def test_phase_after_phase_a_loop_goes_around_the_fold(laboratory):
    phases, gains = np.radians([0.0, -40.0, -65.0, -80.0]), sj.simulate.LoopGains(80.0, 12.0)
    sweep = sj.simulate.phase_sweep(laboratory, 20.0, phases, gains=gains, settle_cycles=150)
    assert sweep.on_target.all()
    amplitude = np.abs(sweep.velocity) / sweep.frequency
    needed = impedance(amplitude, sweep.frequency) * sweep.velocity
    np.testing.assert_allclose(needed.real, sweep.force, rtol=3e-3)
    np.testing.assert_allclose(needed.imag / sweep.force, 0, atol=0.015)
    np.testing.assert_allclose(np.angle(sweep.velocity), phases, atol=np.radians(0.5))
    # Down from the resonance frequency falls, and then rises: the branch that open loops miss.
    assert sweep.frequency[0] > sweep.frequency[1] < sweep.frequency[2] < sweep.frequency[3]
    with pytest.raises(ValueError, match="`phases` must lie within ±90°"):
        sj.simulate.phase_sweep(laboratory, 8.0, np.array([2.0]))


def test_a_decay_begins_on_the_resonance_and_is_free(laboratory):
    test = sj.simulate.decay_test(laboratory, 8.0, 3.0)
    assert test.resonance.on_target
    assert np.abs(np.asarray(test.record.force)[1:]).max() == 0
    speed = np.abs(np.asarray(test.record.velocity))
    assert speed[:80].max() == pytest.approx(abs(test.resonance.velocity), rel=0.03)
    found = sj.methods.resonant_decay(
        np.asarray(test.record.time), np.asarray(test.record.velocity), least_amplitude=5e-3
    )
    half = REST**2 / 2
    true = np.sqrt(half + np.sqrt(half**2 + 0.75 * CUBIC * found.velocity**2))
    np.testing.assert_allclose(found.natural_frequency, true, rtol=3e-4)
    modal = 2 * found.damping_ratio * found.natural_frequency
    np.testing.assert_allclose(modal, 2 * RATIO * REST, rtol=0.03)


def test_multisine_and_sweep_are_what_was_asked_for(laboratory):
    lines = np.arange(30, 60)
    test = sj.simulate.multisine_test(laboratory, 0.02, lines, 3000, 6)
    voltage, force, velocity = (
        np.asarray(one)[-3000:]
        for one in (test.record.voltage, test.record.force, test.record.velocity)
    )
    spectrum = np.fft.rfft(voltage) / 1500
    assert np.sqrt(np.mean(voltage**2)) == pytest.approx(0.02)
    np.testing.assert_allclose(np.abs(spectrum[lines]), 0.02 * np.sqrt(2 / 30), rtol=1e-6)
    assert np.abs(np.delete(spectrum, lines)).max() < 1e-12
    mobility = (np.fft.rfft(velocity) / np.fft.rfft(force))[lines]
    omega = 2 * np.pi * lines  # small: linear; 1 Hz a line
    np.testing.assert_allclose(1 / mobility, impedance(0.0, omega), rtol=0.02)
    hertz = np.geomspace(50.0, 30.0, round(6 * RATE))  # a sweep is a table of voltages
    table = np.sin(2 * np.pi * np.cumsum(hertz) / RATE)
    swept, _ = sj.simulate.run_test(
        laboratory, sj.simulate.Playback(jnp.asarray(table)), len(table)
    )
    np.testing.assert_array_equal(swept.voltage, table)
    peak = np.argmax(np.abs(np.asarray(swept.velocity)))
    assert 2 * np.pi * hertz[peak] == pytest.approx(0.96 * REST, rel=0.03)  # late


def test_invalid_numbers_are_refused(laboratory):
    with pytest.raises(ValueError, match="`frequencies` must be positive"):
        sj.simulate.stepped_sine_test(laboratory, 1.0, np.array([REST, -1.0]))
    with pytest.raises(ValueError, match="`lines` must lie between 1 and half"):
        sj.simulate.multisine_test(laboratory, 1.0, np.array([0, 3]), 100, 2)
    with pytest.raises(ValueError, match="`decay_seconds` must be positive"):
        sj.simulate.decay_test(laboratory, 1.0, 0.0)
