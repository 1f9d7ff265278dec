"""Estimated gains of the force and of the modal mass."""

import dataclasses

import equinox as eqx
import numpy as np
import pytest
from truths.balanced_sets import balanced, linear_model
from truths.exact_states import GAIN, driven, modes

import snrmjax as sj
from snrmjax.diagnose.checks.gains import fitted_gain, fitted_modal_mass, notes_on_gains
from snrmjax.diagnose.diagnosis import excluded_kinds
from snrmjax.diagnose.misfit.effect_fit import baseline_fit
from snrmjax.diagnose.misfit.predictions import predictions_of
from snrmjax.diagnose.misfit.weighted_misfit import weighted_misfit

WRONG = 1.06  # the model's modal mass over the true one


def model_of(known):
    """The linear mode, `known` for certain."""
    model = linear_model()
    none = np.zeros(1)
    own = dataclasses.replace(model.modes, natural_frequency_std=none, damping_ratio_std=none)
    return dataclasses.replace(model, modes=own) if known else model


def misfit_of(factor, force_gain_std=0.0, change=np.zeros_like, *, known=True):
    """A linear mode's test, its forces recorded too small by a factor."""
    data = balanced(change, per_level=5)
    data = eqx.tree_at(lambda d: d.force, data, data.force / factor)
    data = dataclasses.replace(data, force_std=0.003 * data.force)
    return weighted_misfit(predictions_of(model_of(known), data, force_gain_std))


def test_a_free_gain_is_found():
    misfit = misfit_of(1.5, force_gain_std=1.0)
    gain = fitted_gain(misfit, baseline_fit(misfit))
    assert gain == pytest.approx(1.5, rel=0.02)
    certain = misfit_of(1.0)
    assert fitted_gain(certain, baseline_fit(certain)) is None


def test_an_exceeded_stated_error_is_reported():
    """Forces larger by a half require a damping ratio far beyond its 1σ of 1 %."""
    misfit = misfit_of(1.5, known=False)
    (note,) = notes_on_gains(misfit, baseline_fit(misfit))
    assert [name for name, *_ in note["parameters"]] == ["mode_1.damping_ratio"]
    misfit = misfit_of(1.0, known=False)
    assert list(notes_on_gains(misfit, baseline_fit(misfit))) == []


@pytest.mark.parametrize(("std", "kept"), [(0.05, True), (1.0, False)])
def test_effects_driven_by_the_force_are_excluded_with_a_free_gain(std, kept):
    """With a free gain near zero force, a residual mode alone could fit anything."""
    left_out = excluded_kinds(linear_model(), std, phases=True)
    assert ({"residual_mode", "close_mode"} <= left_out) is not kept


@pytest.mark.long
def test_a_gain_near_resonance_is_kept():
    data = driven(8)
    silent = np.full(data.n_states, np.nan)
    data = dataclasses.replace(data, velocity_std=silent[:, None], phase_std=silent[:, None])
    model = sj.model.structure(modes())
    found = sj.diagnose_model(model, data)
    assert "residual_mode" not in found.effects
    gain = np.median(np.asarray(found.data.force) / np.asarray(data.drive))
    assert gain * found.answer.force_gain == pytest.approx(GAIN, rel=0.3)


def wrong_mass(std, wrong=WRONG):
    """The linear mode with a wrong modal mass, of which this relative 1σ is stated."""
    model = linear_model()
    changed = dataclasses.replace(
        model.modes,
        participation=model.modes.participation / wrong,
        modal_mass_std=None if std is None else np.array([std]),
    )
    return dataclasses.replace(model, modes=changed)


def states():
    data = balanced(np.zeros_like, per_level=5)
    return dataclasses.replace(data, force_std=0.003 * data.force)


def misfit_of_mass(std, wrong=WRONG, force_gain_std=0.0):
    return weighted_misfit(predictions_of(wrong_mass(std, wrong), states(), force_gain_std))


def true_mass():
    modes = linear_model().modes
    return 1 / abs(float(modes.mode_shape[0, 0] * modes.participation[0]))


def test_a_stated_error_of_the_modal_mass_lets_the_data_find_it():
    misfit = misfit_of_mass(0.05)
    fit = baseline_fit(misfit)
    found = fitted_modal_mass(misfit, fit)
    assert abs(found.value - true_mass()) < 3 * found.std
    assert found.std < 0.01 * true_mass()
    assert found.model == pytest.approx(WRONG * true_mass(), rel=1e-12)
    # A baseline whose mass is known for certain misses the same states by far more.
    certain = misfit_of_mass(None)
    left, missed = misfit.chi_square(fit.rows), certain.chi_square(baseline_fit(certain).rows)
    assert left < 1.5 * misfit.n_rows
    assert missed > left + 50
    note = list(notes_on_gains(misfit, fit))[-1]
    assert (note.kind, note["stated_std"]) == ("other_modal_mass", pytest.approx(0.05))
    assert note["value"] == found.value


def test_a_modal_mass_beyond_its_stated_error_is_reported():
    misfit = misfit_of_mass(0.02)
    assert list(notes_on_gains(misfit, baseline_fit(misfit)))[-1]["beyond"]


def test_a_correct_mass_and_a_free_gain_have_no_note():
    misfit = misfit_of_mass(0.05, wrong=1.0)
    assert list(notes_on_gains(misfit, baseline_fit(misfit))) == []
    # A free force gain cannot be separated from the mass: only one of them is free.
    free = misfit_of_mass(0.05, force_gain_std=1.0)
    assert fitted_modal_mass(free, baseline_fit(free)) is None


@pytest.mark.long
@pytest.mark.parametrize("std", [0.05, None])
def test_a_wrong_modal_mass_is_never_named(std):
    """An unstated 1σ is taken as 5 %: a deviation of 6 % is not significant."""
    found = sj.diagnose_model(wrong_mass(std), states())
    assert found.verdict == "none"
    assert found.effects == ()
