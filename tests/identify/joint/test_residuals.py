"""The least squares of named families against SciPy's."""

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
from scipy.optimize import least_squares
from truths.exact_states import OMEGA, PARTICIPATION, SHAPE, noisy

import snrmjax as sj
from snrmjax.identify.curves.families import Polynomial, ViscousQuadratic
from snrmjax.identify.inference.refits import SOLVER
from snrmjax.identify.joint.family_fit import MOST_STEPS
from snrmjax.identify.joint.force_balance import (
    BalanceProblem,
    PriorStd,
    Unknowns,
    balance_data,
    weighting_at,
)
from snrmjax.identify.joint.free_unknowns import Unravel, all_residuals


def drawn():
    """Residuals of drawn states, and unknowns near their smallest."""
    modes = sj.model.linear_modes(
        *([OMEGA, 3 * OMEGA], [0.012, 0.01], [[SHAPE, 1.5]], [PARTICIPATION, 2.0]),
        std=sj.model.LinearModesStd([1.0, 5.0], [1e-3, 2e-3]),
    )
    prior = PriorStd(jnp.array([0.01, 0.02, 0.002, 0.03]), jnp.array([5.0, 2e-3, 0.02]))
    data = balance_data(noisy(1, gain=0.01), modes)[0]
    problem = BalanceProblem(data, modes, prior)
    near = np.array([2.5e-3, 0.04]), np.array([OMEGA**2, 1.3 * OMEGA**2]), np.ones(2)
    (stiff,) = Polynomial.starts(1, "displacement", *near)
    (lossy,) = ViscousQuadratic.starts(
        1, "velocity", np.array([0.1, 1.0]), np.array([12.0, 18.0]), np.ones(2)
    )
    none = jnp.zeros(())
    unknowns = Unknowns(stiff, lossy, none, none, none, jnp.zeros((data.n_levels, 4)), jnp.zeros(3))
    unravel = Unravel(unknowns, ())
    near = unravel.vector()
    weighting = weighting_at(unravel(near), problem)

    def residuals(vector):
        return all_residuals(vector, unravel, problem, weighting)

    return residuals, near


def test_the_fit_ends_where_scipy_does():
    residuals, near = drawn()
    unit = 1.0 / jnp.linalg.norm(jax.jit(jax.jacfwd(residuals))(near), axis=0)

    @jax.jit
    def of_units(y):
        return residuals(near + y * unit)

    start = np.random.default_rng(1).normal(size=near.size)
    found = optx.least_squares(
        lambda y, _: of_units(y), SOLVER, jnp.asarray(start), max_steps=MOST_STEPS
    )
    slopes = jax.jit(jax.jacfwd(of_units))
    tight = {"xtol": 1e-14, "ftol": 1e-14, "gtol": 1e-11}
    best = least_squares(*(lambda y: of_units(y), start, lambda y: slopes(y)), **tight)
    assert float(np.sum(of_units(found.value) ** 2)) == pytest.approx(2 * best.cost, rel=1e-12)
    # A cost that is alike to 1e-12 of itself determines the unknowns along the directions of J to
    # 1e-6 of their 1σ; one alone, which the data hardly determine, may differ by more.
    _, size, directions = np.linalg.svd(np.asarray(slopes(best.x)), full_matrices=False)
    apart = size * (directions @ (np.asarray(found.value) - best.x))
    np.testing.assert_allclose(apart, 0.0, atol=1e-6)
    np.testing.assert_allclose(of_units(found.value), of_units(best.x), atol=1e-6)
