"""Phases of something else than a velocity relative to the force are named; right ones are not."""

import dataclasses
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from truths.balanced_sets import balanced, files, linear_model, quadratic
from truths.exact_states import OMEGA, SHAPE, exact, modes, noisy, stated

import snrmjax as sj
from snrmjax.io.models import read_model
from snrmjax.io.tables import read_steady_states
from snrmjax.measure.phase_convention import MisreadPhases, wrong_phases

MEASURED = Path(__file__).resolve().parents[3] / "shared" / "data"
HERTZ = 2 * np.pi
# Recorded forms of a velocity V at Ω, and the expected diagnosis: conjugated, rotation, motion.
RECORDED = {
    "conjugated": (lambda v, _: v.conj(), (True, 0, "")),
    "displacement": (lambda v, w: v / (1j * w), (False, 1, "displacement")),
    "acceleration": (lambda v, w: v * 1j * w, (False, -1, "acceleration")),
    "ahead": (lambda v, _: 1j * v, (False, -1, "")),
    "behind": (lambda v, _: -1j * v, (False, 1, "")),
    "opposite": (lambda v, _: -v, (False, 2, "")),
    "conjugated and opposite": (lambda v, _: -v.conj(), (True, 2, "")),
    "conjugated displacement": (lambda v, w: (v / (1j * w)).conj(), (True, 1, "displacement")),
}


def recorded(data, how):
    """The states with something else recorded in place of the velocity."""
    change, _ = RECORDED[how]
    return dataclasses.replace(data, velocity=change(data.velocity, data.frequency[:, None]))


def check_named(facts, how):
    """The first of some facts names what was recorded."""
    fact = facts[0]
    assert fact.kind == "phases_misread"
    named = (fact["conjugated"], fact["quarter_turns"], fact["instead"])
    assert named == RECORDED[how][1], fact


def check_said(notes, how):
    """The first of some notes says what was recorded."""
    (fact,) = wrong_phases(recorded(noisy(1), how), modes())
    assert str(notes[0]) == str(fact)


@pytest.mark.parametrize("how", RECORDED)
@pytest.mark.parametrize("seed", [None, 1])
def test_each_recording_is_named(how, seed):
    data = noisy(seed)
    check_named(wrong_phases(recorded(data, how), modes()), how)
    assert wrong_phases(data, modes()) == ()


@pytest.mark.parametrize("how", ["conjugated", "behind", "opposite"])
def test_a_drive_voltage_is_as_good_as_a_force(how):
    level, omega, force, velocity = exact()
    data = stated(level, omega, np.full(len(level), np.nan), velocity, drive=force / 0.3)
    check_named(wrong_phases(recorded(data, how), modes()), how)
    assert wrong_phases(data, modes()) == ()


def test_of_an_unknown_force_the_unit_cannot_be_said():
    level, omega, force, velocity = exact()
    volts = stated(level, omega, np.full(len(level), np.nan), velocity, drive=force / 0.3)
    (fact,) = wrong_phases(recorded(volts, "displacement"), modes())
    assert (fact["quarter_turns"], fact["instead"]) == (1, "")


def test_a_mode_that_moves_against_the_force_is_no_wrong_sign():
    against = sj.model.linear_modes([OMEGA], [0.012], [[-SHAPE]], [3.0])
    opposite = recorded(noisy(1), "opposite")
    assert wrong_phases(opposite, against) == ()
    (fact,) = wrong_phases(noisy(1), against)
    assert (fact["quarter_turns"], fact["same_sign"]) == (2, False)


@pytest.mark.parametrize("how", RECORDED)
def test_the_flat_beam_of_the_paper(how, flat_test):
    model, data = flat_test
    assert wrong_phases(data, model) == ()
    check_named(wrong_phases(recorded(data, how), model), how)


@pytest.fixture(scope="module")
def flat_test():
    """A virtual test of the flat beam, with noise that is not stated to the check."""
    model = sj.model.flat_beam()
    errors = sj.simulate.MeasurementErrors(amplitude=0.005, phase=np.radians(0.3), force=0.002)
    test = sj.phase_resonance_test(
        model,
        [1e-3, 6e-3, 1.45e-2],
        60 * HERTZ,
        110 * HERTZ,
        recording=sj.simulate.Recording(errors=errors, seed=1),
    )
    return model, test.steady_states


def test_states_near_resonance_alone_leave_two_readings_and_both_are_said():
    data = noisy(1, widest=2)  # degrees
    assert wrong_phases(data, modes()) == ()
    assert wrong_phases(recorded(data, "conjugated"), modes()) == ()  # it may be so
    (fact,) = wrong_phases(recorded(data, "opposite"), modes())
    assert fact.kind == "phases_misread_alike"
    assert fact["readings"] == ((False, 2), (True, 2))
    assert "shifted by 180° or conjugated and then shifted by 180°" in str(fact)


