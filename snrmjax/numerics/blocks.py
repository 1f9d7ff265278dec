"""Many problems of one shape at once: stacked, in blocks of one size, over the cores."""

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache, wraps
from typing import Any, ParamSpec, TypeVar

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Int, Shaped
from threadpoolctl import ThreadpoolController

P = ParamSpec("P")
T = TypeVar("T")
R = TypeVar("R")

_ROW, _MEMBERS = 16, (1, 4, 64)  # rows of one member, and of how many members, in one program


def padded(rows: np.ndarray, at_least: int = 128) -> np.ndarray:
    """Rows with copies of the last up to a power of two of them, so that few shapes compile."""
    missing = max(at_least, 1 << (len(rows) - 1).bit_length()) - len(rows)
    return np.concatenate([rows, np.repeat(rows[-1:], missing, axis=0)])


def by_blocks(
    function: Callable[..., tuple], size: int, *rows: np.ndarray
) -> tuple[np.ndarray, ...]:
    """A compiled function of rows, called with blocks of `size` rows, the last one filled up."""
    n = len(rows[0])

    def answered(begin: int) -> list[np.ndarray]:
        block = []
        for row in rows:
            some = row[begin : begin + size]
            fill = ((0, size - len(some)), *((0, 0),) * (row.ndim - 1))
            block.append(np.pad(some, fill))
        return [np.asarray(a)[: n - begin] for a in function(*block)]

    parts = over_cores(answered, range(0, max(n, 1), size))
    return tuple(np.concatenate(column) for column in zip(*parts, strict=True))


def by_member(
    function: Callable[..., Any],
    members: Any,
    owner: Int[np.ndarray, " row"],
    *rows: Shaped[np.ndarray, "row ..."],
) -> Shaped[np.ndarray, "row ..."]:
    """A compiled function of members and rows of each, for every row with the member it is of.

    Arguments: `function` of stacked members and of rows of every one, of shape (member, row, …),
    gives an array so; `owner` says of which of the `members` a row is. Rows are grouped by member,
    a few of one and some members a call: those of one member and those of thousands need three
    programs, whose digits do not depend on other members. Returns shape (row, …).
    """
    groups = [np.flatnonzero(owner == o) for o in np.unique(owner)]
    parts = [
        np.resize(part, _ROW)  # filled up with its own
        for group in groups
        for part in np.split(group, range(_ROW, len(group), _ROW))
    ]
    # By the members, not their rows: a curve of another length is no other program.
    size = max(size for size in _MEMBERS if size <= len(groups))

    def block(begin: int) -> tuple[np.ndarray, np.ndarray]:
        index = np.stack(parts[begin : begin + size])
        index = index[np.minimum(np.arange(size), len(index) - 1)]
        found = function(taken(members, owner[index[:, 0]]), *(row[index] for row in rows))
        return index.ravel(), np.asarray(found).reshape(index.size, *found.shape[2:])

    found = over_cores(block, range(0, len(parts), size))
    index, values = (np.concatenate(column) for column in zip(*found, strict=True))
    return values[np.unique(index, return_index=True)[1]]


def stacked(trees: Sequence[T]) -> T:
    """One tree whose arrays have a leading axis over `trees`.

    Raises `ValueError` when the trees differ in anything but the numbers in their arrays.
    """
    if all(tree is trees[0] for tree in trees):
        n = len(trees)
        return jax.tree.map(
            lambda a: np.broadcast_to(np.asarray(a), (n, *np.shape(a))) if eqx.is_array(a) else a,
            trees[0],
        )
    arrays, fixed = eqx.partition(list(trees), eqx.is_array)
    first = jax.tree.structure(arrays[0]), fixed[0]
    shapes = [np.shape(leaf) for leaf in jax.tree.leaves(arrays[0])]
    for number, (array, rest) in enumerate(zip(arrays, fixed, strict=True)):
        same = (jax.tree.structure(array), rest) == first
        if not same or [np.shape(leaf) for leaf in jax.tree.leaves(array)] != shapes:
            raise ValueError(
                f"models of a batch must have the same modes, monomials and effects, but number "
                f"{number} differs from the first in more than numbers."
            )
    together = jax.tree.map(lambda *leaves: np.stack([np.asarray(a) for a in leaves]), *arrays)
    return eqx.combine(together, fixed[0])


def taken(tree: T, rows: np.ndarray | int) -> T:
    """Rows of a stacked tree, on the host."""
    return jax.tree.map(lambda a: np.asarray(a)[rows] if eqx.is_array_like(a) else a, tree)


def on_accelerator() -> bool:
    """Whether the default device is anything but a CPU."""
    return jax.default_backend() != "cpu"


def mapped(function: Callable[..., R], *rows: Any) -> R:
    """`function` of every row: one after the other on a CPU, side by side on an accelerator.

    On a CPU lanes of a `vmap` wait for the slowest of them and their small matrices are
    factorised one by one anyway.
    """
    if on_accelerator():
        return jax.vmap(function)(*rows)
    return jax.lax.map(lambda row: function(*row), rows)


def cores() -> int:
    """Threads that work side by side: as many as there are cores, one beside an accelerator."""
    if on_accelerator():
        return 1
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def over_cores(
    function: Callable[[T], R],
    jobs: Sequence[T],
    *,
    progress: Callable[[int, int], None] | None = None,
) -> list[R]:
    """`function` of every job, in as many threads as there are cores.

    JAX's compiled programs do not hold Python's lock, so they run side by side. `progress` is
    called with the jobs done and all of them, from the calling thread.
    """
    workers = min(len(jobs), cores())
    results = []
    with ThreadPoolExecutor(max(workers, 1)) as pool:
        for done, result in enumerate(
            map(function, jobs) if workers < 2 else pool.map(function, jobs)
        ):
            results.append(result)
            if progress is not None:
                progress(done + 1, len(jobs))
    return results


def on_one_core(function: Callable[P, R]) -> Callable[P, R]:
    """A function whose linear algebra on the host does not spread over the cores.

    For matrices of a hundred rows threads cost more than they save, and where `over_cores` is at
    work they take the cores from it: a diagnosis with them takes 1.5 times as long.
    """

    @wraps(function)
    def alone(*arguments: P.args, **named: P.kwargs) -> R:
        with _linear_algebra().limit(limits=1, user_api="blas"):
            return function(*arguments, **named)

    return alone


@cache
def _linear_algebra() -> ThreadpoolController:
    """The libraries of linear algebra: to look for them takes longer than many a small problem."""
    import scipy.linalg  # noqa: F401  # brings a library of its own, which must be there by then

    return ThreadpoolController()


def as_arrays(tree: T) -> T:
    """Arrays of the host as arrays of the device."""
    # All at once: one by one they take longer than the programs that use them.
    on_host, fixed = eqx.partition(tree, lambda a: isinstance(a, (np.ndarray, np.generic)))
    return eqx.combine(jax.device_put(on_host), fixed)
