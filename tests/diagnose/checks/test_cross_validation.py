"""Levels that are left out of a fit, against dense normal distributions."""

import numpy as np
import pytest
from scipy.stats import chi2
from truths.made_up_misfits import LEVEL, N_ROWS, fit_to, misfit_of, noise

from snrmjax.diagnose.checks.residuals import held_out


def test_a_level_left_out_is_judged_by_what_the_others_say():
    rng = np.random.default_rng(3)
    shared = 0.5 * rng.normal(size=(N_ROWS, 2))
    slopes = rng.normal(size=(N_ROWS, 2)) * np.repeat(np.where(LEVEL == 3, 5.0, 0.1), 2)[:, None]
    misfit, rows = misfit_of(shared=shared), noise(3)
    covariance, out = np.eye(N_ROWS) + shared @ shared.T, np.repeat(LEVEL == 3, 2)
    root = np.linalg.inv(np.linalg.cholesky(covariance[np.ix_(~out, ~out)]))
    change = np.linalg.lstsq(root @ slopes[~out], -root @ rows[~out])[0]
    left = rows + slopes @ change
    # Of a normal distribution: the rows left out given the others.
    gain = covariance[np.ix_(out, ~out)] @ np.linalg.inv(covariance[np.ix_(~out, ~out)])
    given = covariance[np.ix_(out, out)] - gain @ covariance[np.ix_(~out, out)]
    away = left[out] - gain @ left[~out]
    exact = float(away @ np.linalg.solve(given, away))
    held = held_out(misfit, fit_to(rows), fit_to(rows, slopes), 3)
    # Rounding of two inverses of well-conditioned matrices.
    assert out.sum() * held.after**2 == pytest.approx(exact, rel=1e-6)
    assert held.p_value == pytest.approx(chi2.sf(exact, out.sum()), rel=1e-5)
    assert held.level == 4
