"""Levels withheld from a fit, against dense normal distributions."""

import numpy as np
import pytest
from truths.made_up_misfits import LEVEL, N_ROWS, fit_to, misfit_of, noise

from snrmjax.diagnose.checks.residuals import withheld_level


def test_a_withheld_level_is_compared_with_its_prediction_by_the_others():
    rng = np.random.default_rng(3)
    shared = 0.5 * rng.normal(size=(N_ROWS, 2))
    slopes = rng.normal(size=(N_ROWS, 2)) * np.repeat(np.where(LEVEL == 3, 5.0, 0.1), 2)[:, None]
    misfit, rows = misfit_of(shared=shared), noise(3)
    covariance, rows_out = np.eye(N_ROWS) + shared @ shared.T, np.repeat(LEVEL == 3, 2)
    root = np.linalg.inv(np.linalg.cholesky(covariance[np.ix_(~rows_out, ~rows_out)]))
    change = np.linalg.lstsq(root @ slopes[~rows_out], -root @ rows[~rows_out])[0]
    left = rows + slopes @ change
    # Normal distribution of the withheld rows, conditional on the others.
    gain = covariance[np.ix_(rows_out, ~rows_out)] @ np.linalg.inv(
        covariance[np.ix_(~rows_out, ~rows_out)]
    )
    given = covariance[np.ix_(rows_out, rows_out)] - gain @ covariance[np.ix_(~rows_out, rows_out)]
    residual = left[rows_out] - gain @ left[~rows_out]
    exact = float(residual @ np.linalg.solve(given, residual))
    withheld = withheld_level(misfit, fit_to(rows), fit_to(rows, slopes), 3)
    # Rounding of two inverses of well-conditioned matrices.
    assert rows_out.sum() * withheld.after**2 == pytest.approx(exact, rel=1e-6)
    assert withheld.level == 4
