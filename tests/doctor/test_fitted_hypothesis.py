"""Evidence of interpretations on the exact responses of one mode."""

import numpy as np
import pytest
from truths.one_mode import model, noisy, states, table

from snrmjax.doctor.corrections import Tried, corrections, likeliest
from snrmjax.doctor.fitted_hypothesis import any_mass, checked_states, fit_hypothesis, with_mass
from snrmjax.doctor.priors import MOVES


def checked():
    level, w, force, v = states()
    return checked_states(table(level, w, force, noisy(v)), model(), 0, np.ones(len(v), dtype=bool))


def test_the_misfit_of_right_states_is_their_noise():
    """0.3 % of 45 states; curves and levels cost some 60 % more of so few."""
    fit = fit_hypothesis(checked().test)
    assert fit.noise == pytest.approx(0.003, rel=0.25)  # from 90 values less some 20 unknowns
    assert 0.003 < fit.misfit < 0.006
    assert fit.fits
    assert fit.fraction > 0.5  # white noise: chance correlation of neighbours among 45 states


def test_evidence_does_not_depend_on_units():
    """Densities are those of logarithms: of mm and mN they are the same."""
    states = checked().test
    scaled = states._replace(force=1e3 * states.force, velocity=1e3 * states.velocity)
    # The search for the hyperparameters ends 2e-3 apart where rounding differs.
    assert fit_hypothesis(scaled).evidence == pytest.approx(
        fit_hypothesis(states).evidence, abs=5e-3
    )


def test_conjugated_phasors_do_not_fit_the_models_mass_and_their_conjugates_do():
    states = checked()
    wrong = fit_hypothesis(states.read(states.recorded.conj()))
    assert fit_hypothesis(states.test).beats(wrong)
    assert not wrong.beats(fit_hypothesis(states.test))


@pytest.mark.parametrize("factor", [1.37, 300.0, 0.004])
def test_a_wrong_scale_is_recovered(factor):
    scale = any_mass(with_mass(checked().test, 1 / factor))
    assert abs(np.log(scale.mass / factor)) < 4 * scale.std  # 4σ: one in 16000 by chance
    assert scale.std < 0.01


def test_a_fit_pays_for_a_mode_far_from_the_linear_tests():
    """ln of K is one 1σ of 0.5 off, and of δ two of 1.5: −½(1² + 2²)."""
    states = checked().test
    (stiffness, damping), here = states.linear, fit_hypothesis(states)
    assert fit_hypothesis(states._replace(linear=None)).evidence == pytest.approx(
        here.evidence, abs=0.05
    )
    far = (stiffness * np.exp(0.5), damping * np.exp(-3.0))
    paid = here.evidence - fit_hypothesis(states._replace(linear=far)).evidence
    assert paid == pytest.approx(2.5, abs=0.15)  # K is 0.3 % above ω² and δ within 3 %


def test_a_restarted_fit_agrees_with_a_new_one():
    """Forces 3 % larger at one level, from the fit without."""
    states = checked().test
    moved = states._replace(force=states.force * np.where(states.level == 1, 1.03, 1.0))
    again = fit_hypothesis(moved, start=fit_hypothesis(states))
    anew = fit_hypothesis(moved, rounds=12)
    assert again.evidence == pytest.approx(anew.evidence, abs=3.0)  # of 12 that decide
    assert again.noise == pytest.approx(anew.noise, rel=0.07)  # known so from 90 values


def test_a_zero_trend_costs_only_its_prior():
    """A model with more unknowns, started from the fit without, cannot fit worse.

    Its only cost is ln of the prior 1σ over the posterior 1σ, some 4.
    """
    states = checked()
    base = fit_hypothesis(states.test)
    drift = next(iter(corrections(states, states.test, base)))
    assert drift.kind == "drift"
    _, left = drift.fit.posterior.trend
    paid = base.evidence - drift.fit.evidence
    assert paid == pytest.approx(np.log(MOVES / left), abs=2.5)  # a chance of 5 σ²/2 in it


def test_trial_values_share_the_prior():
    """Eight values without effect: each is the table itself, with prior probability 1/8."""
    states = checked().test
    base = fit_hypothesis(states)
    fits = [base]
    for _ in range(8):
        fits.append(fit_hypothesis(states, start=fits[-1]))
    _, fit = likeliest(base, [Tried(float(k), states) for k in range(8)])
    best = max(one.evidence for one in fits[1:])
    assert fit.evidence == pytest.approx(best - np.log(8), abs=1e-6)  # the same fits
