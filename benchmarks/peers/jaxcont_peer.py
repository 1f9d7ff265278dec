"""Forced response by harmonic balance with jaxcont's pseudo-arclength engine.

`jaxcont.continuation` makes a new function object at every call and so compiles at every call;
the engine beneath it, `pseudo_arclength_scan`, takes the residual as a static argument and
compiles once, so it is what is timed here. Stability and events are left out. The Jacobian is
jaxcont's own (forward mode). Run by simulator_speed.py.
"""

# ruff: noqa: E402
from collections.abc import Callable
from importlib.metadata import version

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp
import numpy as np
from jaxcont.core.scan_continuation import pseudo_arclength_scan
from peer_problem import (
    Curve,
    Polynomial,
    Problem,
    basis,
    end_status,
    linear_start,
    serve,
)

MAX_POINTS = 1000
ITERATIONS = 8
LARGEST_STEP = 0.5  # of the others': without control of the angle this gives as many points


def parts(problem: Problem) -> tuple[Callable, tuple]:
    """The residual at a share of the force, and the engine's arguments."""
    n, size = problem.n_modes, 2 * problem.harmonic_order + 1
    matrices, polynomial = basis(problem.harmonic_order, problem.n_samples), Polynomial(problem)
    scale = problem.frequency_scale
    squared = jnp.asarray(problem.natural_frequency**2 / scale**2)
    damping = jnp.asarray(2 * problem.damping_ratio * problem.natural_frequency / scale)
    h2 = jnp.asarray(np.diag(-(matrices.derivative @ matrices.derivative))[:, None])
    synthesis, analysis = jnp.asarray(matrices.synthesis), jnp.asarray(matrices.analysis)
    derivative = jnp.asarray(matrices.derivative)
    index, coefficient = polynomial.index, jnp.asarray(polynomial.coefficient / scale**2)
    load = np.zeros((size, n))
    load[1] = problem.force * problem.participation / (scale**2 * problem.displacement_scale)

    def residual(u: jax.Array, frequency: jax.Array, share: jax.Array | float) -> jax.Array:
        x = u.reshape(size, n)
        q = synthesis @ x
        padded = jnp.concatenate([q, jnp.ones((q.shape[0], 1))], axis=1)
        product = padded[:, index[:, 0]]
        for column in range(1, index.shape[1]):
            product = product * padded[:, index[:, column]]
        balance = (
            (squared - h2 * frequency**2) * x
            + frequency * damping * (derivative @ x)
            + analysis @ (product @ coefficient)
            - share * load
        )
        return balance.reshape(-1)

    begin, end = problem.ends
    arguments = (
        jnp.asarray(linear_start(problem).reshape(-1)),
        *(
            jnp.asarray(value)
            for value in (
                begin,
                end,
                problem.first_step,
                problem.smallest_step,
                LARGEST_STEP * problem.largest_step,
                problem.tolerance,
            )
        ),
    )
    return residual, arguments


def solver(problem: Problem) -> Callable[[], Curve]:
    """Build the residual; the returned function follows the curve."""
    at_share, arguments = parts(problem)
    n, size = problem.n_modes, 2 * problem.harmonic_order + 1
    iterations = jnp.asarray(ITERATIONS)

    def residual(u: jax.Array, frequency: jax.Array) -> jax.Array:
        return at_share(u, frequency, 1.0)

    def run() -> Curve:
        result = pseudo_arclength_scan(residual, *arguments, MAX_POINTS, iterations)
        n_points = int(result.n_valid)
        frequency = np.asarray(result.params)[:n_points]
        states = np.asarray(result.states)[:n_points].reshape(n_points, size, n)
        # One factorisation an iteration and one for every tangent; rejected steps not counted.
        n_solves = int(np.sum(np.asarray(result.iters)[:n_points])) + n_points
        return Curve(states, frequency, end_status(problem, frequency), n_solves)

    return run


if __name__ == "__main__":
    serve(
        "jaxcont",
        f"jaxcont {version('jaxcont')}, jax {version('jax')}",
        "pseudo_arclength_scan, jacfwd, residual norm <= tolerance",
        solver,
    )
