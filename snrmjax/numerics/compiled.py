"""Programs of many small steps, compiled to run one step after the other."""

import warnings
from collections.abc import Callable
from functools import cache, wraps
from threading import Lock
from typing import Any, ParamSpec, TypeVar

import equinox as eqx
import jax
import numpy as np

from snrmjax.numerics.kept_programs import NotKept, ProgramKeeper, program_keeper

P = ParamSpec("P")
R = TypeVar("R")
T = TypeVar("T")

# pyproject.toml excludes them; who installs one all the same learns why a program stands still.
if (0, 10) <= jax.__version_info__ < (0, 11, 1):
    warnings.warn(
        f"jax {jax.__version__} can stand still for ever in batched linear algebra on a CPU: "
        "install 0.9.2, or 0.11.1 or newer.",
        RuntimeWarning,
        stacklevel=2,
    )

_EMITTERS = "xla_cpu_use_fusion_emitters"
_LEVEL = "xla_backend_optimization_level"
_OPTIONS: dict[str, str | bool | int] = {
    # XLA's default order for a CPU lets independent steps run side by side, each in a thread of a
    # pool. On matrices of a hundred rows handing a step over takes longer than the step; the
    # cores are put to use by whole curves instead (`blocks.over_cores`).
    "xla_cpu_scheduler_type": "CPU_SCHEDULER_TYPE_MEMORY_OPTIMIZED",
    _EMITTERS: False,  # compiles a third faster, runs as fast
    _LEVEL: 1,  # compiles an eighth faster, runs as fast
}


def compiled(
    function: Callable[..., R], *, long_loops: bool = False, thoroughly: bool = False
) -> Callable[..., R]:
    """A function of arrays and settings as one program, compiled with the options above.

    Arrays and floating-point numbers anywhere in the arguments, NumPy's too, are arguments of the
    program, so that other values do not compile anew; everything else (whole numbers, truth
    values, text, None) is compiled into it. All results are arrays. Inside another program that
    one's order of steps rules. `long_loops` over many points at once take half as long again to
    compile and run 1.5 times faster; walks of many curves `thoroughly` twice, and a tenth faster.
    """

    def run(structure: Any, fixed: tuple, arrays: list) -> R:
        rest = iter(arrays)
        leaves = [next(rest) if leaf is _Array else leaf for leaf in fixed]
        arguments, named = jax.tree.unflatten(structure, leaves)
        return function(*arguments, **named)

    run.__name__ = function.__name__
    inside, kind = jax.jit(run, static_argnums=(0, 1)), (long_loops, thoroughly)
    kept: dict[tuple, _Once] = {}

    @cache
    def outermost(hurried: bool) -> Callable[..., R]:
        return jax.jit(run, static_argnums=(0, 1), compiler_options=_options(hurried, *kind))

    def whole(
        keeper: ProgramKeeper,
        structure: Any,
        fixed: tuple,
        arrays: list,
        hurried: bool,
        *argued: Any,
    ) -> Callable[[list], R] | None:
        """The program as it is kept on disk, from which it is read or to which it is written."""

        def build() -> tuple[jax.stages.Lowered, Any]:
            trees: list[Any] = []

            def flat(*rows: Any) -> list:
                leaves, tree = jax.tree.flatten(run(structure, fixed, list(rows)))
                trees.append(tree)
                return leaves

            flat.__name__ = f"{function.__name__}_kept"
            options = _options(hurried, *kind)
            program = jax.jit(flat, compiler_options=options).lower(*arrays)
            return program, jax.tree.unflatten(trees[-1], range(trees[-1].num_leaves))

        try:
            program, like = keeper.program(function, argued, (hurried, *kind), build)
        except NotKept:
            return None
        results = jax.tree.structure(like)
        return lambda rows: jax.tree.unflatten(results, program(*rows))

    @wraps(function)
    def call(*arguments: Any, **named: Any) -> R:
        _in_double_precision()
        leaves, structure = jax.tree.flatten((arguments, named))
        leaves = [_number(a) for a in leaves]
        is_array = [isinstance(a, (jax.Array, np.ndarray, np.generic)) for a in leaves]
        fixed = tuple(_Array if known else a for a, known in zip(leaves, is_array, strict=True))
        arrays = [a for a, known in zip(leaves, is_array, strict=True) if known]
        traced = any(isinstance(a, jax.core.Tracer) for a in arrays)
        if traced:
            return inside(structure, fixed, arrays)
        hurried = jax.config.read("jax_disable_most_optimizations")
        keeper = program_keeper()
        if keeper is not None:
            shapes = tuple((a.shape, a.dtype, getattr(a, "weak_type", False)) for a in arrays)
            once = kept.setdefault((structure, fixed, shapes, hurried), _Once())
            made_of = keeper, structure, fixed, arrays, hurried, arguments, named
            program = once.made(lambda: whole(*made_of))
            if program is not None:
                return program(arrays)
        return outermost(hurried)(structure, fixed, arrays)

    return call


