"""Estimated phases of states with known magnitudes, against an exact dynamic stiffness."""

import numpy as np
import pytest
from truths.phased_states import OMEGA, RATIO, dynamic, nothing, states_of

from snrmjax.diagnose.naming.phases import likely_dynamic_stiffness


def hardening(strength):
    return lambda x: strength * x**2


def friction(x, omega):
    """Coulomb's: ∝ 1/(aΩ), 15 % of the linear damping at the largest amplitude."""
    return 0.003 / (x * omega)


@pytest.mark.parametrize(
    ("stiffness", "damping", "degrees"),
    [
        (nothing, nothing, 0.3),
        (hardening(0.02), nothing, 2.0),
        (hardening(0.2), nothing, 2.0),  # ten half-power bandwidths
        (hardening(-0.05), nothing, 2.0),
        (nothing, friction, 4.0),
        (hardening(0.02), friction, 4.0),
    ],
)
def test_magnitudes_at_several_frequencies_determine_the_phases(stiffness, damping, degrees):
    states = states_of(stiffness, damping, noise=0.0)
    x, omega = states.amplitude / states.amplitude.max(), states.frequency
    squared = OMEGA**2 * (1 + stiffness(x))
    exact = squared - omega**2 + 1j * omega * OMEGA * (2 * RATIO + damping(x, omega / OMEGA))
    # The states have this dynamic stiffness.
    np.testing.assert_allclose(np.abs(exact), states.force * states.constant / states.amplitude)
    found = likely_dynamic_stiffness(np.abs(exact), dynamic(omega), states.amplitude, OMEGA)
    np.testing.assert_allclose(np.abs(found), np.abs(exact), rtol=1e-12)
    off = np.degrees(np.abs(np.angle(found / exact)))
    assert np.sqrt(np.mean(off**2)) < degrees


def test_noise_of_the_magnitudes_makes_small_phase_errors():
    states = states_of(hardening(0.02), nothing, noise=5e-3)
    omega = states.frequency
    x = states.amplitude / states.amplitude.max()
    exact = OMEGA**2 * (1 + 0.02 * x**2) - omega**2 + 2j * RATIO * OMEGA * omega
    magnitude = states.force * states.constant / states.amplitude
    found = likely_dynamic_stiffness(magnitude, dynamic(omega), states.amplitude, OMEGA)
    off = np.degrees(np.abs(np.angle(found / exact)))
    assert np.median(off) < 3
