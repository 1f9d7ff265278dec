"""Batches of problems of one shape: stacked, split into equal blocks, spread over the cores."""

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

from snrmjax.numerics.rules import InputError

P = ParamSpec("P")
T = TypeVar("T")
R = TypeVar("R")

_ROW, _MEMBERS = 16, (1, 4, 64)  # rows a member, and numbers of members, of one program


def padded(rows: np.ndarray, at_least: int = 128) -> np.ndarray:
    """Rows padded to a power of two with copies of the last, so that few shapes compile."""
    missing = max(at_least, 1 << (len(rows) - 1).bit_length()) - len(rows)
    return np.concatenate([rows, np.repeat(rows[-1:], missing, axis=0)])


def by_blocks(
    function: Callable[..., tuple], size: int, *rows: np.ndarray
) -> tuple[np.ndarray, ...]:
    """A compiled function of rows, evaluated in blocks of `size` rows, the last one padded."""
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
    """A compiled function of members and their rows, evaluated for every row with its member.

    Arguments: `function` maps stacked members and their rows, of shape (member, row, …), to an
    array of that shape; `owner` is the index of each row's member. Rows are grouped by member and
    evaluated in calls of a few shapes: one member or thousands compile three programs, and
    results do not depend on which members share a call. Returns shape (row, …).
    """
    groups = [np.flatnonzero(owner == o) for o in np.unique(owner)]
    parts = [
        np.resize(part, _ROW)  # padded with its own rows
        for group in groups
        for part in np.split(group, range(_ROW, len(group), _ROW))
    ]
    # Chosen by the number of members alone: a curve of another length does not recompile.
    size = max(size for size in _MEMBERS if size <= len(groups))

    def block(begin: int) -> tuple[np.ndarray, np.ndarray]:
        index = np.stack(parts[begin : begin + size])
        index = index[np.minimum(np.arange(size), len(index) - 1)]
        values = function(taken(members, owner[index[:, 0]]), *(row[index] for row in rows))
        return index.ravel(), np.asarray(values).reshape(index.size, *values.shape[2:])

    results = over_cores(block, range(0, len(parts), size))
    index, values = (np.concatenate(column) for column in zip(*results, strict=True))
    return values[np.unique(index, return_index=True)[1]]


def stacked(trees: Sequence[T]) -> T:
    """One tree whose arrays have a leading axis over `trees`.

    Raises `ValueError` when the trees differ in more than the values of their arrays.
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
            raise InputError(
                f"models of a batch must have the same modes, monomials and effects, but number "
                f"{number} differs from the first in more than numbers."
            )
    together = jax.tree.map(lambda *leaves: np.stack([np.asarray(a) for a in leaves]), *arrays)
    return eqx.combine(together, fixed[0])


def taken(tree: T, rows: np.ndarray | int) -> T:
    """The entries `rows` of a stacked tree, on the host."""
    return jax.tree.map(lambda a: np.asarray(a)[rows] if eqx.is_array_like(a) else a, tree)


def on_accelerator() -> bool:
    """Whether the default device is anything but a CPU."""
    return jax.default_backend() != "cpu"


def mapped(function: Callable[..., R], *rows: Any) -> R:
    """`function` of every row: one after the other on a CPU, as a batch on an accelerator.

    On a CPU the members of a `vmap` wait for the slowest, and their small matrices are
    factorised one by one anyway.
    """
    if on_accelerator():
        return jax.vmap(function)(*rows)
    return jax.lax.map(lambda row: function(*row), rows)


def cores() -> int:
    """Number of worker threads: that of the available cores, or one with an accelerator."""
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

    JAX's compiled programs release Python's lock, so they run in parallel. `progress` is called
    with the number of jobs done and their total, from the calling thread.
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
    """A function whose linear algebra on the host runs in one thread.

    For matrices of a hundred rows threads cost more than they save, and they compete with those
    of `over_cores`: a diagnosis takes 1.5 times as long with them.
    """

    @wraps(function)
    def alone(*arguments: P.args, **named: P.kwargs) -> R:
        with _linear_algebra().limit(limits=1, user_api="blas"):
            # Programs run after their call has returned: the setting holds until they end.
            return jax.block_until_ready(function(*arguments, **named))

    return alone


@cache
def _linear_algebra() -> ThreadpoolController:
    """The loaded BLAS libraries; finding them takes longer than many a small problem."""
    import scipy.linalg  # noqa: F401  # loads a BLAS of its own, which must be found too

    return ThreadpoolController()


def as_arrays(tree: T) -> T:
    """A tree with its NumPy arrays moved to the device."""
    # In one transfer: one by one they take longer than the programs that use them.
    on_host, fixed = eqx.partition(tree, lambda a: isinstance(a, (np.ndarray, np.generic)))
    return eqx.combine(jax.device_put(on_host), fixed)
