"""Densities of sizes, alone and together."""

import numpy as np
import pytest
from scipy import stats

from snrmjax.identify.test_model.priors import (
    HalfNormalSize,
    JointDensity,
    LogNormalSize,
    NormalNumber,
)

ALL = [HalfNormalSize(0.05), None, LogNormalSize(0.004, 1.2), NormalNumber(0.7)]


def test_densities_are_those_of_the_logarithm_of_a_size():
    size = 0.03
    # A density of ln x is that of x times x.
    half = stats.halfnorm(scale=0.05).logpdf(size) + np.log(size)
    assert ALL[0].log_density(np.log(size))[0] == pytest.approx(half)
    normal = stats.norm(np.log(0.004), 1.2).logpdf(np.log(size))
    assert ALL[2].log_density(np.log(size))[0] == pytest.approx(normal)


def test_together_they_are_the_sum():
    point = np.array([np.log(0.03), 17.0, np.log(0.01), -0.4])
    value, slopes = JointDensity.of(ALL).log_density(point)
    each = [one.log_density(x) for one, x in zip(ALL, point, strict=True) if one is not None]
    assert value == pytest.approx(sum(own for own, _ in each))
    assert slopes[1] == 0.0
    np.testing.assert_allclose(slopes[[0, 2, 3]], [slope for _, slope in each])
