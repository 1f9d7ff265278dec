"""Newton's method to a root: closed forms, derivatives, and iterations without a root."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from snrmjax.numerics.newton import ROUNDING, newton

UNIT = 1e-5  # of the second unknown


def circle_and_line(point):
    """x² + (y/unit)² = 1 and x = y/unit."""
    x, y = point[0], point[1] / UNIT
    slopes = jnp.array([[2 * x, 2 * y / UNIT], [1.0, -1 / UNIT]])
    return jnp.stack([x**2 + y**2 - 1, x - y]), slopes


def cubic(point, load):
    """x + x³ = load, with one root whatever the load."""
    return point + point**3 - load, (1 + 3 * point**2)[None]


def test_a_root_is_exact_to_rounding():
    root = newton(circle_and_line, jnp.array([0.9, 0.3 * UNIT]), scale=jnp.array([1.0, UNIT]))
    point, converged = root.one_more(within=ROUNDING)
    assert bool(converged)
    assert point / np.array([1.0, UNIT]) == pytest.approx(np.sqrt([0.5, 0.5]), rel=1e-15)
    # From a tenth away the error is squared four times until it is below 1e-6 (Kantorovich).
    assert int(root.n_steps) <= 6


def test_the_last_step_carries_the_derivative_of_the_root():
    def at(load):
        fixed = jax.lax.stop_gradient(load)
        root = newton(lambda x: cubic(x, fixed), jnp.ones(1))
        return root.one_more(cubic(root.point, load)[0])[0][0]

    for load in (0.3, 2.0, 40.0):
        x = np.roots([1, 0, 1, -load])
        x = x[np.abs(x.imag) < 1e-9].real[0]
        for derivative in (jax.grad, jax.jacfwd):
            assert float(derivative(at)(load)) == pytest.approx(1 / (1 + 3 * x**2), rel=1e-13)


@pytest.mark.parametrize("start", [0.7, np.nan])
def test_what_has_no_root_does_not_converge(start):
    def parabola(point):
        return point**2 + 1, (2 * point)[None]

    root = newton(parabola, jnp.array([start]), most=50)
    assert not bool(root.one_more()[1])
    assert int(root.n_steps) <= 50


def test_a_batch_has_the_roots_of_its_members():
    loads, starts = jnp.array([0.1, 1.0, 25.0]), jnp.array([[1.0], [-2.0], [0.5]])

    def solved(load, start):
        return newton(lambda x: cubic(x, load), start).one_more()

    points, converged = jax.jit(jax.vmap(solved))(loads, starts)
    alone = [solved(load, start)[0] for load, start in zip(loads, starts, strict=True)]
    assert bool(converged.all())
    np.testing.assert_allclose(points, alone, rtol=1e-14)
