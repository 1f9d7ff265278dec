"""Forced response by harmonic balance with jaxcont's pseudo-arclength engine.

`jaxcont.continuation` compiles at every call; the engine beneath it, `pseudo_arclength_scan`, takes
the residual as a static argument and compiles once, so it is what is timed. The Jacobian is
jaxcont's own (forward mode). No stability, no events. Run by simulator_speed.py.
"""

# ruff: noqa: E402
from collections.abc import Callable
from importlib.metadata import version

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp
import numpy as np
from jaxcont.core.scan_continuation import pseudo_arclength_scan
from simulator_peer import Curve, Polynomial, Problem, basis, linear_start, serve

MAX_POINTS = 300  # no more than needed: all are computed under `vmap`, and cost without it
ITERATIONS, MEMBERS = 8, 64
LARGEST_STEP = 0.5  # of the others': without control of the angle this gives as many points


def ways(problem: Problem) -> dict[str, Callable]:
    """The whole curve, and 64 forces side by side and one by one."""
    n, size = problem.n_modes, 2 * problem.harmonic_order + 1
    matrices, polynomial = basis(problem.harmonic_order, problem.n_samples), Polynomial(problem)
    scale, index = problem.frequency_scale, polynomial.index
    squared = jnp.asarray(problem.natural_frequency**2 / scale**2)
    damping = jnp.asarray(2 * problem.damping_ratio * problem.natural_frequency / scale)
    synthesis, analysis, derivative = (jnp.asarray(one) for one in matrices[:3])
    h2 = -jnp.diag(derivative @ derivative)[:, None]
    coefficient = jnp.asarray(polynomial.coefficient / scale**2)
    load = np.zeros((size, n))
    load[1] = problem.force * problem.participation / (scale**2 * problem.displacement_scale)
    begin, end = problem.ends
    limits = (problem.first_step, problem.smallest_step, LARGEST_STEP * problem.largest_step)
    settings = [jnp.asarray(value) for value in (begin, end, *limits, problem.tolerance)]
    start, iterations = jnp.asarray(linear_start(problem).reshape(-1)), jnp.asarray(ITERATIONS)

    def at_fraction(u: jax.Array, frequency: jax.Array, fraction: jax.Array | float) -> jax.Array:
        x = u.reshape(size, n)
        q = synthesis @ x
        padded = jnp.concatenate([q, jnp.ones((q.shape[0], 1))], axis=1)
        product = padded[:, index[:, 0]]
        for column in range(1, index.shape[1]):
            product = product * padded[:, index[:, column]]
        linear = (squared - h2 * frequency**2) * x + frequency * damping * (derivative @ x)
        return (linear + analysis @ (product @ coefficient) - fraction * load).reshape(-1)

    def residual(u: jax.Array, frequency: jax.Array) -> jax.Array:
        return at_fraction(u, frequency, 1.0)

    def curve() -> Curve:
        found = pseudo_arclength_scan(residual, start, *settings, MAX_POINTS, iterations)
        points = int(found.n_valid)
        # One factorisation an iteration and one for every tangent; rejected steps not counted.
        n_solves = int(np.sum(np.asarray(found.iters)[:points])) + points
        states = np.asarray(found.states)[:points].reshape(points, size, n)
        return Curve(states, np.asarray(found.params)[:points], n_solves)

    def one(fraction: jax.Array) -> tuple[jax.Array, ...]:
        found = pseudo_arclength_scan(
            lambda u, frequency: at_fraction(u, frequency, fraction),
            fraction * start,
            *settings,
            MAX_POINTS,
            iterations,
        )
        return found.states, found.params, found.n_valid

    fractions = jnp.geomspace(0.1, 1.0, MEMBERS)
    together, alone = jax.jit(jax.vmap(one)), jax.jit(one)
    return {
        "curve": curve,
        "vmap": lambda: jax.block_until_ready(together(fractions)),
        "one_by_one": lambda: [jax.block_until_ready(alone(fraction)) for fraction in fractions],
    }


if __name__ == "__main__":
    serve(ways, f"jaxcont {version('jaxcont')}, jax {jax.__version__}")
