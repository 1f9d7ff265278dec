"""The statistics of stated errors."""

import numpy as np
import pytest


def spread_of_scores(z):
    """Sample standard deviation of z-scores along the first axis."""
    return np.std(np.asarray(z), axis=0, ddof=1)


@pytest.fixture(scope="session")
def z_spread():
    return spread_of_scores
