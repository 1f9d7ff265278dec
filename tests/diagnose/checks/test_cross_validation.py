"""Levels that are left out of a fit, against dense normal distributions."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import chi2
from truths.made_up_misfits import LEVEL, N_ROWS, fit_to, misfit_of, noise

from snrmjax.diagnose.checks.residuals import HeldOut, HeldOutLevels, held_out, missed_levels


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
    exact = chi2.sf(least(np.ones(N_ROWS, dtype=bool)) - least(~out), out.sum())
    # Rounding of two inverses of well-conditioned matrices.
    assert held.uncertain_p_value == pytest.approx(exact, rel=1e-6)
    assert held.p_value == pytest.approx(chi2.sf(out.sum() * held.after**2, out.sum()), rel=1e-9)
    assert held.p_value < 1e-6 < 0.01 < held.uncertain_p_value
    assert held.level == 4


FINE = HeldOut(3, 5.0, 1.0, 0.5, 0.5)


def said(inner, outer=FINE, *, doubted=False, unclear=False, parts_missing=False):
    """What two levels say of an answer."""
    chosen = SimpleNamespace(phase_unknown=np.full((1, 1), parts_missing))
    found = SimpleNamespace(
        classes=(("one", "other"),) if unclear else (("one",),),
        misfit=SimpleNamespace(predictions=SimpleNamespace(chosen=chosen)),
    )
    return missed_levels(HeldOutLevels(inner, outer), found, doubted=doubted)


@pytest.mark.parametrize(
    ("inner", "outer", "doubted", "level"),
    [
        (FINE, FINE, True, None),
        (FINE, FINE._replace(level=5, uncertain_p_value=1e-6), False, 5),
        (FINE._replace(after=1.5, p_value=0.01), FINE, False, None),
        (FINE._replace(after=1.5, p_value=0.01), FINE, True, 3),
        # Few states: it may be by chance, but the level is not predicted to within the noise.
        (FINE._replace(after=1.35, p_value=0.1), FINE, True, 3),
        (FINE._replace(after=1.35, p_value=0.1), FINE, False, None),
        # Worse than without the effects, and beyond chance.
        (FINE._replace(after=6.0, p_value=0.0), FINE, False, 3),
        (FINE._replace(before=0.9, after=1.1, p_value=0.2), FINE, False, None),
    ],
)
def test_levels_left_out_speak_against_an_answer(inner, outer, doubted, level):
    found = said(inner, outer, doubted=doubted)
    assert [one.refutes for one in found] == [True] * (level is not None)
    if level is not None:
        assert found[0].reason.kind == "level_missed"
        assert found[0].reason["level"] == found[0].decide_by["level"] == level


def test_one_of_several_that_fit_should_foretell_a_level_between_others():
    missed = FINE._replace(after=1.45, p_value=0.006, uncertain_p_value=0.006)
    assert said(missed) == []
    assert [one.refutes for one in said(missed, unclear=True)] == [True]
    # By noise alone one level in twenty is missed so, and what parameters leave open excuses more.
    for held in (missed._replace(uncertain_p_value=0.05), FINE):
        assert said(held, unclear=True) == []


def test_a_top_level_that_open_parameters_excuse_proves_nothing():
    """A contact's law beyond the levels that put its parameters is anybody's guess."""
    assert said(FINE, FINE._replace(after=1.4, p_value=1e-4)) == []
    far = FINE._replace(level=5, after=13.0, p_value=1e-9, uncertain_p_value=0.3)
    (doubt,) = said(FINE, far)
    assert doubt.identical
    assert not doubt.refutes
    assert doubt.reason.kind == "top_level_missed"
    assert doubt.decide_by["level"] == 5


def test_open_parameters_excuse_a_level_predicted_worse_where_parts_are_missing():
    inner = HeldOut(3, 1.4, 1.8, 1e-6, 0.2)
    assert [one.refutes for one in said(inner)] == [True]
    assert said(inner, parts_missing=True) == []
    certain = inner._replace(uncertain_p_value=8e-4)
    assert [one.refutes for one in said(certain, parts_missing=True)] == [True]


def test_too_few_levels_say_nothing():
    assert missed_levels(None, SimpleNamespace(), doubted=True) == []
