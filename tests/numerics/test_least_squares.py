"""Covariances of a least-squares problem against dense algebra."""

import numpy as np

from snrmjax.numerics.levenberg_marquardt import inverse_of, root_of_inverse

RNG = np.random.default_rng(0)
UNITS = np.array([1e-6, 1.0, 1e5, 3.0])
JACOBIAN = RNG.normal(size=(40, 4)) * UNITS


def test_the_covariance_is_the_inverse_information_whatever_the_units():
    # With columns of equal norm the normal equations square a condition number of about 2.
    unit = np.linalg.inv((JACOBIAN / UNITS).T @ (JACOBIAN / UNITS))
    np.testing.assert_allclose(inverse_of(JACOBIAN), unit / np.outer(UNITS, UNITS), rtol=1e-12)
    root = root_of_inverse(JACOBIAN)
    np.testing.assert_allclose(root @ root.T, inverse_of(JACOBIAN), rtol=1e-12)
