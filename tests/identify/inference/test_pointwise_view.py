"""Points of a joint fit: their 1σ includes the errors that the states of a level share."""

import dataclasses

import numpy as np
import pytest
from truths.exact_states import modes, noisy

import snrmjax as sj
from snrmjax.identify.inference.identification import errors_from_scatter


@pytest.mark.parametrize(
    ("shared", "factor"),
    [({"level_gain": 1e-3}, np.exp(1e-3)), ({"level_phase": 1e-3}, np.exp(1e-3j))],
    ids=["gain", "phase"],
)
def test_points_have_the_errors_that_their_level_shares(shared, factor):
    data = noisy()
    points = sj.identify.identify_points(data, modes())
    wrong = dataclasses.replace(data, velocity=data.velocity * factor)
    moved = sj.identify.identify_points(wrong, modes())
    widened = errors_from_scatter(points, 0.0, **shared)
    change = np.abs(np.asarray(moved.natural_frequency - points.natural_frequency))
    std = np.asarray(widened.natural_frequency_std)
    # First order in a thousandth.
    np.testing.assert_allclose(std, change, rtol=0.01, atol=2e-3 * change.max())
