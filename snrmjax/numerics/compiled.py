"""The one door to compilation: `compiled`.

A function of arrays that is called from Python is compiled by `@compiled`, whether it is public or
not, differentiable or not; nothing else in the package calls `jax.jit`. Further tools build on it:

- `blocks.by_blocks` and `by_member` call one program on rows or members of any number, `mapped`
  inside a program runs one after the other what an accelerator runs as a batch;
- `lanes.in_lanes` runs iterations of different lengths, whose programs make a few steps a call;
- `io.programs` stores programs on disk for later processes, without being asked: it registers its
  store here, and nothing else changes.

Verbs that work on numbers, and call several programs, refuse traced arguments by `on_numbers`.
"""

import warnings
from collections.abc import Callable
from functools import cache, wraps
from threading import Lock
from typing import Any, ParamSpec, Protocol, TypeVar

import jax
import numpy as np

from snrmjax.numerics.rules import InputError

P = ParamSpec("P")
R = TypeVar("R")
T = TypeVar("T")

# pyproject.toml excludes these versions; this warns whoever installs one all the same.
if (0, 10) <= jax.__version_info__ < (0, 11, 1):
    warnings.warn(
        f"jax {jax.__version__} can deadlock in batched linear algebra on a CPU: "
        "install 0.9.2, or 0.11.1 or newer.",
        RuntimeWarning,
        stacklevel=2,
    )

_EMITTERS = "xla_cpu_use_fusion_emitters"
_LEVEL = "xla_backend_optimization_level"
_OPTIONS: dict[str, str | bool | int] = {
    # XLA's default scheduler for a CPU runs independent operations in parallel on a thread pool.
    # For matrices of a hundred rows the dispatch takes longer than the operation; here whole
    # curves are distributed over the cores instead (`blocks.over_cores`).
    "xla_cpu_scheduler_type": "CPU_SCHEDULER_TYPE_MEMORY_OPTIMIZED",
    _EMITTERS: False,  # compiles a third faster, same run time
    _LEVEL: 1,  # compiles an eighth faster, same run time
}


class NotKept(Exception):
    """A program depends on code outside this package and is not cached."""


class ProgramKeeper(Protocol):
    """A cache of compiled programs: looks them up, or has them compiled and stores them."""

    def in_use(self) -> bool:
        """Whether programs are cached under the current settings of JAX."""

    def program(
        self,
        function: Callable[..., Any],
        arguments: Any,
        settings: tuple,
        build: Callable[[], tuple[jax.stages.Lowered, Any]],
    ) -> tuple[Callable[..., list[jax.Array]], Any]:
        """The program of flat arrays for a function's arguments, and the structure of its results.

        Arguments: `settings` of the compiler; `build` lowers the program, under a unique name,
        if it is not in the cache.
        Raises `NotKept` if no unique key can be made for it.
        """


