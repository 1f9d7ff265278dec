"""Columns with drawn laws against the library's own harmonic balance of a model that has them."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from truths.balanced_sets import balanced, linear_model, quadratic

from snrmjax.diagnose.laws.law_columns import TABLES, LawKnots, law_columns
from snrmjax.diagnose.misfit.predictions import predictions_of
from snrmjax.diagnose.misfit.weighted_misfit import weighted_misfit
from snrmjax.identify.calibrate.inverse_force import inverse_force
from snrmjax.model.library.free_laws import (
    DampingLaw,
    DisplacementDampingLaw,
    SlipLaw,
    UnevenStiffnessLaw,
)

X = np.geomspace(2e-5, 6e-4, 24)
KNOTS = LawKnots(X, 300 * X, 0.5 * X)
# Secants that change the stiffness (9e4 1/s²) and the damping (6 1/s) by some per cent.
SIZES = np.array([4e3, -2e3, 3.0, 2.0, 3e2])
SECANTS = SIZES[:, None] * (X / X[-1]) ** np.array([1.0, 2.0, 1.0, 2.0, 1.0])[:, None]


def with_laws(model, w):
    x, v, s = KNOTS
    laws = (
        UnevenStiffnessLaw(x, w[0] * x, w[1] * x),
        DampingLaw(v, w[2] * v),
        DisplacementDampingLaw(x, w[3]),
        SlipLaw(s, w[4]),
    )
    return dataclasses.replace(model, effects=laws)


@pytest.mark.long
def test_columns_and_slopes_are_those_of_a_model_with_the_laws():
    model, data = linear_model(), balanced(quadratic)
    predictions = predictions_of(model, data)
    misfit = weighted_misfit(predictions)
    nothing = law_columns(predictions, KNOTS, np.zeros((TABLES, 24)))
    np.testing.assert_allclose(nothing.columns, misfit.baseline.columns, atol=1e-7)
    known, own = misfit.errors, nothing.passed_on
    np.testing.assert_allclose(
        own.by_error, known.by_error, atol=1e-3 * np.abs(known.by_error).max()
    )
    for k in range(known.slopes.shape[2]):  # by the baseline's parameters: differences there
        size = np.abs(known.slopes[:, :, k]).max()
        np.testing.assert_allclose(own.slopes[:, :, k], known.slopes[:, :, k], atol=2e-3 * size)
    strong = law_columns(predictions, KNOTS, SECANTS, nothing)
    truth = inverse_force(with_laws(model, jnp.asarray(SECANTS)), data, harmonic_order=5)
    missed = np.asarray(truth.force) / np.asarray(data.force) - 1
    # Other numbers of samples of the kinks that sliders have.
    found = strong.columns[:, 0] + 1j * strong.columns[:, 1]
    np.testing.assert_allclose(found, missed, atol=2e-3 * np.abs(missed).max())
    assert np.abs(strong.columns - nothing.columns).max() > 0.4
    for table in range(TABLES):
        step = np.zeros((TABLES, 24))
        step[table, 20] = 1e-3 * SIZES[table]
        ahead = law_columns(predictions, KNOTS, SECANTS + step, strong).columns
        change = ahead - strong.columns
        slope = strong.by_secant[:, :, table, 20] * step[table, 20]
        np.testing.assert_allclose(slope, change, atol=0.02 * np.abs(change).max())
