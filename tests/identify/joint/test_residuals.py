"""Slopes of all levels at once against plain automatic ones; the fit's steps against SciPy's."""

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
from scipy.optimize import least_squares
from truths.exact_states import LEVELS, OMEGA, PARTICIPATION, SHAPE, noisy

import snrmjax as sj
from snrmjax.identify.curves.families import Polynomial, ViscousQuadratic
from snrmjax.identify.joint.fitting import SOLVER
from snrmjax.identify.joint.force_balance import (
    BalanceProblem,
    PriorStd,
    Unknowns,
    balance_data,
    weighting_at,
)
from snrmjax.identify.joint.free_unknowns import FREE, Unravel, packed_unknowns, padded_problem
from snrmjax.identify.joint.residuals import (
    LevelPattern,
    NormalSteps,
    _Normal,
    all_residuals,
    on_levels,
)


def drawn(free, *, room=False):
    """Residuals of drawn states, the unknowns near their smallest, and their order."""
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
    unravel = Unravel(unknowns, free)
    if room:
        problem = padded_problem(problem)
        data = problem.data
        unravel = packed_unknowns(unknowns, free, data.n_levels).unravel
    near = unravel.vector()
    weighting = weighting_at(unravel(near), problem)

    def residuals(vector):
        return all_residuals(vector, unravel, problem, weighting)

    return residuals, near, unravel, problem.data


@pytest.mark.parametrize("room", [False, pytest.param(True, marks=pytest.mark.long)])
def test_slopes_are_those_of_every_unknown_alone(room):
    residuals, near, unravel, data = drawn(FREE, room=room)
    rng = np.random.default_rng(0)
    at = near * (1 + 1e-3 * rng.normal(size=near.size)) + 0.1 * rng.normal(size=near.size)
    left, want = (np.asarray(part) for part in jax.jit(_with_slopes(residuals))(at))
    size = np.linalg.norm(want, axis=0)
    unit = np.where(size > 0, size, 1.0)
    want, left = want / unit, left / np.linalg.norm(left)

    @jax.jit
    def found(at):
        pattern, push = LevelPattern.of(unravel, data), jax.linearize(residuals, at)[1]
        pushed = pattern.pushed(push)
        return pattern.jacobian(pushed), *pattern.normal_equations(pushed, jnp.asarray(left))

    jacobian, matrix, right = (np.asarray(part) for part in found(at))
    # Sums of the same products in another order.
    np.testing.assert_allclose(jacobian / unit, want, atol=1e-12)
    np.testing.assert_allclose(matrix / np.outer(unit, unit), want.T @ want, atol=1e-12)
    np.testing.assert_allclose(right / unit, want.T @ left, atol=1e-12)
    # Levels share their pushes; all kinds of unknowns move something.
    assert len(LevelPattern.of(unravel, data).seeds) == near.size - 4 * (data.n_levels - 1)
    assert np.sum(size > 0) >= 2 + len(FREE) + 4 * LEVELS + 2


def _with_slopes(residuals):
    return lambda at: (residuals(at), jax.jacfwd(residuals)(at))


def test_the_fit_ends_where_scipy_does():
    residuals, near, unravel, data = drawn(())
    unit = 1.0 / jnp.linalg.norm(jax.jit(jax.jacfwd(residuals))(near), axis=0)

    @jax.jit
    def of_units(y):
        return residuals(near + y * unit)

    start = np.random.default_rng(1).normal(size=near.size)
    found = optx.least_squares(
        lambda y, _: of_units(y), on_levels(SOLVER, unravel, data), jnp.asarray(start)
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


def test_steps_are_those_of_damped_least_squares():
    _, _, unravel, data = drawn(())
    steps = NormalSteps(LevelPattern.of(unravel, data))
    rng = np.random.default_rng(2)
    slopes, left = rng.normal(size=(30, 6)), rng.normal(size=30)
    slopes[:, 3] = 0.0
    for damping in (1.0, 1e-6):
        stacked = np.vstack([slopes, np.sqrt(damping) * np.eye(6)])
        want = -np.linalg.lstsq(stacked, np.r_[left, np.zeros(6)], rcond=None)[0]
        normal = _Normal(jnp.asarray(slopes.T @ slopes), jnp.asarray(slopes.T @ left))
        step, result = steps.step(jnp.asarray(1 / damping), normal)
        np.testing.assert_allclose(step, want, rtol=1e-9, atol=1e-12)
        assert result == optx.RESULTS.successful
    # Two columns alike and hardly any damping: rounding decides between them, but nothing more.
    slopes[:, 4] = slopes[:, 5]
    normal = _Normal(jnp.asarray(slopes.T @ slopes), jnp.asarray(slopes.T @ left))
    step = np.asarray(steps.step(jnp.asarray(1e30), normal)[0])
    best = np.linalg.lstsq(slopes, -left, rcond=None)[0]
    np.testing.assert_allclose(slopes @ step, slopes @ best, atol=1e-6)
