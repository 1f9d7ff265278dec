"""Whether an answer is doubted that says nothing of the structure."""

import dataclasses

import equinox as eqx
import numpy as np
import pytest
from truths.balanced_sets import balanced, linear_model, quadratic
from truths.exact_states import GAIN, driven, modes

import snrmjax as sj
from snrmjax.diagnose.checks.answer_checks import (
    gain_found,
    missed_forces,
    notes_on_stated_parameters,
    with_answer_checked,
)
from snrmjax.diagnose.checks.verdict import Judgement, Verdict
from snrmjax.diagnose.diagnosis import excluded_kinds
from snrmjax.diagnose.misfit.effect_fit import baseline_fit
from snrmjax.diagnose.misfit.predictions import predictions_of
from snrmjax.diagnose.misfit.weighted_misfit import weighted_misfit

NAMED = Judgement(Verdict.NAMED)


def no_change(velocity):
    return 0.0 * velocity


def model_of(known):
    """The linear mode, `known` for certain."""
    model = linear_model()
    none = np.zeros(1)
    own = dataclasses.replace(model.modes, natural_frequency_std=none, damping_ratio_std=none)
    return dataclasses.replace(model, modes=own) if known else model


def misfit_of(factor, force_gain_std=0.0, change=no_change, *, known=True):
    """A linear mode's test, its forces recorded too small by a factor."""
    data = balanced(change, per_level=5)
    data = eqx.tree_at(lambda d: d.force, data, data.force / factor)
    data = dataclasses.replace(data, force_std=0.003 * data.force)
    return weighted_misfit(predictions_of(model_of(known), data, force_gain_std))


def test_a_model_that_needs_other_forces_does_not_reproduce_the_test():
    """Recorded too small by 1.5, the forces that are needed are larger by a half."""
    misfit = misfit_of(1.5)
    fit = baseline_fit(misfit)
    for missed in missed_forces(misfit, fit).values():
        assert missed == pytest.approx(0.5, abs=0.02)  # noise of 1 % of five states
    judged = with_answer_checked(NAMED, misfit, fit, {})
    assert judged.verdict is Verdict.UNKNOWN
    assert "does not reproduce the measured responses" in judged.reasons[0]
    assert judged.open_questions[0].decide_by


def test_a_model_within_the_noise_does():
    misfit = misfit_of(1.0)
    fit = baseline_fit(misfit)
    assert max(missed_forces(misfit, fit).values()) < 0.03
    assert with_answer_checked(NAMED, misfit, fit, {}) == NAMED


def test_a_free_gain_is_found_with_its_error():
    """What a gain explains is no miss; its 1σ is where χ², its prior's part too, has risen by 1."""
    misfit = misfit_of(1.5, force_gain_std=1.0)
    fit = baseline_fit(misfit)
    gain = gain_found(misfit, fit)
    assert gain.value == pytest.approx(1.5, rel=0.02)
    moved = np.linspace(0.4, 0.6, 5)
    risen = [np.sum((misfit.base + misfit.noise.shared[:, 0] * g) ** 2) + g**2 for g in moved]
    curvature = np.polyfit(moved, risen, 2)[0]
    assert gain.std == pytest.approx(curvature**-0.5 / 1.5, rel=0.01)
    assert max(missed_forces(misfit, fit).values()) < 0.03


@pytest.mark.parametrize(("factor", "named"), [(1.02, True), (1.2, False)])
def test_an_answer_that_moves_the_gain_is_not_named(factor, named):
    """Smooth curves of amplitude had given the gain of 1."""
    misfit = misfit_of(factor, force_gain_std=1.0)
    judged = with_answer_checked(NAMED, misfit, baseline_fit(misfit), {})
    assert judged.verdict is (Verdict.NAMED if named else Verdict.AMBIGUOUS)
    assert named or "moves the force gain by +20 %" in judged.reasons[0]


def test_a_gain_that_the_answer_moves_far_away_is_none():
    misfit = misfit_of(5.0, force_gain_std=1.0)
    judged = with_answer_checked(NAMED, misfit, baseline_fit(misfit), {})
    assert judged.verdict is Verdict.UNKNOWN
    assert "force gain cannot be determined" in judged.reasons[0]
    assert "added mass" in judged.open_questions[0].decide_by


@pytest.mark.parametrize(("std", "verdict"), [(5.0, Verdict.NAMED), (30.0, Verdict.AMBIGUOUS)])
def test_an_effect_smaller_than_its_error_is_not_named(std, verdict):
    misfit = misfit_of(1.0, change=quadratic)
    label = "quadratic_damping.coefficient"
    fit = baseline_fit(misfit)._replace(
        kinds=("quadratic_damping",), labels=(label,), values=np.array([18.0])
    )
    judged = with_answer_checked(NAMED, misfit, fit, {label: std})
    assert judged.verdict is verdict
    if verdict is Verdict.AMBIGUOUS:
        assert "18 with a 1σ of 30, larger than itself" in judged.reasons[0]


def test_a_stated_error_that_is_exceeded_is_said():
    """Forces larger by a half ask for a damping ratio far beyond its 1σ of 1 %."""
    misfit = misfit_of(1.5, known=False)
    (note,) = notes_on_stated_parameters(misfit, baseline_fit(misfit))
    assert "mode_1.damping_ratio" in note
    misfit = misfit_of(1.0, known=False)
    assert notes_on_stated_parameters(misfit, baseline_fit(misfit)) == ()


def test_no_answer_stays_none():
    none = Judgement(Verdict.NOISE_REJECTED)
    misfit = misfit_of(1.5)
    assert with_answer_checked(none, misfit, baseline_fit(misfit), {}) is none


@pytest.mark.parametrize(("std", "kept"), [(0.05, True), (1.0, False)])
def test_nothing_that_the_force_drives_is_looked_for_beside_a_free_gain(std, kept):
    """A far mode beside a force of no size is a model that stands still, and fits anything."""
    left_out = excluded_kinds(linear_model(), std, phases=True)
    assert ({"residual_mode", "close_mode"} <= left_out) is not kept


@pytest.mark.long
def test_a_gain_near_resonance_is_kept_and_doubted():
    data = driven(8)
    silent = np.full(data.n_states, np.nan)
    data = dataclasses.replace(data, velocity_std=silent[:, None], phase_std=silent[:, None])
    model = sj.model.structure(modes())
    found = sj.diagnose_model(model, data)
    assert "residual_mode" not in found.effects
    (note,) = (one for one in found.notes if "determine the force gain" in one)
    assert "within 8° of resonance" in note
    assert found.verdict is not Verdict.NAMED
    gain = np.median(np.asarray(found.data.force) / np.asarray(data.drive))
    assert gain * found.answer.force_gain == pytest.approx(GAIN, rel=0.3)
