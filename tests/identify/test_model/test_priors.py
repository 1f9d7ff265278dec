"""Prior densities, against those of scipy."""

import numpy as np
import pytest
from scipy import stats

from snrmjax.identify.test_model.priors import (
    HalfNormalPrior,
    JointDensity,
    LogNormalPrior,
    LogUniformPrior,
    NormalPrior,
)

ALL = [
    HalfNormalPrior(0.05),
    None,
    LogNormalPrior(0.004, 1.2),
    NormalPrior(0.7),
    LogUniformPrior(-3.0, 2.0),
]


def log_density(point):
    half, _, noise, number, _ = point
    return (
        # A density of ln x is that of x times x.
        stats.halfnorm(scale=0.05).logpdf(np.exp(half))
        + half
        + stats.norm(np.log(0.004), 1.2).logpdf(noise)
        + stats.norm(scale=0.7).logpdf(number)
        - np.log(5.0)
    )


def test_the_joint_density_is_the_product():
    point = np.array([np.log(0.03), 17.0, np.log(0.01), -0.4, 0.3])
    value, slopes = JointDensity.of(ALL).log_density(point)
    assert value == pytest.approx(log_density(point), rel=1e-12)
    step = 1e-6 * np.eye(5)
    ends = [[log_density(point + sign * one) for one in step] for sign in (1, -1)]
    np.testing.assert_allclose(slopes, (np.array(ends[0]) - ends[1]) / 2e-6, atol=1e-8)
