"""Levels that are left out of a fit, against dense normal distributions."""

import numpy as np
import pytest
from scipy.stats import chi2
from truths.made_up_misfits import LEVEL, N_ROWS, fit_to, misfit_of, noise

from snrmjax.diagnose.checks.residuals import held_out


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