def value_of(array: Any) -> np.ndarray | None:
    """An array's numbers on the host, also within a derivative; None within `jax.jit` or `vmap`."""
    if isinstance(array, jax.core.Tracer):
        array = jax.lax.stop_gradient(array)
    return None if isinstance(array, jax.core.Tracer) else np.asarray(array)


def on_numbers(instead: str) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """A verb that works on numbers: where JAX traces its arguments it states what to use instead.

    `instead` is a sentence. Without this such a verb ends somewhere inside in an error about
    tracers, or its derivatives are silently zero.
    """

    def of(function: Callable[P, R]) -> Callable[P, R]:
        @wraps(function)
        def call(*arguments: P.args, **named: P.kwargs) -> R:
            leaves = jax.tree.leaves((arguments, named))
            if any(isinstance(leaf, jax.core.Tracer) for leaf in leaves):
                raise ValueError(
                    f"`{function.__name__}` works on numbers, and cannot be called inside "
                    f"`jax.grad`, `jax.jit` or `jax.vmap` with what these vary. {instead}"
                )
            return function(*arguments, **named)

        return call

    return of


def as_numpy(array: Any) -> Any:
    """An array as NumPy's, of which parts are taken without a program; a traced one as it is."""
    return array if isinstance(array, jax.core.Tracer) else np.asarray(array)


def numbers_as_arrays(tree: T) -> T:
    """A tree whose floating-point and complex numbers of Python are NumPy's.

    `compiled` and `eqx.filter_jit` take those as arguments of a program; they would compile
    Python's numbers into it.
    """
    return jax.tree.map(_number, tree)


def jitted(function: Callable[P, R]) -> Callable[P, R]:
    """`eqx.filter_jit` of a function whose floating-point numbers are arguments of the program."""
    inside = eqx.filter_jit(function)

    @wraps(function)
    def call(*arguments: P.args, **named: P.kwargs) -> R:
        _in_double_precision()
        traceable, settings = numbers_as_arrays((arguments, named))
        return inside(*traceable, **settings)

    return call


def _in_double_precision() -> None:
    """Raises `ValueError` where JAX was switched to single precision: nothing would converge."""
    if not jax.config.read("jax_enable_x64"):
        raise ValueError(
            "JAX computes in single precision: `jax_enable_x64`, which `import snrmjax` switches "
            'on, was switched off. Switch it on: `jax.config.update("jax_enable_x64", True)`.'
        )


def _number(leaf: Any) -> Any:
    return np.asarray(leaf)[()] if isinstance(leaf, float | complex) else leaf


class _Array:
    """Stands where an array was taken out."""


class _Once:
    """What is made at the first call, in whichever thread that is."""

    def __init__(self) -> None:
        self._lock = Lock()
        self._made: list[Any] = []

    def made(self, make: Callable[[], T]) -> T:
        """What `make` made, now or before."""
        with self._lock:
            if not self._made:
                self._made.append(make())
        return self._made[0]


@cache
def _options(hurried: bool, long_loops: bool, thoroughly: bool) -> dict[str, str | bool | int]:
    """Those that this version of XLA has; none where the programs do not run on a CPU.

    A level of ours would overrule a user who asks JAX to compile in a hurry.
    """
    if jax.default_backend() != "cpu":
        return {}
    left_out = (_LEVEL,) * (hurried or thoroughly) + (_EMITTERS,) * (long_loops or thoroughly)
    wanted = {k: v for k, v in _OPTIONS.items() if k not in left_out}
    if _known(wanted):
        return wanted
    return {name: value for name, value in wanted.items() if _known({name: value})}


def _known(options: dict[str, str | bool | int]) -> bool:
    try:
        jax.jit(lambda: 0, compiler_options=options).lower().compile()
    except jax.errors.JaxRuntimeError:
        return False
    return True
