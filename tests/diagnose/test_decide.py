"""Verdicts: on made-up misfits by what they are, and on answers by probabilities made up."""

import dataclasses

import numpy as np
import pytest
from truths.balanced_sets import balanced, linear_model
from truths.made_up_misfits import (
    ANGLE,
    LEVEL,
    LEVELS,
    N_STATES,
    PER_LEVEL,
    fit_to,
    misfit_of,
    noise,
)

from snrmjax.diagnose import priors
from snrmjax.diagnose.checks.gains import LevelForces
from snrmjax.diagnose.checks.residuals import HeldOut, HeldOutLevels, pattern
from snrmjax.diagnose.decide import decide, most_probable
from snrmjax.diagnose.evidence import NOISE_REJECTED, NONE, UNKNOWN, Weighed, Weights, weights_of
from snrmjax.diagnose.misfit.candidates import candidate
from snrmjax.diagnose.misfit.effect_fit import baseline_fit, fit_effect
from snrmjax.diagnose.misfit.predictions import predictions_of, scales_of
from snrmjax.diagnose.misfit.weighted_misfit import weighted_misfit
from snrmjax.diagnose.search.model_search import FoundEffects

WAVE = np.repeat(np.sin(np.pi * ANGLE), 2)  # of one period along a level, in both parts


def verdict_on(misfit, rows):
    fit = fit_to(rows)
    found = FoundEffects(misfit, fit, fit, (), ())
    return decide(found, weights_of(found), (), None, {}, None)


@pytest.mark.parametrize("seed", range(2))
def test_noise_twice_as_large_everywhere_is_refused_as_noise(seed):
    misfit = misfit_of()
    assert pattern(misfit, fit_to(2 * noise(seed))) is None
    found = verdict_on(misfit, 2 * noise(seed))
    assert found.verdict == "noise_rejected"
    assert found.reasons[0]["ratio"] == pytest.approx(2.0, rel=0.2)
    assert sum(found.probabilities.values()) == pytest.approx(1.0)
    small = verdict_on(misfit, 0.5 * noise(seed))
    assert small.verdict == "noise_rejected"
    assert small.reasons[0]["ratio"] == pytest.approx(0.5, rel=0.2)


def test_noise_as_it_is_stated_lacks_nothing():
    for seed in range(2):
        found = verdict_on(misfit_of(), noise(seed))
        assert found.verdict == "none"
        assert found.probabilities[NONE] > 0.6


def test_scatter_that_grows_with_the_level_is_no_noise():
    found = verdict_on(misfit_of(), noise() * np.repeat(1.0 + LEVEL, 2))
    assert found.verdict == "unknown"
    assert found.reasons[1].kind == "level_worse"
    assert found.reasons[1]["level"] == 4
    # What has a pattern is no noise of any size.
    assert NOISE_REJECTED not in found.probabilities
    assert sum(found.probabilities.values()) == pytest.approx(1.0)


def test_what_neighbours_along_the_resonance_share_is_no_noise():
    shuffled = np.random.default_rng(1).permutation(N_STATES)
    mixed = (noise() + 1.5 * WAVE).reshape(-1, 2)[shuffled].reshape(-1)
    found = verdict_on(misfit_of(shuffled), mixed)
    assert found.verdict == "unknown"
    assert found.reasons[1].kind == "neighbours_alike"
    assert not found.reasons[1]["of_test"]


def test_what_neighbours_in_the_test_share_is_no_noise():
    """By χ² the noise could be 1.4 times as large as it is stated to be."""
    shuffled = np.concatenate(
        [np.random.default_rng(k).permutation(PER_LEVEL) + PER_LEVEL * k for k in range(LEVELS)]
    )
    found = verdict_on(misfit_of(shuffled), noise() + 1.5 * WAVE)
    assert found.verdict == "unknown"
    assert any(one.get("of_test") or one.get("curve") == "order" for one in found.reasons)


@pytest.mark.parametrize("stated", [True, False])
def test_a_wave_along_the_levels_is_no_noise_of_any_size(stated):
    misfit = misfit_of()
    misfit.predictions.chosen.noise_stated = stated
    for size, unknown in ((0.0, False), (1.5, True)):
        rows = noise(2) + size * WAVE
        # Where nothing is stated the search hands over misfits of the size of the noise.
        rows = rows if stated else rows / np.sqrt(np.mean(rows**2))
        found = verdict_on(misfit, rows)
        assert (found.verdict == "unknown") == (found.probabilities[UNKNOWN] > 0.9) == unknown


@pytest.fixture(scope="module")
def turned():
    """A phase error and what else it may be, whose doubts are none."""
    data = balanced(np.zeros_like, seed=2)
    data = dataclasses.replace(data, velocity=data.velocity * np.exp(-0.045j))
    misfit = weighted_misfit(predictions_of(linear_model(), data))
    fit = fit_effect(misfit, candidate("sensor_phase_error", scales_of(misfit.predictions)))
    return FoundEffects(misfit, fit, baseline_fit(misfit), (), ())


