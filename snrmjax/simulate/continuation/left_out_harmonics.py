"""Periodic motions with twice the harmonics of their balance."""

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from snrmjax.model.structures import Structure
from snrmjax.numerics.blocks import by_member, mapped
from snrmjax.numerics.compiled import compiled
from snrmjax.numerics.newton import Point, solve_appended
from snrmjax.simulate.balance.harmonic_balance import BY_CYCLE, HarmonicBalance, samples_for

_TOLERANCE = 1e-7  # norm of the last correction of the scaled unknowns
_ROUNDS = 12  # most corrections; three to five suffice


class _Iteration(NamedTuple):
    """State of the iteration."""

    point: Point
    moved: Float[Array, ""]  # length of the last correction
    n_corrections: Int[Array, ""]


def has_contacts(model: Structure) -> bool:
    """Whether contacts or friction make the forces nonsmooth: their harmonics decay slowly."""
    return any(isinstance(force, BY_CYCLE) for force in model.forces)


def completed_motions(
    balances: HarmonicBalance, owner: np.ndarray, points: Float[np.ndarray, "point unknown"]
) -> tuple[Float[np.ndarray, "point coefficient mode"], Float[np.ndarray, " point"]]:
    """Coefficients (kg^1/2 m) and frequencies (rad/s) of scaled points with twice the harmonics.

    When a contact closes or a slider slips depends on harmonics beyond those of the balance, and so
    does the stability. A motion that does not converge is NaN: its stability is not known.
    Arguments: `balances` stacked; `owner` is the index of each point's balance.
    """
    wide = by_member(_completed, balances, owner, points)
    missed = np.isnan(wide[:, -1]) & np.isfinite(points[:, -1])
    if missed.any():
        wide[missed] = by_member(_completed_by_newton, balances, owner[missed], points[missed])
    return _widened(balances).motions(wide, owner)


@partial(compiled, long_loops=True)
def _completed(
    balances: HarmonicBalance, points: Float[Array, "row point unknown"]
) -> Float[Array, "row point wide"]:
    return mapped(lambda balance, rows: jax.vmap(partial(_of, balance))(rows), balances, points)


@partial(compiled, long_loops=True)
def _completed_by_newton(
    balances: HarmonicBalance, points: Float[Array, "row point unknown"]
) -> Float[Array, "row point wide"]:
    return mapped(
        lambda balance, rows: jax.lax.map(partial(_by_newton, balance), rows), balances, points
    )


def _of(balance: HarmonicBalance, point: Point) -> Point:
    """The point with twice the harmonics, NaN if the iteration does not converge.

    Newton's method with a block-diagonal Jacobian: that of the balance at the point, inverted
    across its null vector, so that it passes folds; and for every higher harmonic the dynamic
    stiffness of each mode with its mean tangent stiffness. Their coupling is small and neglected.
    """
    wide, size, n = _widened(balance), balance.size, balance.model.n_modes
    jacobian = balance.linearised(point)[1]
    # Columns of the pseudo-inverse: the minimum-norm correction for each equation.
    gram = jacobian @ jacobian.T
    shortest = jacobian.T @ solve_appended(jnp.concatenate([gram, jnp.eye(size)]))
    terms = balance.model.linear_terms()
    orders = np.arange(balance.harmonic_order + 1, wide.harmonic_order + 1)[:, None]
    # The derivative of the mean equation by the mean displacement is the mean tangent stiffness.
    speed, stiffness = orders * point[-1], jnp.diag(jacobian[:n, :n])
    dynamic = stiffness - terms.mass * speed**2
    dynamic = dynamic - 1j * terms.damping * speed / balance.frequency_scale

    def change(at: Point) -> Point:
        residual = wide.residual(at)
        beyond = residual[size:].reshape(len(orders), 2, n)
        phasor = (beyond[:, 0] + 1j * beyond[:, 1]) / dynamic
        near, far = shortest @ residual[:size], jnp.stack([phasor.real, phasor.imag], axis=1)
        return jnp.concatenate([near[:-1], far.reshape(-1), near[-1:]])

    return _settled(change, _padded(wide, point))


def _by_newton(balance: HarmonicBalance, point: Point) -> Point:
    """The same with the full Jacobian in each iteration, for strong coupling of the blocks."""
    wide = _widened(balance)

    def change(at: Point) -> Point:
        residual, jacobian = wide.linearised(at)
        gram = jacobian @ jacobian.T
        return solve_appended(jnp.concatenate([gram, residual[None]]))[0] @ jacobian

    return _settled(change, _padded(wide, point))


def _settled(change: Callable[[Point], Point], start: Point) -> Point:
    """The fixed point of the corrections, NaN if they do not converge."""

    def corrected(last: _Iteration) -> _Iteration:
        step = change(last.point)
        return _Iteration(last.point - step, jnp.linalg.norm(step), last.n_corrections + 1)

    def goes_on(last: _Iteration) -> Array:
        return (last.moved > _TOLERANCE) & (last.n_corrections < _ROUNDS)

    first = _Iteration(start, jnp.array(jnp.inf), jnp.array(0))
    end = jax.lax.while_loop(goes_on, corrected, first)
    return jnp.where(end.moved <= _TOLERANCE, end.point, jnp.nan)


def _padded(wide: HarmonicBalance, point: Point) -> Point:
    zeros = jnp.zeros(wide.size + 1 - len(point))
    return jnp.concatenate([point[:-1], zeros, point[-1:]])


def _widened(balance: HarmonicBalance) -> HarmonicBalance:
    """The balance with twice the harmonics."""
    order = 2 * balance.harmonic_order
    samples = max(samples_for(balance.model, order, None), balance.n_samples)
    return dataclasses.replace(balance, harmonic_order=order, n_samples=samples)
