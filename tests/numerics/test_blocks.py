"""Linear algebra in one thread, for as long as a program runs."""

import jax
import jax.numpy as jnp

from snrmjax.numerics.blocks import on_one_core


def test_one_thread_lasts_until_a_program_has_ended_and_not_only_its_call():
    @jax.jit
    def program(matrix):
        return jax.lax.fori_loop(0, 1500, lambda _, a: jnp.linalg.solve(a, matrix), matrix)

    matrix = jnp.eye(100) + 0.01
    program(matrix).block_until_ready()  # compiled
    assert not program(matrix).is_ready()  # it runs after its call has returned
    assert on_one_core(program)(matrix).is_ready()