def weights(found, answer=0.0, unknown=-9.0, noise_rejected=-9.0, others=()):
    """Weights by their logarithms, of an answer, of none, and of others with the same fit."""
    every = [Weighed(frozenset(found.fit.kinds), found.misfit, found.fit, answer)]
    every += [
        Weighed(frozenset(kinds), found.misfit, found.fit, weight) for kinds, weight in others
    ]
    every.append(Weighed(frozenset(), found.misfit, found.baseline, -30.0))
    answers = sorted(every, key=lambda one: -one.log_weight)
    return Weights(tuple(answers), unknown, noise_rejected)


def judged(found, given, levels=None, std=0.1, rival=None):
    found = most_probable(found, given)
    errors = dict.fromkeys(found.fit.labels, std)
    return decide(found, given, (), levels, errors, rival)


@pytest.mark.parametrize(
    ("unknown", "rejected", "verdict"),
    [
        (0.05, 0.0, "named"),
        (0.15, 0.0, "ambiguous"),
        (0.85, 0.0, "ambiguous"),
        (0.95, 0.0, "unknown"),
        (0.3, 0.6, "noise_rejected"),
    ],
)
def test_probabilities_decide_between_an_answer_and_none(turned, unknown, rejected, verdict):
    answer, others = 1 - unknown - rejected, np.log([unknown, rejected + 1e-9])
    found = judged(turned, weights(turned, np.log(answer), *others))
    assert found.verdict == verdict
    assert sum(found.probabilities.values()) == pytest.approx(1.0)
    if unknown == 0.15:
        assert found.reasons[0]["probability"] == pytest.approx(0.15, abs=0.01)


def test_nothing_is_missing_where_that_is_the_most_probable(turned):
    found = judged(turned, weights(turned, -40.0, unknown=-40.0, noise_rejected=-40.0))
    assert found.verdict == "none"
    assert found.open_questions == ()


@pytest.mark.parametrize(("factor", "verdict"), [(1.1, "ambiguous"), (0.9, "named")])
def test_to_a_class_belongs_what_has_so_much_of_the_best_odds(turned, factor, verdict):
    others = [(("close_mode",), np.log(factor * priors.AS_GOOD))]
    given = weights(turned, others=others)
    classes = most_probable(turned, given).classes
    assert ("close_mode" in classes[0]) == (verdict == "ambiguous")
    assert classes[0][0] == "sensor_phase_error"
    assert judged(turned, given).verdict == verdict


def test_a_rival_counts_for_the_effect_that_it_lacks(turned):
    pair = turned.fit._replace(kinds=("cubic_stiffness", "quadratic_damping"))
    best = Weighed(frozenset(pair.kinds), turned.misfit, pair, 0.0)
    others = [
        (("cubic_stiffness", "cubic_damping"), -1.0),
        (("quadratic_damping", "quintic_stiffness"), -1.5),
        (("close_mode",), -2.0),
        (("jenkins_slider",), -20.0),
    ]
    rest = [
        Weighed(frozenset(kinds), turned.misfit, turned.fit, weight) for kinds, weight in others
    ]
    given = Weights((best, *rest), -9.0, -9.0)
    classes = most_probable(turned, given).classes
    assert classes == (
        ("cubic_stiffness", "quintic_stiffness", "close_mode"),
        ("quadratic_damping", "cubic_damping"),
    )


FINE, MISSED = HeldOut(3, 6.0, 1.0, 0.5, 0.5), HeldOut(3, 6.0, 4.0, 1e-9, 1e-9)


def test_answers_that_a_level_refutes_keep_a_small_share(turned):
    """The evidence of an answer knows nothing of a level that was left out of the fit."""
    given = weights(turned, unknown=np.log(0.02), others=[(("close_mode",), np.log(0.5))])
    before, after = (judged(turned, given, HeldOutLevels(level, level)) for level in (FINE, MISSED))
    assert before.verdict == "ambiguous"
    assert after.verdict == "unknown"
    for name in ("sensor_phase_error", "close_mode"):
        share = after.probabilities[(name,)] / before.probabilities[(name,)]
        assert share == pytest.approx(priors.OPEN)
    assert after.probabilities[NONE] == before.probabilities[NONE]
    assert sum(after.probabilities.values()) == pytest.approx(1.0)
    assert max(after.probabilities, key=after.probabilities.get) == UNKNOWN
    assert after.open_questions[0].decide_by.kind == "measure_level_again"


def test_a_gain_of_a_level_leaves_a_question_open(turned):
    found = judged(turned, weights(turned), rival=LevelForces((2,), (3,), (), 1.0))
    assert found.verdict == "ambiguous"
    assert found.reasons[0]["levels"] == (3,)


def test_an_effect_smaller_than_its_error_leaves_a_question_open(turned):
    found = judged(turned, weights(turned), std=1e3)
    assert found.verdict == "ambiguous"
    assert found.reasons[0].kind == "strength_unknown"
