"""A modal mass that the model has wrong is a nuisance of the diagnosis, and no effect."""

import dataclasses

import numpy as np
import pytest
from truths.balanced_sets import balanced, linear_model

import snrmjax as sj
from snrmjax.diagnose.checks.answer_checks import (
    modal_mass_found,
    notes_on_found_mass,
    with_answer_checked,
)
from snrmjax.diagnose.checks.verdict import Judgement, Verdict
from snrmjax.diagnose.misfit.effect_fit import baseline_fit
from snrmjax.diagnose.misfit.predictions import predictions_of
from snrmjax.diagnose.misfit.weighted_misfit import weighted_misfit

WRONG = 1.06  # the model's modal mass over the true one
NAMED = Judgement(Verdict.NAMED)


def wrong_model(std, wrong=WRONG):
    model = linear_model()
    changed = dataclasses.replace(
        model.modes,
        participation=model.modes.participation / wrong,
        modal_mass_std=None if std is None else np.array([std]),
    )
    return dataclasses.replace(model, modes=changed)


def states():
    data = balanced(lambda velocity: 0.0 * velocity, per_level=5)
    return dataclasses.replace(data, force_std=0.003 * data.force)


def misfit_of(std, wrong=WRONG, force_gain_std=0.0):
    return weighted_misfit(predictions_of(wrong_model(std, wrong), states(), force_gain_std))


def true_mass():
    modes = linear_model().modes
    return 1 / abs(float(modes.mode_shape[0, 0] * modes.participation[0]))


def test_a_stated_error_lets_the_data_find_it():
    misfit = misfit_of(0.05)
    fit = baseline_fit(misfit)
    found = modal_mass_found(misfit, fit)
    assert abs(found.value - true_mass()) < 3 * found.std
    assert found.std < 0.01 * true_mass()
    assert found.model == pytest.approx(WRONG * true_mass(), rel=1e-12)
    # A baseline whose mass is known for certain misses the same states by far more.
    certain = misfit_of(None)
    left, missed = misfit.chi_square(fit.rows), certain.chi_square(baseline_fit(certain).rows)
    assert left < 1.5 * misfit.n_rows
    assert missed > left + 50
    (note,) = notes_on_found_mass(misfit, fit)
    assert "stated: 5 %" in note
    assert "gain of the force or of the sensor does the same" in note


def test_a_breach_of_the_stated_error_is_said():
    misfit = misfit_of(0.02)
    (note,) = notes_on_found_mass(misfit, baseline_fit(misfit))
    assert "check the linear test" in note


def test_the_right_mass_and_a_free_gain_take_no_word():
    misfit = misfit_of(0.05, wrong=1.0)
    assert notes_on_found_mass(misfit, baseline_fit(misfit)) == ()
    # A free gain of all forces is one with the mass: only one of them is free.
    free = misfit_of(0.05, force_gain_std=1.0)
    assert modal_mass_found(free, baseline_fit(free)) is None


@pytest.mark.parametrize(
    ("std", "gain", "verdict"),
    [
        (None, 0.06, Verdict.AMBIGUOUS),
        (None, 0.3, Verdict.NAMED),  # no modal mass of a linear test is wrong by that
        (0.01, 0.06, Verdict.NAMED),  # the fit has had the mass's own error
    ],
)
@pytest.mark.parametrize("kind", ["force_gain_error", "sensor_gain_error"])
def test_a_gain_that_may_be_the_modal_mass_is_not_named(kind, std, gain, verdict):
    misfit = misfit_of(std, wrong=1.0)
    label = f"{kind}.gain"
    fit = baseline_fit(misfit)._replace(kinds=(kind,), labels=(label,), values=np.array([gain]))
    judged = with_answer_checked(NAMED, misfit, fit, {label: 0.001})
    assert judged.verdict is verdict
    if verdict is Verdict.AMBIGUOUS:
        assert "may be the modal mass" in judged.reasons[0]
        assert f"{true_mass() / 1.06:.4g} kg" in judged.reasons[0]
        assert "added mass" in judged.open_questions[0].decide_by


@pytest.mark.long
@pytest.mark.parametrize(("std", "verdict"), [(0.05, Verdict.NOTHING_MISSING), (None, None)])
def test_it_is_never_named(std, verdict):
    found = sj.diagnose_model(wrong_model(std), states())
    if verdict is not None:
        assert found.verdict is verdict
        assert found.effects == ()
    else:
        assert found.verdict is Verdict.AMBIGUOUS
        assert any("may be the modal mass" in note for note in found.notes)
