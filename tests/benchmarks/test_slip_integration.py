"""The integrated bolted beams of a benchmark, against what is known of one slider and of none."""

import numpy as np
import pytest

FRACTION, RATIO, LIMIT = 0.06, 0.02, 1e-4  # of the stiffness in the slider, damping, m
OWN = 2 * np.pi * np.array([1.0, 4.0, 9.0])


@pytest.fixture(scope="module")
def integration(of_benchmark):
    return of_benchmark("slip_integration")


def beams(integration, *, limit, moving=0.0, back=0.0, drive=(1.0, 0.0, 0.0)):
    """Beams of 1 Hz and 1 kg that differ in their one slider's limit; it sees the first mode."""
    n = len(limit)
    one = [OWN, np.array(RATIO), np.array([[1.0, 0.0, 0.0]]), np.array([FRACTION * OWN[0] ** 2])]
    own, damping, bending, stiffness = (np.repeat(part[None], n, axis=0) for part in one)
    shaker = (np.full(n, moving), np.full(n, back), np.zeros(n))
    limit = np.array(limit)[:, None]
    drives = np.repeat([drive], n, axis=0)
    return integration.Beams(own, damping, bending, stiffness, limit, drives, *shaker)


def test_one_slider_has_jenkins_describing_function(integration):
    limits = np.array([10.0, 0.5, 0.2, 0.02]) * LIMIT
    own, omega = OWN[0], np.array([1.02, 1.01, 1.0, 0.99]) * OWN[0]
    rows = beams(integration, limit=limits)
    force = np.full(4, 2 * RATIO * own**2 * LIMIT)
    _, read = integration.held(rows, force, omega, integration.at_rest(rows), 120)
    amplitude = np.abs(read.velocity) / omega
    angle = np.arccos(np.clip(1 - 2 * limits / amplitude, -1, 1))  # of the part that sticks
    in_phase = (angle - np.sin(angle) * np.cos(angle)) / np.pi
    loss = 4 * limits * np.maximum(amplitude - limits, 0) / (np.pi * amplitude**2)
    assert amplitude[0] < limits[0]
    assert np.all(amplitude[1:] > 1.3 * limits[1:])
    slider = FRACTION * own**2 * (in_phase + 1j * loss)
    wanted = own**2 - omega**2 + 2j * RATIO * own * omega + slider
    found = 1j * omega * read.force / read.velocity
    # The slider's third harmonic and steps of a 96th of a cycle, of its part of the stiffness.
    np.testing.assert_allclose(found, wanted, atol=3e-3 * FRACTION * own**2)
    power = 0.5 * np.real(read.force * np.conj(read.velocity))
    np.testing.assert_allclose(read.dissipated, power, rtol=1e-3)


def test_what_is_recorded_is_the_beams_whatever_the_shaker_does(integration):
    drive = np.array([0.8, 0.5, -0.3])
    rows = beams(integration, limit=[1.0, 1.0], moving=0.3, back=0.5, drive=drive)
    frequency, ratio, shape = integration.linear_modes(rows)
    np.testing.assert_allclose(frequency[0, 0], OWN[0] * np.sqrt(1 + FRACTION), rtol=1e-12)
    omega = np.array([0.98, 1.03]) * OWN[0]
    _, read = integration.held(rows, np.ones(2), omega, integration.at_rest(rows), 120)
    each = omega[:, None]
    stiffness = frequency**2 - each**2 + 2j * ratio * frequency * each
    wanted = 1j * omega * (shape**2 / stiffness).sum(axis=1)
    np.testing.assert_allclose(read.velocity / read.force, wanted, rtol=1e-5)
    assert np.max(np.abs(read.force)) < 0.9  # of the coil's
    guess = np.array([0.99, 1.005]) * frequency[:, 0]
    found, at = integration.phase_resonance(rows, np.ones(2), guess, cycles=100, turns=5)
    assert np.max(np.abs(np.angle(at.velocity / at.force))) < 1e-4
    # Other modes turn the phase by as much as they are beside the first one.
    np.testing.assert_allclose(found, frequency[:, 0], rtol=1e-3)
