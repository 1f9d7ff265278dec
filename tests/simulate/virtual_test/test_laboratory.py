"""The virtual laboratory against transfer functions, and against an independent integration."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.signal import butter, freqz

import snrmjax as sj
from snrmjax.simulate import Instruments, Laboratory, Playback, Shaker, run_test

REST, RATIO, MASS = 2 * np.pi * 40.0, 0.01, 0.8
SHAPE = 1 / np.sqrt(MASS)
RATE = 4000.0


def structure(*effects):
    modes = sj.model.linear_modes([REST], [RATIO], [[SHAPE]], [SHAPE])
    return sj.model.structure(modes, effects=effects)


def effect(kind, **parameters):
    return sj.model.EFFECTS[kind](**parameters)


@pytest.fixture(scope="module")
def linear():
    """A linear structure on a shaker, filtered and undisturbed; its record."""
    shaker = Shaker(30.0, 8.0, 0.05, 1.0, 500.0)
    instruments = Instruments(filter_corner_hz=500.0, filter_order=4)
    laboratory = Laboratory(structure(), shaker, instruments, RATE, substeps=3)
    drive = 0.5 * np.sin(2 * np.pi * 42.0 * np.arange(16000) / RATE)
    record, _ = run_test(laboratory, Playback(jnp.asarray(drive)), 16000)
    return laboratory, record


def fundamental(signal, hertz):
    """Complex amplitude of the last whole cycles: 2000 samples are 21 cycles of 42 Hz."""
    part = np.asarray(signal)[-2000:]
    time = np.arange(len(signal))[-2000:] / RATE
    return 2 * np.mean(part * np.exp(-2j * np.pi * hertz * time))


def test_the_shaker_obeys_its_equations(linear):
    laboratory, record = linear
    shaker, s = laboratory.shaker, 2j * np.pi * 42.0
    mobility = s / (MASS * (s**2 + 2 * RATIO * REST * s + REST**2))
    coil = shaker.damping + shaker.motor_constant**2 / shaker.resistance
    armature = shaker.mass * s**2 + coil * s + shaker.stiffness
    pushed = shaker.motor_constant / shaker.resistance * fundamental(record.voltage, 42.0)
    force = pushed / (1 + armature * mobility / s)
    seen = fundamental(record.force, 42.0), fundamental(record.velocity, 42.0)
    # Cubics between samples are (ω period)⁴ 19/720 = 5e-7 weaker and a sample late; the filter at
    # three times the rate shifts the phase of both channels alike.
    sections = butter(4, 500.0, fs=3 * RATE, output="ba")
    chain = freqz(*sections, worN=[42.0], fs=3 * RATE)[1][0] * np.exp(-s / RATE)
    np.testing.assert_allclose(seen[0], force * chain, rtol=1e-5)
    np.testing.assert_allclose(seen[1] / seen[0], mobility, rtol=1e-5)


def plain(voltage, shaker, kind):
    """Velocity and force at samples, by the midpoint rule with 24 steps a sample.

    One mode of unit modal mass on a stiff stinger, with a stop at x = 1e-4 m or a slider of
    a fifth of the stiffness that slips at the same displacement; written without the package.
    """
    h = 1 / RATE / 24
    q = v = z = 0.0
    gap = 1e-4 / SHAPE
    inertia = 1 + shaker.mass * SHAPE**2
    found = []

    def acceleration(q, v, z, volts):
        inner = 2 * RATIO * REST * v + REST**2 * q
        if kind == "one_sided_stop":
            inner += 4 * REST**2 * max(q - gap, 0.0)
        else:
            inner -= 0.2 * REST**2 * min(max(z, q - gap), q + gap)
        current = (volts - shaker.motor_constant * SHAPE * v) / shaker.resistance
        current = min(max(current, -shaker.largest_current), shaker.largest_current)
        push = shaker.motor_constant * current - shaker.damping * SHAPE * v
        force = (push - shaker.stiffness * SHAPE * q + shaker.mass * SHAPE * inner) / inertia
        return SHAPE * force - inner, force

    most = shaker.largest_voltage
    commands = np.concatenate([np.zeros(3), np.clip(voltage, -most, most)])
    halves = np.arange(48) / 48  # from one sample to the next, on the cubic through the last four
    for first in range(len(voltage)):
        cubic = np.polyfit([-2, -1, 0, 1], commands[first : first + 4], 3)
        volts = np.clip(np.polyval(cubic, halves), -most, most)
        found.append((SHAPE * v, acceleration(q, v, z, commands[first + 2])[1]))
        for k in range(24):
            a = acceleration(q, v, z, volts[2 * k])[0]
            half = q + h / 2 * v, v + h / 2 * a
            a = acceleration(*half, z, volts[2 * k + 1])[0]
            q, v = q + h * half[1], v + h * a
            z = min(max(z, q - gap), q + gap)
    return np.array(found).T


@pytest.mark.parametrize("kind", ["one_sided_stop", "jenkins_slider"])
def test_contacts_and_friction_move_as_in_a_plain_integration(kind):
    gap = 1e-4 / SHAPE
    acting = {
        "one_sided_stop": {"stiffness": 4 * REST**2, "gap": gap},
        "jenkins_slider": {"stiffness": 0.2 * REST**2, "slip_displacement": gap},
    }
    shaker = Shaker(30.0, 8.0, 0.05, 1.0, 500.0, largest_voltage=8.0, largest_current=0.2)
    laboratory = Laboratory(
        structure(effect(kind, **acting[kind])),
        *(shaker, Instruments(), RATE),
        **{"substeps": 4, "largest_displacement": 2e-3},
    )
    time = np.arange(2000) / RATE
    drive = 10 * np.sin(2 * np.pi * (38 + 8 * time) * time)
    record, _ = run_test(laboratory, Playback(jnp.asarray(drive)), 2000)
    velocity, force = plain(drive, shaker, kind)
    assert np.abs(np.asarray(record.voltage)).max() == 8.0
    assert np.abs(velocity).max() / REST > 2e-4  # beyond the stop and the slip
    for seen, true in ((record.velocity, velocity), (record.force, force)):
        np.testing.assert_allclose(seen, true, atol=2e-3 * np.abs(true).max())


def test_a_shaker_may_be_a_source_of_force_without_dynamics():
    laboratory = Laboratory(structure(), Shaker(1e-6, 1e-6), Instruments(), RATE)
    omega = REST * np.array([0.98, 1.0])
    test = sj.simulate.stepped_sine_test(laboratory, 3.0, omega, settle_cycles=300)
    states = sj.simulate.steady_states_of(laboratory, test)
    np.testing.assert_allclose(states.force, 3.0, rtol=1e-6)
    exact = sj.model.linear_response(structure().modes, omega, np.full(2, 3.0))
    # The transient e^(−ζωt) after 300 cycles at 1 %: 7e-9; the integrator errs by 1e-6.
    np.testing.assert_allclose(states.velocity, exact, rtol=1e-5)


@pytest.mark.long
def test_microslip_settles_where_the_steady_cycle_is():
    joint = effect("iwan_microslip", coefficient=3e5, exponent=1.5)
    shaker = Shaker(3000.0, 80.0, 0.0, 0.0, 0.0)
    laboratory = Laboratory(
        structure(joint), shaker, Instruments(), 6000.0, largest_displacement=6e-4
    )
    frequencies = 2 * np.pi * np.array([38.0, 38.8, 39.6])
    test = sj.simulate.stepped_sine_test(laboratory, 60.0, frequencies)
    states = sj.simulate.steady_states_of(laboratory, test)
    for k, omega in enumerate(frequencies):
        model, rest = structure(joint), np.zeros((1, 19, 1))
        force = float(states.force[k])
        (x,), (found,) = sj.simulate.solve_at_frequency(model, force, omega, rest)
        assert found
        velocity = sj.simulate.velocity_phasors(x, omega, np.array([[SHAPE]]))
        np.testing.assert_allclose(states.velocity[k, 0], velocity[1, 0], rtol=5e-4)
    with pytest.raises(ValueError, match=r"beyond `largest_displacement`, 0\.0006 m"):
        sj.simulate.stepped_sine_test(laboratory, 600.0, frequencies[1:2])


def test_impossible_laboratories_are_refused():
    slider = effect("jenkins_slider", stiffness=1e4, slip_displacement=1e-4)
    stop = effect("one_sided_stop", stiffness=100 * REST**2, gap=1e-4)
    for acting, shaker, words in (
        ((slider,), Shaker(), "jenkins_slider needs `largest_displacement`"),
        ((stop,), Shaker(), "402.* Hz, or more, .* 3 substeps would do"),
        ((effect("sensor_gain_error", gain=0.1),), Shaker(), "has sensor_gain_error"),
        ((), Shaker(largest_current=0.0), "`largest_current` must be positive"),
    ):
        with pytest.raises(ValueError, match=words):
            Laboratory(structure(*acting), shaker, Instruments(), RATE)
    at_a_node = sj.model.linear_modes([REST, 3 * REST], [0.01, 0.01], [[1.0, 1.0]], [0.0, 1.0])
    with pytest.raises(ValueError, match="does not drive the mode of interest"):
        Laboratory(sj.model.structure(at_a_node), Shaker(), Instruments(), RATE)
    for instruments, words in (
        (Instruments(filter_corner_hz=3000.0), "at most half the sampling rate, 2000 Hz"),
        (Instruments(filter_order=1.5), "a whole number"),
        (Instruments(velocity_noise=-1.0), "must not be negative"),
    ):
        with pytest.raises(ValueError, match=words):
            Laboratory(structure(), Shaker(), instruments, RATE)
