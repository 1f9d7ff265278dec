"""What the slopes of a least-squares problem say, against dense algebra."""

import numpy as np

from snrmjax.numerics.least_squares import inverse_of, root_of_inverse

RNG = np.random.default_rng(0)
UNITS = np.array([1e-6, 1.0, 1e5, 3.0])
SLOPES = RNG.normal(size=(40, 4)) * UNITS


def test_the_covariance_is_the_inverse_information_whatever_the_units():
    # The normal equations of columns of one size square a condition of about 2.
    unit = np.linalg.inv((SLOPES / UNITS).T @ (SLOPES / UNITS))
    np.testing.assert_allclose(inverse_of(SLOPES), unit / np.outer(UNITS, UNITS), rtol=1e-12)
    root = root_of_inverse(SLOPES)
    np.testing.assert_allclose(root @ root.T, inverse_of(SLOPES), rtol=1e-12)
