"""Verdicts on made-up misfits: noise of one size, structure, and levels that were left out."""

from types import SimpleNamespace

import numpy as np
import pytest

from snrmjax.diagnose.checks.cross_validation import HeldOut, HeldOutLevels, held_out
from snrmjax.diagnose.checks.patterns import pattern
from snrmjax.diagnose.checks.probabilities import considered_answers, probabilities_of
from snrmjax.diagnose.checks.verdict import (
    NeighbourNoise,
    judge_fit,
    neighbour_noise,
    refuted_by_levels,
    unproved_beyond,
)
from snrmjax.diagnose.misfit.effect_fit import EffectFit
from snrmjax.diagnose.misfit.noise_model import NoiseModel
from snrmjax.diagnose.misfit.shared_covariance import shared_covariance
from snrmjax.diagnose.search.model_search import FoundEffects

LEVELS, PER_LEVEL = 4, 15
NOISE = NeighbourNoise(1.0, 0.2)
LEVEL = np.repeat(np.arange(LEVELS), PER_LEVEL)
ANGLE = np.tile(np.linspace(-1.0, 1.0, PER_LEVEL), LEVELS)
N_ROWS = 2 * len(LEVEL)


def fit_to(rows, slopes=None, kinds=()):
    slopes = np.zeros((len(rows), 0)) if slopes is None else slopes
    values = np.zeros(slopes.shape[1])
    bounds = np.full(slopes.shape[1], np.inf)
    square = float(np.sum(rows**2))
    return EffectFit(kinds, (), values, square, rows, slopes, -bounds, bounds)


def misfit_of(order=None, shared=None, phase_unknown=False):
    """Evidence of states in a given order, with real and imaginary part of the force each."""
    order = np.arange(len(LEVEL)) if order is None else order
    shared = np.zeros((N_ROWS, 0)) if shared is None else shared
    state, column = np.repeat(np.arange(len(LEVEL)), 2), np.tile([0, 1], len(LEVEL))
    known = np.ones((len(LEVEL), 2), dtype=bool)
    whiten = np.tile(np.eye(2), (len(LEVEL), 1, 1))
    states = SimpleNamespace(level=LEVEL[order], velocity=np.exp(1j * ANGLE[order])[:, None])
    chosen = SimpleNamespace(
        states=states,
        rows=np.arange(len(LEVEL)),
        n_levels=LEVELS,
        noise_stated=True,
        orders=(),
        sensors=(0,),
    )
    chosen.phase_unknown = np.full((len(LEVEL), 1), phase_unknown)
    return SimpleNamespace(
        noise=NoiseModel(whiten, known, shared_covariance(shared), state, column),
        predictions=SimpleNamespace(chosen=chosen),
        level_numbers=np.arange(1, LEVELS + 1),
        by_linear=np.tile(np.eye(2), (len(LEVEL), 1)),
        n_rows=N_ROWS,
    )


def noise(seed=0):
    return np.random.default_rng(seed).normal(size=N_ROWS)


def verdict_on(misfit, rows):
    fit = fit_to(rows)
    found = FoundEffects(misfit, fit, fit, (), ())
    probabilities = probabilities_of(considered_answers(found, 0))
    return judge_fit(found, neighbour_noise(misfit, fit), probabilities)


@pytest.mark.parametrize("seed", range(3))
def test_noise_twice_as_large_everywhere_is_refused_as_noise(seed):
    misfit = misfit_of()
    assert pattern(misfit, fit_to(2 * noise(seed))) is None
    verdict, reasons, *_ = verdict_on(misfit, 2 * noise(seed))
    assert verdict == "noise_rejected"
    assert "understated" in reasons[0]


def test_scatter_that_grows_with_the_level_is_no_noise():
    rows = noise() * np.repeat(1.0 + LEVEL, 2)
    verdict, reasons, *_ = verdict_on(misfit_of(), rows)
    assert verdict == "unknown"
    assert reasons[1].startswith("level 4 is fitted ")
    assert reasons[1].endswith(" times worse than the others: something is missing there.")


def test_scatter_from_point_to_point_is_told_with_the_column_that_states_it():
    rows = 20 * noise() * np.repeat(1.0 + LEVEL, 2)
    misfit = misfit_of()
    *_, stated = verdict_on(misfit, rows).reasons
    assert stated.startswith("from point to point the data scatter ")
    assert "times more than the stated noise: put the scatter of a repeated test into" in stated
    assert "velocity_std_m_s, or leave that column out, and diagnose again." in stated
    misfit.predictions.chosen.noise_stated = False  # then there is no column to leave out
    *_, unstated = verdict_on(misfit, rows).reasons
    assert "than the misfit that is taken as noise" in unstated
    assert "leave that column out" not in unstated


