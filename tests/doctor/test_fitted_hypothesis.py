"""Evidence of readings on the exact responses of one mode."""

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
    judged = fit_hypothesis(checked().test)
    assert judged.noise == pytest.approx(0.003, rel=0.25)  # of 90 numbers, some 20 of them used up
    assert 0.003 < judged.misfit < 0.006
    assert judged.fits
    assert judged.fraction > 0.5  # white noise: neighbours of 45 states agree by chance at most so


def test_evidence_does_not_depend_on_units():
    """Densities are those of logarithms: of mm and mN they are the same."""
    states = checked().test
    scaled = states._replace(force=1e3 * states.force, velocity=1e3 * states.velocity)
    # The search for the hyperparameters ends 2e-3 apart where rounding differs.
    assert fit_hypothesis(scaled).evidence == pytest.approx(
        fit_hypothesis(states).evidence, abs=5e-3
    )


def test_conjugated_phasors_do_not_fit_the_models_mass_and_their_conjugates_do():
    seen = checked()
    wrong = fit_hypothesis(seen.read(seen.recorded.conj()))
    assert fit_hypothesis(seen.test).beats(wrong)
    assert not wrong.beats(fit_hypothesis(seen.test))


@pytest.mark.parametrize("factor", [1.37, 300.0, 0.004])
def test_a_wrong_scale_is_found_again(factor):
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


def test_a_fit_that_goes_on_finds_what_a_new_one_does():
    """Forces 3 % larger at one level, from the fit without."""
    states = checked().test
    moved = states._replace(force=states.force * np.where(states.level == 1, 1.03, 1.0))
    again = fit_hypothesis(moved, start=fit_hypothesis(states))
    anew = fit_hypothesis(moved, rounds=12)
    assert again.evidence == pytest.approx(anew.evidence, abs=3.0)  # of 12 that decide
    assert again.noise == pytest.approx(anew.noise, rel=0.07)  # 90 numbers tell it so


def test_a_trend_that_is_nothing_costs_its_prior_and_no_more():
    """What is freer and begins where the fit without it ended cannot explain less.

    ln of the prior's 1σ over what the states leave of it, some 4, is all that it pays.
    """
    seen = checked()
    base = fit_hypothesis(seen.test)
    drift = next(iter(corrections(seen, seen.test, base)))
    assert drift.kind == "drift"
    _, left = drift.judged.posterior.trend
    paid = base.evidence - drift.judged.evidence
    assert paid == pytest.approx(np.log(MOVES / left), abs=2.5)  # a chance of 5 σ²/2 in it


def test_values_that_are_tried_share_the_odds():
    """Of eight values that change nothing each is the table itself, and one in eight."""
    states = checked().test
    base = fit_hypothesis(states)
    fits = [base]
    for _ in range(8):
        fits.append(fit_hypothesis(states, start=fits[-1]))
    _, found = likeliest(base, [Tried(float(k), states) for k in range(8)])
    best = max(one.evidence for one in fits[1:])
    assert found.evidence == pytest.approx(best - np.log(8), abs=1e-6)  # the same fits
