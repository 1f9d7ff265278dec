"""Periodic motions with the harmonics that their balance has left out."""

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
from snrmjax.simulate.balance.harmonic_balance import BY_CYCLE, HarmonicBalance, samples_for
from snrmjax.simulate.continuation.newton import Point, solved_behind

_TOLERANCE = 1e-7  # of the scaled unknowns, on the last correction
_ROUNDS = 12  # of corrections at most; three to five do


class _Correcting(NamedTuple):
    """Corrections under way."""

    point: Point
    moved: Float[Array, ""]  # length of the last correction
    rounds: Int[Array, ""]


def has_contacts(model: Structure) -> bool:
    """Whether contacts or friction bend the forces along a motion: their harmonics fade slowly."""
    return any(isinstance(force, BY_CYCLE) for force in model.forces)


def completed_motions(
    balances: HarmonicBalance, owner: np.ndarray, points: Float[np.ndarray, "point unknown"]
) -> tuple[Float[np.ndarray, "point coefficient mode"], Float[np.ndarray, " point"]]:
    """Coefficients (kg^1/2 m) and frequencies (rad/s) of scaled points with twice the harmonics.

    Where a contact closes and a slider slips depends on harmonics beyond those of the balance, and
    with it the stability. A motion that is not found with them is NaN: its stability is not known.
    Arguments: `balances` stacked; `owner` says of which of them a point is.
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
    """The point with twice the harmonics, NaN where they do not settle.

    Newton's method with two parts of the Jacobian: that of the balance at the point, across its
    null vector, so that it passes folds; and for every harmonic beyond the dynamic stiffness of
    each mode with its mean tangent stiffness. What couples them is small, and left to the rounds.
    """
    wide, size, n = _widened(balance), balance.size, balance.model.n_modes
    jacobian = balance.linearised(point)[1]
    # Columns of the pseudo-inverse: the shortest correction for each equation.
    gram = jacobian @ jacobian.T
    shortest = jacobian.T @ solved_behind(jnp.concatenate([gram, jnp.eye(size)]))
    terms = balance.model.linear_terms()
    orders = np.arange(balance.harmonic_order + 1, wide.harmonic_order + 1)[:, None]
    # The mean equation's derivative by the mean displacement is the mean tangent stiffness.
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
    """The same with the whole Jacobian in each round, where the parts' coupling is not small."""
    wide = _widened(balance)

    def change(at: Point) -> Point:
        residual, jacobian = wide.linearised(at)
        gram = jacobian @ jacobian.T
        return solved_behind(jnp.concatenate([gram, residual[None]]))[0] @ jacobian

    return _settled(change, _padded(wide, point))


def _settled(change: Callable[[Point], Point], start: Point) -> Point:
    """Where corrections end, NaN where they do not."""

    def corrected(last: _Correcting) -> _Correcting:
        step = change(last.point)
        return _Correcting(last.point - step, jnp.linalg.norm(step), last.rounds + 1)

    def goes_on(last: _Correcting) -> Array:
        return (last.moved > _TOLERANCE) & (last.rounds < _ROUNDS)

    begun = _Correcting(start, jnp.array(jnp.inf), jnp.array(0))
    end = jax.lax.while_loop(goes_on, corrected, begun)
    return jnp.where(end.moved <= _TOLERANCE, end.point, jnp.nan)


def _padded(wide: HarmonicBalance, point: Point) -> Point:
    zeros = jnp.zeros(wide.size + 1 - len(point))
    return jnp.concatenate([point[:-1], zeros, point[-1:]])


def _widened(balance: HarmonicBalance) -> HarmonicBalance:
    """The same balance with twice the harmonics."""
    order = 2 * balance.harmonic_order
    samples = max(samples_for(balance.model, order, None), balance.n_samples)
    return dataclasses.replace(balance, harmonic_order=order, n_samples=samples)
