"""Structures on a moving base: the oscillator's own formula, and three ways to excite one."""

import numpy as np
import pytest
from truths.excitations import errors_of

import snrmjax as sj

HERTZ = 2 * np.pi
OWN, RATIO, MASS = 50 * HERTZ, 0.02, 0.4
OMEGA = HERTZ * np.array([49.0, 50.0, 51.5])
BASE = np.array([2.0, 1.5j, -1.0 + 1.0j])  # m/s², phasors of any reference


def relative_velocity(along=1.0):
    """iΩz of z̈ + 2ζωż + ω²z = −c·a, the oscillator's foot moving with a."""
    return -along * 1j * OMEGA * BASE / (OWN**2 - OMEGA**2 + 2j * RATIO * OWN * OMEGA)


@pytest.mark.parametrize("relative", [True, False])
@pytest.mark.parametrize("along", [1.0, -0.5])
def test_a_linear_oscillator_is_found_by_its_base(relative, along):
    seen = relative_velocity(along) + (0 if relative else along * BASE / (1j * OMEGA))
    states = sj.measure.base_excited_states(
        [1, 2, 3], OMEGA, BASE, seen[:, None], along=[along], relative=relative
    )
    np.testing.assert_allclose(states.force, np.abs(BASE), rtol=1e-12)
    modes = sj.model.linear_modes([OWN], [RATIO], [[MASS**-0.5]], [-along * MASS**0.5])
    result = sj.identify.identify_points(states, modes)
    np.testing.assert_allclose(result.natural_frequency, OWN, rtol=1e-12)
    np.testing.assert_allclose(result.damping_ratio, RATIO, rtol=1e-10)


def test_shapes_that_disagree_are_said():
    with pytest.raises(ValueError, match=r"`velocity` \(3, 1\), but have"):
        sj.measure.base_excited_states([1, 2, 3], OMEGA, BASE, np.ones((2, 1)))
    with pytest.raises(ValueError, match="one number per sensor"):
        sj.measure.base_excited_states([1, 2, 3], OMEGA, BASE, np.ones((3, 1)), along=[1.0, 1.0])


@pytest.mark.long
@pytest.mark.parametrize(
    ("way", "frequency", "damping"),
    # Damping of the third harmonic, which the closed form leaves out, is 0.2 %.
    [
        ("point", 5e-5, 3e-3),
        ("base", 5e-5, 3e-3),
        ("fixture", 1e-4, 3e-3),
    ],
)
def test_three_ways_to_excite_a_duffing_oscillator_in_time_give_one_backbone(
    way, frequency, damping
):
    speed, off, off_damping, failed = errors_of(way, 2)
    assert failed == 0
    assert len(speed) == 6
    assert np.abs(off).max() < frequency
    assert np.abs(off_damping).max() < damping
