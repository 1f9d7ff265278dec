"""Evidence of fitted answers against integrals done otherwise."""

import numpy as np
import pytest
from scipy.integrate import trapezoid
from scipy.special import logsumexp
from scipy.stats import halfcauchy, multivariate_normal
from truths.balanced_sets import balanced, linear_model, quadratic

from snrmjax.diagnose.misfit.candidates import candidate
from snrmjax.diagnose.misfit.effect_fit import baseline_fit, fit_effect
from snrmjax.diagnose.misfit.predictions import predictions_of, scales_of
from snrmjax.diagnose.misfit.weighted_misfit import weighted_misfit
from snrmjax.diagnose.search.evidence import FittedAnswer, fitted_answer


def made_up(seed, parameters):
    """An answer at its best fit: no parameter would lower what is left."""
    rng = np.random.default_rng(seed)
    left, arms = 2 * rng.normal(size=30), 3 * rng.normal(size=(30, parameters))
    if parameters:
        left = left - arms @ np.linalg.lstsq(arms, left)[0]
    return FittedAnswer(("a",), left, arms)


@pytest.mark.parametrize("parameters", [0, 3])
@pytest.mark.parametrize("scale", [1.0, 1.7])
def test_a_linear_answer_has_the_density_of_a_normal_distribution(parameters, scale):
    """Directions with unit normal priors add their outer product to the covariance."""
    one, further = made_up(1, parameters), np.random.default_rng(2).normal(size=(30, 40))
    found = one.marginal(), one.with_discrepancy(further, (0.5,))[0]
    own = np.eye(30) + one.arms @ one.arms.T
    for marginal, covariance in zip(found, (own, own + 0.25 * further @ further.T), strict=True):
        truth = multivariate_normal.logpdf(one.left, cov=scale**2 * covariance)
        said = marginal.log_likelihood(np.array([scale]))[0] - 15 * np.log(2 * np.pi)
        assert said == pytest.approx(truth, rel=1e-10)


def test_a_fit_that_ended_early_is_not_credited_with_what_a_step_might_gain():
    one, early = made_up(1, 3), made_up(1, 3)
    early = early._replace(left=early.left + 4 * early.arms[:, 0])
    assert early.marginal().chi_square == pytest.approx(float(early.left @ early.left))
    assert early.marginal().volume == one.marginal().volume


def test_evidence_of_an_effect_is_the_integral_over_its_prior():
    """By quadrature over the strength, every prediction computed anew."""
    misfit = weighted_misfit(predictions_of(linear_model(), balanced(quadratic)))
    one = candidate("quadratic_damping", scales_of(misfit.predictions))
    fit = fit_effect(misfit, one)
    strength = fit.values[0] * np.linspace(0.5, 1.5, 41)
    rows, _ = misfit.evaluated(misfit.predictions.group, fit.labels, strength[:, None])
    half_square = 0.5 * np.sum(misfit.noise.decorrelated(rows) ** 2, axis=1)
    prior = halfcauchy.pdf(strength, scale=one.starts[0][0])
    least = half_square.min()
    truth = np.log(trapezoid(np.exp(least - half_square) * prior, strength)) - least
    answer = fitted_answer(misfit, fit)
    said = answer.marginal().log_likelihood(np.ones(1))[0]
    assert said == pytest.approx(truth, abs=0.05)  # the peak is one per cent wide and nearly normal
    nothing = fitted_answer(misfit, baseline_fit(misfit)).marginal()
    assert logsumexp([said, nothing.log_likelihood(np.ones(1))[0]]) == pytest.approx(said, abs=1e-3)
