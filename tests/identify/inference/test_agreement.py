"""Whether points and joint fit agree, on states whose curves are known."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from truths.exact_states import (
    LEVELS,
    OMEGA,
    PARTICIPATION,
    SHAPE,
    TRUE,
    exact,
    modes,
    noisy,
    stated,
    truth_at,
)

import snrmjax as sj
from snrmjax.identify.inference.agreement import compare_with_pointwise
from snrmjax.identify.inference.corrected_states import (
    corrected_states,
    with_level_errors_removed,
)
from snrmjax.io.joint_results import summarise_agreement

MEASURED = Path(__file__).resolve().parents[4] / "shared" / "data"
WRONG = 1.06  # the model's modal mass over the true one
GAIN = 0.003


def wrong_modes():
    return sj.model.linear_modes([OMEGA], [0.012], [[SHAPE]], [PARTICIPATION / WRONG])


def compared(data, modes):
    fit = sj.fit_jointly(data, modes, level_gain_std=GAIN, **TRUE)
    return compare_with_pointwise(data, modes, fit)


@pytest.fixture(scope="module")
def apart():
    return compared(noisy(3, gain=GAIN), wrong_modes())


@pytest.mark.parametrize("seed", [3, pytest.param(4, marks=pytest.mark.long)])
def test_curves_of_the_same_mass_agree_without_a_word(seed):
    found = compared(noisy(seed, gain=GAIN), modes())
    assert found.agree
    assert found.notes() == ()
    assert found.reasons == ()


def test_a_wrong_modal_mass_sets_them_apart_and_is_the_reason(apart):
    assert not apart.agree
    speeds = np.asarray(apart.pointwise.velocity)
    squared, damping = truth_at(speeds)
    ratio = damping / (2 * np.sqrt(squared))
    # 2ζ̃ω̃ = A F/v at resonance: a modal mass 6 % too large gives a damping 6 % too small.
    np.testing.assert_allclose(apart.pointwise.damping_ratio * WRONG / ratio, 1.0, atol=0.03)
    np.testing.assert_allclose(apart.joint.damping_ratio / ratio, 1.0, atol=0.02)
    (note,) = apart.notes()
    assert "in damping by" in note
    assert "1.06" not in note
    (reason,) = apart.reasons
    assert "modal mass of 0.1767 kg" in reason  # 1.06/6 kg, of the model
    assert "levels" not in reason  # the mass alone explains it
    found = float(reason.split("found ")[1].split(" ")[0])
    assert found == pytest.approx(1 / (SHAPE * PARTICIPATION), rel=0.01)
    left = float(reason.split("at most ")[1].split(" ")[0])
    assert left < apart.limit


def test_differences_are_in_units_of_both_bands(apart):
    ours, theirs = apart.pointwise, apart.joint
    combined = np.sqrt(ours.natural_frequency_std**2 + theirs.natural_frequency_std**2)
    want = (theirs.natural_frequency - ours.natural_frequency) / combined
    np.testing.assert_allclose(apart.frequency_difference, want, rtol=1e-12)
    # 12 amplitudes, two curves, two sides: 5 % of chance in all (table of the normal distribution).
    assert len(apart.damping_difference) == 12
    assert apart.limit == pytest.approx(3.0781, abs=1e-4)


def test_the_table_of_the_summary(apart):
    told = summarise_agreement(apart)
    assert told["agree"] is False
    assert len(told["table"]) == 12
    row = told["table"][-1]
    assert row["velocity_m_s"] == pytest.approx(1.14, rel=0.02)  # the largest state of all
    gap = row["joint_damping_ratio"] - row["pointwise_damping_ratio"]
    assert np.sign(gap) == np.sign(row["damping_difference_in_std"])
    assert summarise_agreement(None) is None


def test_errors_of_levels_are_removed_as_they_were_found():
    level, omega, force, velocity = exact()
    gain = np.array([0.04, -0.03, 0.02, -0.05, 0.03])
    phase = np.array([0.02, -0.01, 0.03, 0.0, -0.02])
    recorded = velocity * np.exp(gain + 1j * phase)[level]
    # Levels have numbers of their own in a file.
    data = stated(level + 10, omega, force, recorded)
    errors = {"level_gain_std": 0.05, "level_phase_std": 0.03}
    fit = sj.fit_jointly(data, modes(), **TRUE, **errors)
    back = np.asarray(with_level_errors_removed(data, fit).velocity)[:, 0] / velocity
    mean = [np.mean(back[level == k]) for k in range(LEVELS)]
    # What all levels share remains, since both curves could explain it as well.
    assert np.std(np.log(np.abs(mean))) < 0.25 * np.std(gain)
    assert np.std(np.angle(mean)) < 0.25 * np.std(phase)


def test_too_few_points_are_not_compared():
    data = noisy(3, gain=GAIN)
    fit = sj.fit_jointly(data, modes(), level_gain_std=GAIN, **TRUE)
    few = dataclasses.replace(data, force=np.where(np.arange(data.n_states) < 2, data.force, 0.0))
    assert compare_with_pointwise(few, modes(), fit) is None


@pytest.mark.long
@pytest.mark.skipif(not MEASURED.exists(), reason="measured data are not there: ../shared/data")
@pytest.mark.parametrize(
    ("name", "agree"),
    [
        ("brake_reuss_beam/response_controlled", True),
        ("suspended_beam/lock_in_stepped_sine", False),
    ],
)
def test_measured_beams(name, agree):
    """At rest the suspended beam's joint fit has a third of the damping that its states have."""
    model = sj.read_model((MEASURED / name).parent / "model.toml")
    data = sj.read_steady_states(MEASURED / f"{name}.csv", model)
    fit = sj.fit_jointly(data, model)
    found = compare_with_pointwise(corrected_states(data, fit), model, fit)
    assert found.agree is agree
    assert (found.notes() == ()) is agree
