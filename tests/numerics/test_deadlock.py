"""Concurrent batched linear algebra in one program: some versions of jaxlib deadlock in it."""

import os
import subprocess
import sys

import pytest

# Independent batched factorisations, as in gradients through several implicit solutions. jaxlib
# 0.10.0 to 0.11.0 runs each on a thread of XLA's pool, where it waits for subtasks that no thread
# of the pool is free to compute.
_SOLVES = """
import jax, numpy as np
jax.config.update("jax_enable_x64", True)
squares = lambda a, b: sum((jax.numpy.linalg.solve(a[k], b) ** 2).sum() for k in range(8))
gradient = jax.jit(jax.vmap(jax.grad(squares), in_axes=(0, None)))
random = np.random.default_rng(0)
matrices = random.normal(size=(300, 8, 20, 20)) + 20 * np.eye(20)
for _ in range(20):
    found = np.asarray(gradient(matrices, random.normal(size=20)))
assert np.isfinite(found).all()
"""
_LIMIT = 60  # s; takes 3


@pytest.mark.skipif(os.cpu_count() == 1, reason="with one core nothing runs in parallel")
def test_gradients_of_many_solves_come_to_an_end():
    quick = os.environ | {"XLA_FLAGS": "", "JAX_PLATFORMS": "cpu"}  # as a user's process has them
    subprocess.run([sys.executable, "-c", _SOLVES], env=quick, check=True, timeout=_LIMIT)