def compiled(
    function: Callable[..., R], *, long_loops: bool = False, thoroughly: bool = False
) -> Callable[..., R]:
    """A function of arrays and settings, compiled as one program with the options above.

    Arrays and floating-point numbers anywhere in the arguments, NumPy's too, are traced, so that
    other values do not recompile; everything else (integers, booleans, text, None) is static. All
    results are arrays. Inside another program the options of that one apply. With `long_loops`
    loops over many points compile 1.5 times longer and run 1.5 times faster; with `thoroughly`
    the tracing of many curves compiles twice as long and runs a tenth faster.
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
    def outermost(fast_compile: bool) -> Callable[..., R]:
        return jax.jit(run, static_argnums=(0, 1), compiler_options=_options(fast_compile, *kind))

    def whole(
        keeper: ProgramKeeper,
        structure: Any,
        fixed: tuple,
        arrays: list,
        fast_compile: bool,
        *arguments: Any,
    ) -> Callable[[list], R] | None:
        """The program from the cache on disk, compiled and stored there if missing."""

        def build() -> tuple[jax.stages.Lowered, Any]:
            trees: list[Any] = []

            def flat(*rows: Any) -> list:
                leaves, tree = jax.tree.flatten(run(structure, fixed, list(rows)))
                trees.append(tree)
                return leaves

            flat.__name__ = f"{function.__name__}_kept"
            options = _options(fast_compile, *kind)
            program = jax.jit(flat, compiler_options=options).lower(*arrays)
            return program, jax.tree.unflatten(trees[-1], range(trees[-1].num_leaves))

        try:
            program, like = keeper.program(function, arguments, (fast_compile, *kind), build)
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
        fast_compile = jax.config.read("jax_disable_most_optimizations")
        keeper = program_keeper()
        if keeper is not None:
            shapes = tuple((a.shape, a.dtype, getattr(a, "weak_type", False)) for a in arrays)
            once = kept.setdefault((structure, fixed, shapes, fast_compile), _Once())
            made_of = keeper, structure, fixed, arrays, fast_compile, arguments, named
            program = once.made(lambda: whole(*made_of))
            if program is not None:
                return program(arrays)
        return outermost(fast_compile)(structure, fixed, arrays)

    return call


class _Registered:
    keeper: ProgramKeeper | None = None
    closed = False


def keep_programs_with(keeper: ProgramKeeper) -> None:
    """Cache programs from here on, unless code from outside is registered in the package."""
    _Registered.keeper = None if _Registered.closed else keeper


def keep_no_programs() -> None:
    """Stop caching for good: code from outside is registered in the package."""
    _Registered.closed, _Registered.keeper = True, None


def program_keeper() -> ProgramKeeper | None:
    """The cache of programs, if it is in use now."""
    keeper = _Registered.keeper
    return keeper if keeper is not None and keeper.in_use() else None


def value_of(array: Any) -> np.ndarray | None:
    """An array's numbers on the host, also within a derivative; None within `jax.jit` or `vmap`."""
    if isinstance(array, jax.core.Tracer):
        array = jax.lax.stop_gradient(array)
    return None if isinstance(array, jax.core.Tracer) else np.asarray(array)


def on_numbers(instead: str) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Refuses traced arguments: the decorated function works on numbers, not under JAX transforms.

    `instead` is a sentence with the differentiable alternative. Without this check such a function
    fails deep inside with a tracer error, or its derivatives are silently zero.
    """

    def of(function: Callable[P, R]) -> Callable[P, R]:
        @wraps(function)
        def call(*arguments: P.args, **named: P.kwargs) -> R:
            leaves = jax.tree.leaves((arguments, named))
            if any(isinstance(leaf, jax.core.Tracer) for leaf in leaves):
                raise InputError(
                    f"`{function.__name__}` works on numbers, and cannot be called inside "
                    f"`jax.grad`, `jax.jit` or `jax.vmap` with what these vary. {instead}"
                )
            return function(*arguments, **named)

        return call

    return of


def as_numpy(array: Any) -> Any:
    """An array as NumPy's, whose indexing compiles nothing; a traced one unchanged."""
    return array if isinstance(array, jax.core.Tracer) else np.asarray(array)


def numbers_as_arrays(tree: T) -> T:
    """A tree whose Python floats and complex numbers are converted to NumPy's.

    `jax.jit` would give Python's a type of their own, and compile twice.
    """
    return jax.tree.map(_number, tree)


def _in_double_precision() -> None:
    """Raises `ValueError` if JAX was switched to single precision: no solver would converge."""
    if not jax.config.read("jax_enable_x64"):
        raise InputError(
            "JAX computes in single precision: `jax_enable_x64`, which `import snrmjax` switches "
            'on, was switched off. Switch it on: `jax.config.update("jax_enable_x64", True)`.'
        )


def _number(leaf: Any) -> Any:
    return np.asarray(leaf)[()] if isinstance(leaf, float | complex) else leaf


class _Array:
    """Placeholder of an array in the static part."""


class _Once:
    """A value made at the first request, by whichever thread comes first."""

    def __init__(self) -> None:
        self._lock = Lock()
        self._made: list[Any] = []

    def made(self, make: Callable[[], T]) -> T:
        """The value of `make`, which is called once."""
        with self._lock:
            if not self._made:
                self._made.append(make())
        return self._made[0]


@cache
def _options(fast_compile: bool, long_loops: bool, thoroughly: bool) -> dict[str, str | bool | int]:
    """The options known to this version of XLA; none if programs do not run on a CPU.

    An optimisation level set here would override the user's `jax_disable_most_optimizations`.
    """
    if jax.default_backend() != "cpu":
        return {}
    left_out = (_LEVEL,) * (fast_compile or thoroughly) + (_EMITTERS,) * (long_loops or thoroughly)
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
