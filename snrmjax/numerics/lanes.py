"""Many iterations in parallel: a lane whose job has ended takes the next one."""

from collections import deque
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int

from snrmjax.numerics.blocks import cores, on_accelerator, over_cores, taken

TOGETHER = 64  # most iterations of several lanes in one call of the program
Jobs: TypeAlias = Any  # trees of arrays with a leading axis
States: TypeAlias = Any
StateRows: TypeAlias = Float[Array, "lane number"]


def lanes_for(unknowns: int) -> int:
    """How many problems with so many unknowns are best solved as a batch.

    An instruction on many small problems costs little more than on one; for large ones the
    factorisations dominate, which run one after the other anyway, and then idle lanes cost time.
    """
    if on_accelerator():
        return 1024
    return 16 if unknowns <= 48 else 4 if unknowns <= 160 else 1


def in_lanes(
    initial: Callable[[Jobs, Bool[np.ndarray, " lane"]], StateRows],
    advance: Callable[[Jobs, StateRows, int], tuple[StateRows, tuple, tuple]],
    jobs: Jobs,
    lanes: int,
) -> tuple[tuple[np.ndarray, ...], list[tuple[np.ndarray, ...]]]:
    """Run all jobs to their ends, `lanes` at a time on every core.

    Arguments: `initial` returns the states of `lanes` jobs in rows, with lanes that are not wanted
    already ended; `advance` returns what `iterated` does, given the number of lanes that may idle.
    The results of a job depend neither on its lane nor on its neighbours.
    Returns the results, of shape (job, …), and the rows that every job emitted on the way.
    """
    n = len(jax.tree.leaves(jobs)[0])
    queue = deque(range(n))
    ends: list[tuple[np.ndarray, list[np.ndarray]]] = []
    emitted: list[list[list[np.ndarray]]] = [[] for _ in range(n)]

    def work(_: int) -> None:
        member, busy = np.zeros(lanes, dtype=int), np.zeros(lanes, dtype=bool)
        states: Any = None
        while True:
            fresh = np.zeros(lanes, dtype=bool)
            for lane in np.flatnonzero(~busy)[: len(queue)].tolist():
                with suppress(IndexError):  # another core was faster
                    member[lane] = queue.popleft()
                    busy[lane] = fresh[lane] = True
            if not busy.any():
                return
            if fresh.any():
                mine = taken(jobs, member)
                new = initial(mine, busy)
                states = new if states is None else np.where(fresh[:, None], new, states)
            states, rows, outcome = advance(mine, states, lanes // 8 if queue else 0)
            kept, *parts = (np.asarray(part) for part in rows)
            active, *values = (np.asarray(part) for part in outcome)
            for lane in np.flatnonzero(busy & kept.any(axis=0)).tolist():
                emitted[member[lane]].append([part[kept[:, lane], lane] for part in parts])
            ended = busy & ~active
            if ended.any():
                ends.append((member[ended], [part[ended] for part in values]))
                busy &= active

    over_cores(work, range(min(cores(), -(-n // lanes))))
    order = np.argsort(np.concatenate([members for members, _ in ends]))
    columns = zip(*(values for _, values in ends), strict=True)
    results = tuple(np.concatenate(column)[order] for column in columns)
    return results, [tuple(map(np.concatenate, zip(*rows, strict=True))) for rows in emitted]


def in_rows(states: States) -> StateRows:
    """The states of several lanes as rows of one array, which transfers faster than many."""
    return jax.vmap(lambda state: ravel_pytree(state)[0])(states)


def iterated(
    initial: Callable[[Any], Any],
    step: Callable[[Any, Any], tuple[Any, tuple]],
    result: Callable[[Any], tuple],
    jobs: Jobs,
    states: StateRows,
    length: int,
    idle: Int[Array, ""],
) -> tuple[StateRows, tuple, tuple]:
    """Iterate all lanes in one program: `length` times, or until at most `idle` are still active.

    Arguments: of one lane, `initial(job)` is the first state; `step(job, state)` returns the next
    state and a row, whose first entry is whether to keep it; `result(state)` returns whether the
    lane is active, and its results. `states` are in rows.
    Returns the states, the rows emitted, of shape (iteration, lane, …), and the results.
    """
    first = jax.eval_shape(initial, jax.tree.map(lambda a: a[0], jobs))
    unravel = ravel_pytree(jax.tree.map(lambda a: jnp.zeros(a.shape, a.dtype), first))[1]

    alone, states = len(states) == 1, jax.vmap(unravel)(states)

    @jax.jit  # traced once, for the shapes of its rows and for the loop
    def stepped(states: States) -> tuple[States, tuple]:
        if not alone:
            return jax.vmap(step)(jobs, states)
        first = (jax.tree.map(lambda a: a[0], tree) for tree in (jobs, states))
        return jax.tree.map(lambda a: a[None], step(*first))

    def body(loop: tuple) -> tuple:
        k, states, rows = loop
        active = jax.vmap(result)(states)[0]
        new, (kept, *parts) = stepped(states)

        def unless_ended(a: Array, b: Array) -> Array:
            return jnp.where(active.reshape(-1, *(1,) * (a.ndim - 1)), a, b)

        # A single lane that has ended ends the loop: no masking is needed.
        states = new if alone else jax.tree.map(unless_ended, new, states)
        row = (kept & active, *parts)
        put = partial(jax.lax.dynamic_update_index_in_dim, index=k, axis=0)
        return k + 1, states, tuple(map(put, rows, row))

    shapes = jax.eval_shape(stepped, states)[1]
    rows = tuple(jnp.zeros((length, *part.shape), part.dtype) for part in shapes)

    def keep_going(loop: tuple) -> Array:
        return (loop[0] < length) & (jnp.sum(jax.vmap(result)(loop[1])[0]) > idle)

    _, states, rows = jax.lax.while_loop(keep_going, body, (jnp.array(0), states, rows))
    return in_rows(states), rows, jax.vmap(result)(states)
