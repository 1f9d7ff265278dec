"""Programs of many small steps, compiled to run one step after the other."""

from collections.abc import Callable
from functools import cache, partial, wraps
from typing import Any, TypeVar

import jax
import numpy as np

R = TypeVar("R")

# XLA's default order for a CPU lets independent steps run side by side, each in a thread of a
# pool. On matrices of a hundred rows handing a step over takes longer than the step; the cores
# are put to use by whole curves instead (`blocks.over_cores`).
_SEQUENTIAL = {"xla_cpu_scheduler_type": "CPU_SCHEDULER_TYPE_MEMORY_OPTIMIZED"}
_LEVEL = {"xla_backend_optimization_level": 1}  # compiles an eighth faster, runs as fast


def compiled(function: Callable[..., R]) -> Callable[..., R]:
    """A function of arrays and settings as one program; half as slow again as `jax.jit` gives it.

    Arrays anywhere in the arguments, NumPy's too, are arguments of the program; everything else,
    numbers included, is compiled into it. All results are arrays. Inside another program that
    one's order of steps rules.
    """

    def run(structure: Any, fixed: tuple, arrays: list) -> R:
        rest = iter(arrays)
        leaves = [next(rest) if leaf is _Array else leaf for leaf in fixed]
        arguments, named = jax.tree.unflatten(structure, leaves)
        return function(*arguments, **named)

    run.__name__ = function.__name__
    program = partial(jax.jit, run, static_argnums=(0, 1))
    anywhere, quick = program(), program(compiler_options=_SEQUENTIAL)
    sequential = program(compiler_options=_SEQUENTIAL | _LEVEL)

    @wraps(function)
    def call(*arguments: Any, **named: Any) -> R:
        leaves, structure = jax.tree.flatten((arguments, named))
        is_array = [isinstance(a, (jax.Array, np.ndarray, np.generic)) for a in leaves]
        fixed = tuple(_Array if known else a for a, known in zip(leaves, is_array, strict=True))
        arrays = [a for a, known in zip(leaves, is_array, strict=True) if known]
        inside = any(isinstance(a, jax.core.Tracer) for a in arrays)
        if inside or not _known():
            return anywhere(structure, fixed, arrays)
        # A level of its own would overrule the user who asks JAX to compile quickly.
        hurried = jax.config.values["jax_disable_most_optimizations"]
        return (quick if hurried else sequential)(structure, fixed, arrays)

    return call


class _Array:
    """Stands where an array was taken out."""


@cache
def _known() -> bool:
    """Whether this version of XLA has the option, and the programs run on a CPU."""
    if jax.default_backend() != "cpu":
        return False
    try:
        jax.jit(lambda: 0, compiler_options=_SEQUENTIAL | _LEVEL).lower().compile()
    except jax.errors.JaxRuntimeError:
        return False
    return True