def test_silent_where_the_phases_tell_nothing():
    data = noisy(1)
    at_resonance = data.select(np.arange(data.n_states) % 9 == 4)  # one state a level
    for how in ("conjugated", "displacement"):
        assert wrong_phases(recorded(at_resonance, how), modes()) == ()
    amplitudes = dataclasses.replace(
        recorded(data, "opposite"), phase_std=jnp.full(data.velocity.shape, np.pi)
    )
    assert wrong_phases(amplitudes, modes()) == ()
    assert wrong_phases(recorded(data, "opposite").select(np.arange(4)), modes()) == ()
    still = dataclasses.replace(data, velocity=jnp.zeros_like(data.velocity))
    assert wrong_phases(still, modes()) == ()


@pytest.mark.parametrize(
    "number",
    [pytest.param(k, marks=() if k in (2, 13) else pytest.mark.long) for k in range(1, 18)],
)
def test_no_law_of_the_blind_sets_passes_for_wrong_phases(number):
    """Whole sets, their single levels and both sides of resonance."""
    model, data = files(f"blind_{number:02d}")
    level, phase = np.asarray(data.level), np.angle(np.asarray(data.velocity)[:, 0])
    parts = [level >= 0, phase > 0, phase < 0, *(level == k for k in np.unique(level))]
    assert [wrong_phases(data.select(part), model) for part in parts] == [()] * len(parts)


@pytest.mark.parametrize(
    "table",
    [
        "brake_reuss_beam/response_controlled.csv",
        "brake_reuss_beam/force_controlled.csv",
        "suspended_beam/lock_in_stepped_sine.csv",
    ],
)
def test_measured_beams(table):
    if not MEASURED.is_dir():
        pytest.skip(f"the measured beams are not beside the project: {MEASURED} is missing")
    model = read_model((MEASURED / table).parent / "model.toml")
    data = read_steady_states(MEASURED / table, model)
    assert wrong_phases(data, model) == ()
    for how in ("conjugated", "ahead", "behind", "opposite", "conjugated and opposite"):
        check_named(wrong_phases(recorded(data, how), model), how)


def test_the_pointwise_verb_says_it():
    result = sj.identify_backbone(recorded(noisy(1), "conjugated"), modes())
    check_said(result.notes, "conjugated")
    with pytest.raises(MisreadPhases, match=r"As the data are: a backbone needs") as error:
        sj.identify_backbone(recorded(noisy(1), "displacement"), modes())
    check_named(error.value.facts, "displacement")


@pytest.mark.long
def test_the_joint_fit_says_it():
    flat = {"backbone": "polynomial:1@displacement", "damping": "polynomial:1@displacement"}
    for how in ("conjugated", "acceleration"):
        check_said(sj.fit_jointly(recorded(noisy(1), how), modes(), **flat).notes, how)
    few = recorded(noisy(1), "opposite").select(np.arange(9))
    with pytest.raises(MisreadPhases, match=r"As the data are: ") as error:
        sj.fit_jointly(few, modes(), backbone="polynomial:30", damping="polynomial:1")
    check_named(error.value.facts, "opposite")


@pytest.mark.long
@pytest.mark.parametrize("how", ["conjugated", "opposite"])
def test_the_diagnosis_says_it(how):
    """Of opposite signs rounding says in which minimum of nothing it ends: none is an answer."""
    result = sj.diagnose_model(linear_model(), recorded(balanced(quadratic), how))
    assert result.verdict in ("unknown", "noise_rejected")
    assert result.gap.after > 2  # times the noise, of which right phases leave one
    (fact,) = wrong_phases(recorded(balanced(quadratic), how), linear_model())
    check_named([fact], how)
    assert str(result.notes[0]) == str(fact)


@pytest.mark.parametrize(("factor", "detected"), [(1000.0, True), (0.001, True), (1.1, False)])
def test_a_force_in_another_unit_is_named(factor, detected):
    """Volts called newtons, or kilonewtons: no modal mass that a linear test finds does that."""
    data = noisy(1)
    data = dataclasses.replace(data, force=data.force * factor)
    result = wrong_phases(data, modes())
    assert bool(result) is detected
    if detected:
        assert result[0].kind == "velocity_over_force_off"
        np.testing.assert_allclose(result[0]["ratio"], 1 / factor, rtol=0.1)  # noise


@pytest.mark.parametrize("seed", range(5))
def test_states_near_resonance_are_not_taken_for_another_unit(seed):
    """There inertia hardly counts, and the mass that fits best may be any."""
    assert wrong_phases(noisy(seed, widest=2), modes()) == ()
