"""The phase-locked loop in the virtual laboratory, against an oscillator's exact backbone."""

import numpy as np
import pytest
from truths import duffing
from truths.duffing import CUBIC, RATIO, REST

import snrmjax as sj
from snrmjax.methods import MethodStatus


@pytest.fixture(scope="module")
def beam():
    return duffing.beam()


def laboratory(beam, **noise):
    shaker = sj.simulate.Shaker(3.0, 8.0, mass=0.05, damping=1.0, stiffness=500.0)
    return sj.simulate.Laboratory(beam, shaker, sj.simulate.Instruments(**noise), 6000.0)


def backbone(velocity):
    """ω̃ at a velocity amplitude, one term of harmonic balance: ω̃² = ω² + ¾ β (v/ω̃)²."""
    half = REST**2 / 2
    return np.sqrt(half + np.sqrt(half**2 + 0.75 * CUBIC * velocity**2))


VOLTAGES = np.array([0.5, 1.5, 3.0, 5.0])


def test_it_climbs_the_backbone_on_a_shaker_whose_force_drops(beam):
    result = sj.methods.phase_locked_loop(laboratory(beam), VOLTAGES)
    assert result.has_result.all()
    assert result.natural_frequency[-1] / REST > 1.05
    np.testing.assert_allclose(result.natural_frequency, backbone(result.velocity), rtol=2e-4)
    modal = 2 * result.damping_ratio * result.natural_frequency
    np.testing.assert_allclose(modal, 2 * RATIO * REST, rtol=3e-3)
    assert result.test_seconds == pytest.approx(4 * 350 / 40.0, rel=1e-3)


@pytest.mark.long
def test_the_result_does_not_depend_on_the_gains_and_bad_ones_are_reported(beam):
    lab = laboratory(beam)
    one = sj.methods.phase_locked_loop(lab, VOLTAGES[1:3])
    gains = sj.simulate.LoopGains(2 * np.pi * 3.0, 2 * np.pi * 0.25)
    other = sj.methods.phase_locked_loop(lab, VOLTAGES[1:3], gains=gains, settle_cycles=500)
    np.testing.assert_allclose(one.natural_frequency, other.natural_frequency, rtol=1e-5)
    np.testing.assert_allclose(one.damping_ratio, other.damping_ratio, rtol=1e-4)
    wild = sj.simulate.LoopGains(2 * np.pi * 0.2, 2 * np.pi * 40.0)
    lost = sj.methods.phase_locked_loop(lab, VOLTAGES[1:3], gains=wild)
    assert list(lost.status) == 2 * [int(MethodStatus.NOT_LOCKED)]


def test_noise_stays_within_its_error(beam):
    lab = laboratory(beam, force_noise=0.02, velocity_noise=2e-3)
    result = sj.methods.phase_locked_loop(lab, VOLTAGES[2:3].repeat(6))
    assert result.has_result.all()
    off = result.natural_frequency - backbone(result.velocity)
    score = (off - off.mean()) / result.natural_frequency_std
    assert 0.4 < np.sqrt(np.mean(score**2)) < 2.5
    np.testing.assert_allclose(result.natural_frequency, backbone(result.velocity), rtol=5e-4)


def test_inadmissible_settings_are_refused(beam):
    with pytest.raises(ValueError, match="`voltages` must be positive"):
        sj.methods.phase_locked_loop(laboratory(beam), np.array([1.0, -1.0]))
    with pytest.raises(ValueError, match="`sampling_rate` times `substeps` must be 20 times"):
        sj.simulate.Laboratory(beam, sj.simulate.Shaker(), sj.simulate.Instruments(), 100.0)
    with pytest.raises(ValueError, match="must not be negative"):
        sj.simulate.Laboratory(
            beam, sj.simulate.Shaker(mass=-1.0), sj.simulate.Instruments(), 2000.0
        )
