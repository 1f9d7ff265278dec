"""Levels whose force is recorded in a wrong scale: states of a known mode, one level's scaled."""

import dataclasses

import numpy as np
import pytest
from truths.balanced_sets import balanced, linear_model, quadratic

import snrmjax as sj
from snrmjax.diagnose.checks.gains import (
    LevelForces,
    level_gains,
    suspected_level_forces,
    with_forces_that_acted,
)
from snrmjax.diagnose.misfit.effect_fit import baseline_fit
from snrmjax.diagnose.misfit.predictions import predictions_of, scales_of
from snrmjax.diagnose.misfit.weighted_misfit import weighted_misfit
from snrmjax.diagnose.search.model_search import find_effects

SCALE, LEVEL = 1.06, 2  # of the recorded forces of one level of five, numbered from 0


def rescaled(data, level=LEVEL):
    return dataclasses.replace(
        data, force=np.where(np.asarray(data.level) == level, SCALE, 1.0) * data.force
    )


def searched(data, kinds=()):
    predictions = predictions_of(linear_model(), data)
    return predictions, find_effects(weighted_misfit(predictions), scales_of(predictions), kinds)


def test_the_level_is_found_and_its_gain_is_that_of_the_set():
    as_acted = balanced(np.zeros_like)
    data = rescaled(as_acted)
    predictions, found = searched(data)
    rival = suspected_level_forces(found, 1.0)
    assert (rival.levels, rival.kinds, rival.is_better) == ((LEVEL,), (), True)
    misfit = weighted_misfit(dataclasses.replace(predictions, free_level_forces=rival.places))
    gains = level_gains(misfit, baseline_fit(misfit))
    # Of a mean of nine states of 1 % in velocity and 0.7° in phase; noise may favour either part.
    assert 0.01 / 3 / 2 < gains[LEVEL].std < 0.01 / 3 * 1.5
    assert abs(gains[LEVEL].value - 1 / SCALE) < 4 * gains[LEVEL].std
    acted = with_forces_that_acted(data, gains)
    np.testing.assert_allclose(acted.force, as_acted.force, rtol=5 * gains[LEVEL].std)


@pytest.mark.long
def test_the_level_is_found_beside_the_effect_that_is_missing():
    kinds = ("linear_damping_change", "quadratic_damping")
    _, found = searched(rescaled(balanced(quadratic)), kinds)
    rival = suspected_level_forces(found, 1.0)
    assert (rival.levels, rival.kinds, rival.is_better) == ((LEVEL,), ("quadratic_damping",), True)


def test_forces_as_recorded_are_left_alone():
    data = balanced(np.zeros_like)
    predictions, found = searched(data)
    assert suspected_level_forces(found, 1.0) is None
    misfit = weighted_misfit(predictions)
    assert level_gains(misfit, baseline_fit(misfit)) == {}
    assert with_forces_that_acted(data, {}) is data


def test_of_two_levels_nothing_says_which_is_wrong():
    data = balanced(np.zeros_like, levels=2)
    assert suspected_level_forces(searched(rescaled(data, level=1))[1], 1.0) is None


def test_a_gain_that_explains_as_much_is_a_doubt():
    rival = LevelForces((2,), (3,), ("quadratic_damping",), 1.0)
    assert not rival.is_better
    reason, decide_by = rival.doubt[:2]
    assert (reason["levels"], reason["effects"]) == ((3,), ("quadratic_damping",))
    assert decide_by["levels"] == (3,)
    assert not rival.doubt.refutes


@pytest.mark.long
def test_a_diagnosis_offers_the_gain_of_the_level_before_any_effect():
    # Of levels that may differ by what nobody stated none stands out.
    model = dataclasses.replace(linear_model(), level_gain_std=np.asarray(0.01))
    found = sj.diagnose_model(model, rescaled(balanced(quadratic)))
    assert found.effects == ("quadratic_damping",)
    assert set(found.level_forces) == {LEVEL}
    assert found.level_forces[LEVEL].value == pytest.approx(1 / SCALE, abs=0.015)
    assert found.verdict_sentence.startswith(f"The force at level {LEVEL} was 0.94")
    assert f"measure level {LEVEL} again" in found.decide_by
