"""Derivatives of a function against each other and against differences."""

import functools

import jax
import jax.numpy as jnp
import numpy as np


def numbers(*values):
    """All numbers of some arrays in one vector, complex ones by their parts."""
    parts = []
    for value in values:
        array = jnp.asarray(value).reshape(-1)
        parts += [array.real, array.imag] if jnp.iscomplexobj(array) else [array]
    return jnp.concatenate(parts)


@functools.cache
def programs(function):
    """Values, forward and reverse derivatives and values of a batch, compiled once."""
    return (
        jax.jit(function),
        jax.jit(jax.jacfwd(function)),
        jax.jit(jax.jacrev(function)),
        jax.jit(lambda rows, *arguments: jax.vmap(lambda row: function(row, *arguments))(rows)),
    )


def check_derivatives(function, size, *arguments, step=1e-5, failed=()):
    """Forward and reverse mode agree to 1e-9, and with central differences to 1e-6.

    Arguments: `function` of a vector of `size` changes, relative ones, taken at zero, and of
    `arguments`; its result is a vector. `failed` are the members of the vector that move a failed
    state alone. Relative to the largest derivative of each output. An output that is NaN, of a
    failed state, has derivatives zero or NaN; it adds nothing to the others'.
    Returns the derivatives.
    """
    value_of, forward_of, backward_of, batch_of = programs(function)
    zero = jnp.zeros(size)
    value = np.asarray(value_of(zero, *arguments))
    forward, backward = (np.asarray(one(zero, *arguments)) for one in (forward_of, backward_of))
    there = np.isfinite(value)
    assert there.any()
    own = np.isin(np.arange(size), failed)
    for derivative in (forward, backward):
        assert np.isfinite(derivative[there][:, ~own]).all()
        # What is NaN itself gives NaN or zero, and no number.
        for lost in (derivative[~there], derivative[:, own]):
            assert np.all(np.isnan(lost) | (lost == 0))
    forward, backward = (np.where(own, 0.0, one) for one in (forward, backward))
    # Of fourth order: (step/ζ)⁴ for a lightly damped mode, and rounding over the step.
    rows = step * np.eye(size) * ~own
    moves = np.concatenate([rows, -rows, 2 * rows, -2 * rows])
    near, back, far, far_back = np.split(np.asarray(batch_of(moves, *arguments)), 4)
    differences = ((8 * (near - back) - (far - far_back)) / (12 * step)).T[there]
    forward, backward = forward[there], backward[there]
    largest = np.max(np.abs(forward), axis=1, keepdims=True)
    # An output that hardly moves has derivatives of rounding of its own size.
    floor = np.maximum(largest, 1e-3 * np.abs(value[there])[:, None]) + 1e-300
    assert np.max(np.abs(forward - backward) / floor) < 1e-9
    assert np.max(np.abs(forward - differences) / floor) < 1e-6
    return forward
