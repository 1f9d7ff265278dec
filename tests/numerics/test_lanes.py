"""Lanes: Collatz sequences in parallel, of very different and known lengths."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from snrmjax.numerics import lanes as module
from snrmjax.numerics.lanes import in_lanes, in_rows, iterated

START = np.array([27, 1, 2, 97, 7, 3, 16, 6, 19, 1, 54, 12, 5])


def sequence(number):
    """All numbers after the first, down to one."""
    numbers = []
    while number != 1:
        number = number // 2 if number % 2 == 0 else 3 * number + 1
        numbers.append(number)
    return numbers


@jax.jit
def initial(jobs, wanted):
    return in_rows((jnp.where(wanted, jobs, 1), jnp.zeros_like(jobs)))


@jax.jit
def advance(jobs, states, idle):
    def step(job, state):
        number, count = state
        number = jnp.where(number % 2 == 0, number // 2, 3 * number + 1)
        return (number, count + 1), (number % 2 == 0, number)

    def result(state):
        return state[0] > 1, *state

    return iterated(lambda job: (job, job), step, result, jobs, states, 10, idle)


@pytest.mark.parametrize("lanes", [1, 2, 4, 16])
@pytest.mark.parametrize("cores", [1, 2])
def test_every_job_comes_to_its_own_end(lanes, cores, monkeypatch):
    monkeypatch.setattr(module, "cores", lambda: cores)
    (last, count), rows = in_lanes(initial, advance, START, lanes)
    assert last.tolist() == [1] * len(START)
    exact = [sequence(int(number)) for number in START]
    assert count.tolist() == [len(numbers) for numbers in exact]
    # Kept rows are the even numbers, in order.
    for found, numbers in zip(rows, exact, strict=True):
        even = [number for number in numbers if number % 2 == 0]
        assert [number for part in found for number in part.tolist()] == even


def test_lanes_stop_where_few_go_on():
    jobs = jnp.asarray(START[:4])
    states = initial(jobs, jnp.ones(4, dtype=bool))
    # One is at its end from the start, 2 after one step; two lanes are left then.
    _, _, (_, _, count) = advance(jobs, states, jnp.array(2))
    assert count.tolist() == [1, 0, 1, 1]
    _, _, (_, _, count) = advance(jobs, states, jnp.array(0))
    assert count.tolist() == [10, 0, 1, 10]
