"""Many iterations side by side: a lane whose job has ended takes the next one."""

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

TOGETHER = 64  # iterations of several lanes, at most, before the host sees them
Jobs: TypeAlias = Any  # trees of arrays with a leading axis
States: TypeAlias = Any
StateRows: TypeAlias = Float[Array, "lane number"]


def lanes_for(unknowns: int) -> int:
    """How many problems of this size are best worked on side by side.

    An instruction on many small problems costs little more than on one; large ones are held up by
    their factorisations, which follow one another anyway, and then lanes without a job cost.
    """
    if on_accelerator():
        return 1024
    return 16 if unknowns <= 48 else 4 if unknowns <= 160 else 1


def in_lanes(
    begun: Callable[[Jobs, Bool[np.ndarray, " lane"]], StateRows],
    advanced: Callable[[Jobs, StateRows, int], tuple[StateRows, tuple, tuple]],
    jobs: Jobs,
    lanes: int,
) -> tuple[tuple[np.ndarray, ...], list[tuple[np.ndarray, ...]]]:
    """All jobs to their ends, `lanes` at a time on every core.

    Arguments: `begun` gives the states of `lanes` jobs in rows, those of lanes not wanted being at
    their end; `advanced` is what `iterated` gives of them, with as many lanes as may be idle.
    What a job gives does not depend on its lane, nor on its neighbours.
    Returns the results, of shape (job, …), and the rows that every job gave on the way.
    """
    n = len(jax.tree.leaves(jobs)[0])
    queue = deque(range(n))
    ends: list[tuple[np.ndarray, list[np.ndarray]]] = []
    given: list[list[list[np.ndarray]]] = [[] for _ in range(n)]

    def worked(_: int) -> None:
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
                new = begun(mine, busy)
                states = new if states is None else np.where(fresh[:, None], new, states)
            states, rows, told = advanced(mine, states, lanes // 8 if queue else 0)
            kept, *parts = (np.asarray(part) for part in rows)
            going, *found = (np.asarray(part) for part in told)
            for lane in np.flatnonzero(busy & kept.any(axis=0)).tolist():
                given[member[lane]].append([part[kept[:, lane], lane] for part in parts])
            over = busy & ~going
            if over.any():
                ends.append((member[over], [part[over] for part in found]))
                busy &= going

    over_cores(worked, range(min(cores(), -(-n // lanes))))
    order = np.argsort(np.concatenate([members for members, _ in ends]))
    columns = zip(*(found for _, found in ends), strict=True)
    results = tuple(np.concatenate(column)[order] for column in columns)
    return results, [tuple(map(np.concatenate, zip(*rows, strict=True))) for rows in given]


def in_rows(states: States) -> StateRows:
    """The states of several lanes, each in a row: one array is handed over faster than many."""
    return jax.vmap(lambda state: ravel_pytree(state)[0])(states)


def iterated(
    begun: Callable[[Any], Any],
    step: Callable[[Any, Any], tuple[Any, tuple]],
    result: Callable[[Any], tuple],
    jobs: Jobs,
    states: StateRows,
    length: int,
    idle: Int[Array, ""],
) -> tuple[StateRows, tuple, tuple]:
    """Iterations of all lanes in one program: `length`, or until `idle` of them or fewer go on.

    Arguments: of one lane, `begun(job)` is the state at first; `step(job, state)` gives the next
    state and a row, the first part of which says whether it is kept; `result(state)` says whether
    it goes on, and what is wanted of it at its end. `states` are in rows.
    Returns the states, the rows given, of shape (iteration, lane, …), and the results.
    """
    first = jax.eval_shape(begun, jax.tree.map(lambda a: a[0], jobs))
    whole = ravel_pytree(jax.tree.map(lambda a: jnp.zeros(a.shape, a.dtype), first))[1]

    alone, states = len(states) == 1, jax.vmap(whole)(states)

    def stepped(states: States) -> tuple[States, tuple]:
        if not alone:
            return jax.vmap(step)(jobs, states)
        first = (jax.tree.map(lambda a: a[0], tree) for tree in (jobs, states))
        return jax.tree.map(lambda a: a[None], step(*first))

    def body(loop: tuple) -> tuple:
        k, states, rows = loop
        going = jax.vmap(result)(states)[0]
        new, (kept, *given) = stepped(states)

        def unless_ended(a: Array, b: Array) -> Array:
            return jnp.where(going.reshape(-1, *(1,) * (a.ndim - 1)), a, b)

        # A lane alone that has ended ends the loop.
        states = new if alone else jax.tree.map(unless_ended, new, states)
        row = (kept & going, *given)
        put = partial(jax.lax.dynamic_update_index_in_dim, index=k, axis=0)
        return k + 1, states, tuple(map(put, rows, row))

    shapes = jax.eval_shape(stepped, states)[1]
    rows = tuple(jnp.zeros((length, *part.shape), part.dtype) for part in shapes)

    def going_on(loop: tuple) -> Array:
        return (loop[0] < length) & (jnp.sum(jax.vmap(result)(loop[1])[0]) > idle)

    _, states, rows = jax.lax.while_loop(going_on, body, (jnp.array(0), states, rows))
    return in_rows(states), rows, jax.vmap(result)(states)