def test_what_neighbours_along_the_resonance_share_is_no_noise():
    # A wave of one period along a level, in both parts of the force.
    rows = noise() + 1.5 * np.repeat(np.sin(np.pi * ANGLE), 2)
    shuffled = np.random.default_rng(1).permutation(len(LEVEL))
    mixed = rows.reshape(-1, 2)[shuffled].reshape(-1)
    verdict, reasons, *_ = verdict_on(misfit_of(shuffled), mixed)
    assert verdict == "unknown"
    assert "along the resonance" in reasons[1]


def test_a_fit_beside_which_a_free_curve_explains_something_is_none():
    """Too little for all of χ², and all of it in one curve: a jump, in units of noise."""
    jump = np.zeros(N_ROWS)
    jump[::2] = np.where(np.arange(len(LEVEL)) < len(LEVEL) / 2, -0.8, 0.8)
    misfit, fit = misfit_of(), fit_to(noise(1) + jump)
    assert FoundEffects(misfit, fit, fit, (), ()).p_value > 1e-3
    verdict, reasons, *_ = verdict_on(misfit, noise(1) + jump)
    assert verdict == "unknown"
    assert "order of the test" in reasons[0]
    assert verdict_on(misfit, noise(1)).verdict == "none"


@pytest.mark.parametrize("stated", [True, False])
def test_verdict_and_probabilities_agree_whether_noise_is_stated_or_not(stated):
    """A wave along the levels is no noise of any size; noise without order is one of any."""
    misfit = misfit_of()
    misfit.predictions.chosen.noise_stated = stated
    for size, unknown in ((0.0, False), (1.5, True)):
        rows = noise(2) + size * np.repeat(np.sin(np.pi * ANGLE), 2)
        # Where nothing is stated the search hands over misfits of the size of the noise.
        rows = rows if stated else rows / np.sqrt(np.mean(rows**2))
        verdict, _, _, probabilities = verdict_on(misfit, rows)
        assert (verdict == "unknown") == (probabilities["unknown"] > 0.9) == unknown


def test_what_neighbours_in_the_test_share_is_no_noise():
    shuffled = np.concatenate(
        [np.random.default_rng(k).permutation(PER_LEVEL) + PER_LEVEL * k for k in range(LEVELS)]
    )
    rows = noise() + 1.5 * np.repeat(np.sin(np.pi * ANGLE), 2)
    verdict, reasons, *_ = verdict_on(misfit_of(shuffled), rows)
    assert verdict == "unknown"
    assert "order of the test" in reasons[1]


def test_the_order_of_rows_does_not_change_the_noise_of_neighbours():
    rows = noise() + 3 * np.repeat(np.sin(np.pi * ANGLE), 2)
    shuffled = np.random.default_rng(2).permutation(len(LEVEL))
    mixed = rows.reshape(-1, 2)[shuffled].reshape(-1)
    found = neighbour_noise(misfit_of(shuffled), fit_to(mixed))
    assert found == pytest.approx(neighbour_noise(misfit_of(), fit_to(rows)), rel=1e-12)
    assert found[0] == pytest.approx(1.0, abs=3 * found[1])


def test_a_level_left_out_is_judged_with_what_the_others_leave_open():
    # With flat priors χ² of all is that of the others plus that of the level predicted from them.
    rng = np.random.default_rng(3)
    shared = 0.5 * rng.normal(size=(N_ROWS, 2))
    slopes = rng.normal(size=(N_ROWS, 2)) * np.repeat(np.where(LEVEL == 3, 5.0, 0.1), 2)[:, None]
    misfit, rows = misfit_of(shared=shared), noise(3)
    covariance, out = np.eye(N_ROWS) + shared @ shared.T, np.repeat(LEVEL == 3, 2)

    def least(keep):
        root = np.linalg.inv(np.linalg.cholesky(covariance[np.ix_(keep, keep)]))
        left, arms = root @ rows[keep], root @ slopes[keep]
        return float(np.sum((left - arms @ np.linalg.lstsq(arms, left)[0]) ** 2))

    held = held_out(misfit, fit_to(rows), fit_to(rows, slopes), 3)
    from scipy.stats import chi2

    exact = chi2.sf(least(np.ones(N_ROWS, dtype=bool)) - least(~out), out.sum())
    # Rounding of two inverses of well-conditioned matrices.
    assert held.uncertain_p_value == pytest.approx(exact, rel=1e-6)
    assert held.p_value == pytest.approx(chi2.sf(out.sum() * held.after**2, out.sum()), rel=1e-9)
    assert held.p_value < 1e-6 < 0.01 < held.uncertain_p_value
    assert held.level == 4


FINE = HeldOut(3, 5.0, 1.0, 0.5, 0.5)


