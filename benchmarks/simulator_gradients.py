"""Derivatives of folds and peaks: their errors, and their cost in forward solves.

Run: python benchmarks/simulator_gradients.py

The flat beam at 1.334e-2 N: the peak's velocity and the frequencies of both folds, differentiated
by all 55 coefficients of the potential, four frequencies and four damping ratios, each relative to
its own value, in reverse and forward mode. They are compared with central differences of fourth
order in relative steps of 3e-3 to 3e-5; of these every derivative takes the step that agrees best
with the next one (a narrow tongue needs small steps). The error of a derivative above 1e-6 of the
largest is relative to its own size. The same for the motions at 20 velocities. A forward solve is
a warm `forced_response(stability=False)` of the whole curve. One JSON line each.
"""

import json
import time
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import snrmjax as sj

HERTZ = 2 * np.pi
MODEL, FORCE, ENDS = sj.model.flat_beam(), sj.model.FLAT_BEAM_FORCES[-1], (60 * HERTZ, 120 * HERTZ)
SETTINGS = {"stability": False}
STEPS = (3e-3, 1e-3, 3e-4, 1e-4, 3e-5)


def tell(**fields: object) -> None:
    """One JSON line."""
    rounded = {k: float(f"{v:.4g}") if isinstance(v, float) else v for k, v in fields.items()}
    print(json.dumps({"benchmark": "simulator_gradients", **rounded}), flush=True)


def numbers(model: sj.model.Structure) -> tuple:
    """What the derivatives are taken by."""
    modes = model.modes
    return model.potential.coefficient, modes.natural_frequency, modes.damping_ratio


COUNTS = [int(values.size) for values in numbers(MODEL)]
ZERO = np.zeros(sum(COUNTS))


def changed(shifts: jax.Array) -> sj.model.Structure:
    """The beam with every number times 1 + its shift."""
    parts = jnp.split(shifts, np.cumsum(COUNTS)[:-1])
    new = tuple(v * (1 + p) for v, p in zip(numbers(MODEL), parts, strict=True))
    return eqx.tree_at(numbers, MODEL, new)


def warm(function: Callable[[], object], repeats: int = 7) -> float:
    """Median seconds of a call after the first one."""
    jax.block_until_ready(function())
    seconds = []
    for _ in range(repeats):
        begin = time.perf_counter()
        jax.block_until_ready(function())
        seconds.append(time.perf_counter() - begin)
    return float(np.median(seconds))


def by_differences(function: Callable) -> np.ndarray:
    """Jacobian by central differences in the steps that agree best with the next smaller one."""
    slopes = np.stack([in_steps(function, step) for step in STEPS])
    best = np.argmin(np.abs(np.diff(slopes, axis=0)), axis=0)
    return np.take_along_axis(slopes, best[None], axis=0)[0]


def in_steps(function: Callable, step: float) -> np.ndarray:
    """Jacobian by central differences of fourth order in one step."""
    columns = []
    for unit in np.eye(len(ZERO)):
        low, less, more, high = (
            np.asarray(function(jnp.asarray(k * step * unit))) for k in (-2, -1, 1, 2)
        )
        columns.append((low - 8 * less + 8 * more - high) / (12 * step))
    return np.stack(columns, axis=-1)


def measure(name: str, function: Callable, forward_solve: float) -> None:
    """Errors and costs of the derivatives of one or more numbers."""
    compiled = jax.jit(function)
    reverse, forward = jax.jit(jax.jacrev(function)), jax.jit(jax.jacfwd(function))
    exact = np.atleast_2d(reverse(ZERO))
    slope = np.atleast_2d(by_differences(compiled))
    size = np.abs(exact).max(axis=1, keepdims=True)
    own = np.abs(exact) > 1e-6 * size
    with np.errstate(divide="ignore", invalid="ignore"):
        error = np.abs(slope / exact - 1)
    one = jax.jit(jax.value_and_grad(lambda shifts: jnp.ravel(function(shifts))[0]))
    cost = warm(lambda: one(ZERO))
    tell(
        measurement="gradient",
        of=name,
        outputs=len(exact),
        parameters=exact.shape[1],
        judged_by_own_size=int(own.sum()),
        largest_relative_error=float(error[own].max()),
        median_relative_error=float(np.median(error[own])),
        largest_error_of_the_rest_over_largest=float((np.abs(slope - exact) / size).max()),
        reverse_against_forward=float((np.abs(np.atleast_2d(forward(ZERO)) - exact) / size).max()),
        value_seconds=warm(lambda: compiled(ZERO)),
        value_and_grad_seconds=cost,
        jacobian_reverse_seconds=warm(lambda: reverse(ZERO)),
        jacobian_forward_seconds=warm(lambda: forward(ZERO)),
        forward_solve_seconds=forward_solve,
        value_and_grad_over_forward_solve=cost / forward_solve,
    )


def main() -> None:
    """Measure and print."""
    (curve,) = sj.forced_response(MODEL, [FORCE], *ENDS, **SETTINGS)
    forward_solve = warm(lambda: sj.forced_response(MODEL, [FORCE], *ENDS, **SETTINGS)[0].velocity)
    for name, kind, number in (
        ("peak velocity", "peak", 0),
        ("upper fold frequency", "fold", 0),
        ("lower fold frequency", "fold", 1),
    ):
        start = curve.point(curve.at_events(kind)[number])

        def quantity(shifts: jax.Array, kind: str = kind, start: tuple = start) -> jax.Array:
            found = sj.simulate.periodic_motion(changed(shifts), FORCE, start, condition=kind)
            return found.amplitude if kind == "peak" else found.frequency

        measure(name, quantity, forward_solve)
    heights = np.linspace(0.15, 0.95, 20) * np.abs(curve.velocity[:, 1, 0]).max()
    found, which = sj.simulate.response_at_velocities(MODEL, curve, heights)
    starts = (found.coefficients, found.frequency)

    def frequencies(shifts: jax.Array) -> jax.Array:
        return sj.simulate.motions_at_velocities(
            changed(shifts), FORCE, starts, heights[which]
        ).frequency

    measure(f"frequencies at {len(which)} motions", frequencies, forward_solve)


if __name__ == "__main__":
    main()
