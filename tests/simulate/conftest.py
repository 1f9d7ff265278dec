"""Fixtures of the simulator's tests: reference solutions, and the curves of two beams."""

import numpy as np
import pytest
from truths.periodic_motions import NumpyBalance, TimeDomain, initial_state, spectrum_distance

from snrmjax.model.builders.beams import (
    CURVED_BEAM_FORCES,
    FLAT_BEAM_FORCES,
    curved_beam,
    flat_beam,
)
from snrmjax.simulate.continuation.continuation import CurveStatus
from snrmjax.simulate.solutions.forced_response import forced_response


@pytest.fixture(scope="session")
def time_domain():
    return TimeDomain


@pytest.fixture(scope="session")
def numpy_balance():
    return NumpyBalance


@pytest.fixture(scope="session")
def state_of():
    return initial_state


@pytest.fixture(scope="session")
def distance_between():
    return spectrum_distance


@pytest.fixture(scope="session")
def flat_curve():
    """The flat beam's response at the paper's largest force, 9 harmonics."""
    model = flat_beam()
    hz = 2 * np.pi
    return model, forced_response(model, [FLAT_BEAM_FORCES[-1]], 60 * hz, 110 * hz)[0]


@pytest.fixture(scope="session")
def curved_curves():
    """The curved beam's responses at the paper's two lower forces, 9 harmonics."""
    model = curved_beam()
    hz = 2 * np.pi
    curves = forced_response(model, CURVED_BEAM_FORCES[:2], 30 * hz, 110 * hz)
    # The other curves start from rest and fold back at a superharmonic resonance.
    return model, [curve for curve in curves if curve.status == CurveStatus.UPPER_END]
