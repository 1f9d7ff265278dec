"""Probabilities of answers: what adds up, and what moves them."""

import dataclasses

import numpy as np
import pytest
from scipy.stats import norm
from truths.balanced_sets import balanced, linear_model, quadratic

import snrmjax as sj
from snrmjax.diagnose.checks.cross_validation import HeldOut, HeldOutLevels
from snrmjax.diagnose.checks.probabilities import (
    ConsideredAnswer,
    answer_name,
    log_evidence,
    probabilities_of,
)
from snrmjax.diagnose.checks.verdict import NeighbourNoise, judge
from snrmjax.diagnose.diagnosis_result import probability_in_words
from snrmjax.diagnose.misfit.candidates import candidate
from snrmjax.diagnose.misfit.effect_fit import baseline_fit, fit_effect
from snrmjax.diagnose.misfit.predictions import predictions_of, scales_of
from snrmjax.diagnose.misfit.weighted_misfit import weighted_misfit
from snrmjax.diagnose.search.evidence import Marginal
from snrmjax.diagnose.search.model_search import FoundEffects


def diagnosed(law, **settings):
    return sj.diagnose_model(linear_model(), balanced(law, **settings))


@pytest.fixture(scope="module")
def damped():
    return diagnosed(quadratic)


def test_probabilities_are_weights_over_their_sum():
    answers = [("a", 0.0), ("none", np.log(2.0)), ("a", 0.0), ("unknown", -np.inf)]
    found = probabilities_of([ConsideredAnswer(*one) for one in answers])
    assert found == pytest.approx({"a": 0.5, "none": 0.5, "unknown": 0.0})
    shifted = probabilities_of([ConsideredAnswer(n, w - 1e4) for n, w in answers])
    assert shifted == pytest.approx(found)


def test_an_answer_has_one_name_whatever_the_order_of_its_effects():
    assert answer_name(("b", "a")) == answer_name(("a", "b")) == "a+b"
    assert answer_name(()) == "none"


def test_noise_a_tenth_off_costs_no_evidence_and_four_times_off_does():
    """Against the density of independent normal numbers at the right noise."""

    def lost(scale):
        left = scale * norm.ppf((np.arange(200) + 0.5) / 200)
        best = norm.logpdf(left, scale=scale).sum() + 100 * np.log(2 * np.pi)
        return best - log_evidence(Marginal(200, float(left @ left), 0.0))

    assert lost(1.0) < 2.0
    assert lost(1.1) < 2.5
    assert lost(4.0) > 100


def test_an_answer_is_probable_and_all_add_up(damped):
    assert damped.effects == ("quadratic_damping",)
    assert sum(damped.probabilities.values()) == pytest.approx(1.0)
    assert {"none", "unknown", "noise_rejected"} < set(damped.probabilities)
    assert max(damped.probabilities, key=damped.probabilities.get) == "quadratic_damping"
    assert damped.probabilities["none"] < 1e-6
    # Without harmonics a drag of one direction does the same: the doubt has a share.
    assert 0.1 < damped.probabilities["unknown"] < 0.5


def test_the_answer_given_has_the_probability_of_its_classes(damped):
    own = damped.probabilities
    rival = next(name for name in own if name not in ("quadratic_damping", "none", "unknown"))
    classes = (("quadratic_damping", rival),)
    wider = dataclasses.replace(damped, answer=damped.answer._replace(candidates=classes))
    both = own["quadratic_damping"] + own[rival]
    assert wider.probability == pytest.approx(both)
    unknown = dataclasses.replace(damped, verdict=sj.diagnose.Verdict.UNKNOWN)
    assert unknown.probability == own["unknown"]


def test_an_answer_that_a_level_refutes_leaves_its_probability_to_unknown():
    """The evidence of an answer knows nothing of a level that was left out of the fit."""
    misfit = weighted_misfit(predictions_of(linear_model(), balanced(quadratic)))
    kind = "quadratic_damping"
    fit = fit_effect(misfit, candidate(kind, scales_of(misfit.predictions)))
    found = FoundEffects(misfit, fit, baseline_fit(misfit), ((kind,),), ())
    predicted, missed = HeldOut(3, 6.0, 1.0, 0.5, 0.5), HeldOut(3, 6.0, 4.0, 1e-9, 1e-9)
    for level, verdict in ((predicted, "ambiguous"), (missed, "unknown")):
        judged = judge(found, NeighbourNoise(1.0, 0.2), (), HeldOutLevels(level, level))
        assert judged.verdict == verdict
        assert judged.probabilities.get(kind, 0.0) > 0.5 or verdict == "unknown"
        assert judged.probabilities["unknown"] > 0.99 or verdict == "ambiguous"


def test_where_nothing_is_missing_that_is_the_most_probable():
    found = diagnosed(lambda velocity: 0.0 * velocity)
    assert found.verdict == "none"
    assert found.probability == found.probabilities["none"] > 0.6


@pytest.mark.long
def test_a_law_that_no_effect_follows_leaves_unknown_probable():
    """Damping that rises and falls twice over the levels."""
    found = diagnosed(lambda velocity: 3 + 3 * np.sin(4 * np.log(velocity)))
    assert found.probabilities["unknown"] > 0.95


def test_a_probability_is_never_said_to_be_certain():
    said = [probability_in_words(p) for p in (1.0, 0.999, 0.5, 0.001, 0.0)]
    assert said == ["above 99 %", "above 99 %", "50 %", "below 1 %", "below 1 %"]