@pytest.mark.parametrize(
    ("inner", "outer", "doubted", "word"),
    [
        (FINE, FINE, True, None),
        (FINE, FINE._replace(after=9.0, p_value=0.0, uncertain_p_value=0.1), True, None),
        (FINE, FINE._replace(level=5, uncertain_p_value=1e-6), False, "misses level 5"),
        (FINE._replace(after=1.5, p_value=0.01), FINE, False, None),
        (FINE._replace(after=1.5, p_value=0.01), FINE, True, "another law may act alike"),
        # Few states: it may be by chance, but the level is not predicted to within the noise.
        (FINE._replace(after=1.35, p_value=0.1), FINE, True, "another law may act alike"),
        (FINE._replace(after=1.35, p_value=0.1), FINE, False, None),
        (FINE._replace(after=6.0, p_value=0.0), FINE, False, "worse"),
        (FINE._replace(before=0.9, after=1.1, p_value=0.2), FINE, False, None),
    ],
)
def test_levels_left_out_speak_against_an_answer(inner, outer, doubted, word):
    reason = refuted_by_levels(HeldOutLevels(inner, outer), doubted=doubted)
    assert reason is None if word is None else word in reason


def test_one_of_several_that_fit_should_foretell_a_level_between_others():
    missed = FINE._replace(after=1.45, p_value=0.006, uncertain_p_value=0.006)
    assert refuted_by_levels(HeldOutLevels(missed, FINE), doubted=False) is None
    reason = refuted_by_levels(HeldOutLevels(missed, FINE), doubted=False, unclear=True)
    assert "level 3" in reason
    # By noise alone one level in twenty is missed so, and what parameters leave open excuses more.
    for held in (missed._replace(uncertain_p_value=0.05), FINE):
        assert refuted_by_levels(HeldOutLevels(held, FINE), doubted=False, unclear=True) is None


def test_a_top_level_that_open_parameters_excuse_proves_nothing():
    """A contact's law beyond the levels that put its parameters is anybody's guess."""
    assert unproved_beyond(FINE) is None
    assert unproved_beyond(FINE._replace(after=1.4, p_value=1e-4)) is None
    doubt = unproved_beyond(FINE._replace(after=13.0, p_value=1e-9, uncertain_p_value=0.3))
    assert doubt.identical
    assert not doubt.refutes
    assert "nothing proves" in doubt.reason
    assert "level 3" in doubt.decide_by


def test_what_is_smooth_in_the_order_of_the_test_is_no_noise_where_phases_are_guessed():
    """Phases of a wrong model shuffle the states: neighbours then differ by more than noise."""
    shuffled = np.random.default_rng(3).permutation(PER_LEVEL)
    order = (np.arange(LEVELS)[:, None] * PER_LEVEL + shuffled).reshape(-1)
    smooth = 5 * np.repeat(np.tile(np.linspace(-1.0, 1.0, PER_LEVEL) ** 2, LEVELS), 2)
    fit = fit_to(smooth + noise())
    known, guessed = (misfit_of(order, phase_unknown=k) for k in (False, True))
    assert neighbour_noise(known, fit)[0] > 2
    assert neighbour_noise(guessed, fit)[0] == pytest.approx(1.0, abs=0.3)
    # Noise that is larger than stated is so in every order.
    assert neighbour_noise(guessed, fit_to(2 * noise()))[0] == pytest.approx(4.0, rel=0.3)


def test_open_parameters_excuse_a_level_predicted_worse_where_parts_are_missing():
    inner, outer = HeldOut(3, 1.4, 1.8, 1e-6, 0.2), HeldOut(4, 5.0, 1.1, 0.3, 0.5)
    assert "worse than without" in refuted_by_levels(HeldOutLevels(inner, outer), doubted=False)
    assert refuted_by_levels(HeldOutLevels(inner, outer), doubted=False, parts_missing=True) is None
    certain = inner._replace(uncertain_p_value=8e-4)
    assert (
        refuted_by_levels(HeldOutLevels(certain, outer), doubted=False, parts_missing=True)
        is not None
    )


def judged(unknown, rejected=0.0, classes=(("cubic_stiffness",),)):
    """The verdict on noise that an answer leaves, with made-up probabilities."""
    misfit = misfit_of()
    fit = fit_to(noise(1), kinds=("cubic_stiffness",))
    found = FoundEffects(misfit, fit, fit, classes, ())
    probabilities = {"unknown": unknown, "noise_rejected": rejected}
    return judge_fit(found, NOISE, probabilities).verdict


def test_probabilities_decide_between_an_answer_and_none():
    assert judged(0.05) == "named"
    assert judged(0.85) == "named"  # `judge` adds a doubt
    assert judged(0.95) == "unknown"
    assert judged(0.3, rejected=0.6) == "noise_rejected"
    assert judged(0.05, classes=(("cubic_stiffness", "quintic_stiffness"),)) == "ambiguous"
