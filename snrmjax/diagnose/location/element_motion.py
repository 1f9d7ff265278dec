"""The motion of a nonlinear element in a linear structure, at measured fundamentals.

An element with the force f moves along its row, at every order h but the fundamental, as the
structure answers to that force: X_h = −R(hΩ) F_h(X). Where the fundamental X_1 is measured, these
are its own harmonics and its mean, recorded or not: a harmonic balance whose unknowns are those of
the element alone.
Reference: Krack & Gross, Harmonic Balance for Nonlinear Vibration Problems (2019), section 3.
"""

import dataclasses
from functools import cache
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float

from snrmjax.model.effect_base import AbstractForce, AbstractHysteresis
from snrmjax.model.library.friction import AbstractSliders
from snrmjax.numerics.compiled import compiled
from snrmjax.simulate.balance.harmonics import HarmonicBasis, harmonic_basis

OWN_ORDERS = 15  # of an element's motion
_SAMPLES = 256  # of a cycle
_FINE = 1024  # of a cycle in which a force jumps
_ROUNDS = 30  # of Newton's method, at most
_SETTLED = 1e-7  # of the fundamental, that a motion may still miss
_LEAST_STEP = 1 / 64  # of Newton's, below which a state is given up


class SurroundedElement(NamedTuple):
    """What an element's motion follows from: per state, orders 0 to H along the row."""

    frequency: Float[np.ndarray, " state"]  # rad/s
    receptance: Complex[np.ndarray, "state order"]  # m/N, of the structure without the element
    motion: Complex[np.ndarray, "state order"]  # m, a first guess; its order 1 is measured


class ElementForces(NamedTuple):
    """Harmonics of an element's force with its own motion, orders 0 to H, and their slopes.

    Real and imaginary parts of the fundamental of the motion are what the slopes are by, beside
    the parameters of the law.
    """

    force: Complex[np.ndarray, "state order"]
    motion: Complex[np.ndarray, "state order"]
    by_parameter: Complex[np.ndarray, "state order parameter"]
    by_motion: Complex[np.ndarray, "state order 2"]
    settled: Bool[np.ndarray, " state"]


def element_forces(
    effect: AbstractForce,
    values: Float[np.ndarray, " parameter"],
    element: SurroundedElement,
) -> ElementForces:
    """The forces of a law with its own motion at every state, by Newton's method.

    Arguments: `effect` says which law, `values` its parameters. States whose motion was not found
    are not `settled`: their forces are those of the nearest motion that was.
    """
    n_orders = element.motion.shape[1]
    names = tuple(effect.parameters())
    free = np.delete(np.arange(2 * n_orders - 1), [1, 2])
    receptance = _products(element.receptance)
    motion = _real_parts(element.motion)
    size = np.abs(element.motion[:, 1])
    eye = np.eye(len(free))

    def along(motion: np.ndarray) -> tuple[np.ndarray, ...]:
        """Force, its slopes, and what the motion misses, over the fundamental."""
        found = _harmonics(effect, names, values, motion, element.frequency)
        force, slopes = (np.array(part) for part in found)
        answer = np.einsum("sij,sj->si", receptance, force)
        missed = (motion + answer)[:, free] / size[:, None]
        return force, slopes, np.where(np.isfinite(missed), missed, np.inf)

    def jacobian(slopes: np.ndarray) -> np.ndarray:
        turned = receptance[:, free] @ slopes
        return np.where(np.isfinite(turned), turned, 0.0)

    force, slopes, missed = along(motion)
    share = np.ones(len(motion))
    step = np.zeros_like(missed)
    for turn in range(_ROUNDS):
        if turn:
            trial = motion.copy()
            trial[:, free] += share[:, None] * step
            found = along(trial)
            left = np.linalg.norm(found[2], axis=1)
            better = left < (1 - 1e-4 * share) * np.linalg.norm(missed, axis=1)
            going = _misses(missed) > _SETTLED
            taken = better & going
            motion[taken], force[taken] = trial[taken], found[0][taken]
            slopes[taken], missed[taken] = found[1][taken], found[2][taken]
            share = np.where(better, np.minimum(2 * share, 1.0), 0.5 * share)
        going = (_misses(missed) > _SETTLED) & (share >= _LEAST_STEP)
        if not going.any():
            break
        by_free = eye + jacobian(slopes)[:, :, free]
        step = _solved(by_free, -np.where(np.isfinite(missed), missed, 0.0) * size[:, None])
        step[~going] = 0.0
    turned = jacobian(slopes)
    by_free = eye + turned[:, :, free]
    outside = np.concatenate([turned[:, :, 1:3], _by_values(slopes, receptance, free)], axis=2)
    follows = -_solved(by_free, outside)
    n = slopes.shape[1]
    direct = np.concatenate([slopes[:, :, 1:3], slopes[:, :, n:]], axis=2)
    whole = _complex((direct + slopes[:, :, free] @ follows).swapaxes(1, 2)).swapaxes(1, 2)
    settled = _misses(missed) <= _SETTLED
    return ElementForces(
        _complex(force), _complex(motion), whole[:, :, 2:], whole[:, :, :2], settled
    )


def force_along(
    effect: AbstractForce, values: Float[np.ndarray, " parameter"], element: SurroundedElement
) -> Complex[np.ndarray, "state order"]:
    """Harmonics of a law's force along the motions as they are given."""
    names, motion = tuple(effect.parameters()), _real_parts(element.motion)
    return _complex(np.asarray(_harmonics(effect, names, values, motion, element.frequency)[0]))


def _misses(missed: np.ndarray) -> np.ndarray:
    return np.max(np.abs(missed), axis=1)


def _solved(matrix: np.ndarray, right: np.ndarray) -> np.ndarray:
    if right.ndim == 2:
        return np.linalg.solve(matrix, right[..., None])[..., 0]
    return np.linalg.solve(matrix, right)


def _by_values(slopes: np.ndarray, receptance: np.ndarray, free: np.ndarray) -> np.ndarray:
    by = receptance[:, free] @ slopes[:, :, slopes.shape[1] :]
    return np.where(np.isfinite(by), by, 0.0)


def _real_parts(phasors: Complex[np.ndarray, "state order"]) -> Float[np.ndarray, "state part"]:
    """Mean, cosine and sine of each order, as a `HarmonicBasis` has them: Re Z e^{ihτ}."""
    parts = np.stack([phasors.real, -phasors.imag], axis=2).reshape(len(phasors), -1)
    return np.delete(parts, 1, axis=1)


def _complex(parts: Float[np.ndarray, "*batch part"]) -> Complex[np.ndarray, "*batch order"]:
    higher = parts[..., 1::2] - 1j * parts[..., 2::2]
    return np.concatenate([parts[..., :1] + 0j, higher], axis=-1)


def _products(phasors: Complex[np.ndarray, "state order"]) -> Float[np.ndarray, "state part part"]:
    """Multiplication by phasors as matrices on the real parts."""
    n_states, n_orders = phasors.shape
    found = np.zeros((n_states, 2 * n_orders - 1, 2 * n_orders - 1))
    found[:, 0, 0] = phasors[:, 0].real
    h = np.arange(1, n_orders)
    a, b = 2 * h - 1, 2 * h
    found[:, a, a] = found[:, b, b] = phasors[:, 1:].real
    found[:, a, b], found[:, b, a] = phasors[:, 1:].imag, -phasors[:, 1:].imag
    return found


@cache
def _basis(n_orders: int, jumps: bool) -> HarmonicBasis:
    return harmonic_basis(n_orders - 1, _FINE if jumps else _SAMPLES)


@compiled
def _harmonics(
    effect: AbstractForce,
    names: tuple[str, ...],
    values: Float[Array, " parameter"],
    motion: Float[Array, "state part"],
    frequency: Float[Array, " state"],
) -> tuple[Float[Array, "state part"], Float[Array, "state part argument"]]:
    """Parts of a law's force along motions, and their slopes by those of the motion and values."""
    jumps = isinstance(effect, AbstractHysteresis) and not isinstance(effect, AbstractSliders)
    basis = _basis((motion.shape[1] + 1) // 2, jumps)
    synthesis, analysis = jnp.asarray(basis.synthesis), jnp.asarray(basis.analysis)
    rates = jnp.asarray(basis.synthesis @ basis.derivative)

    def one(motion: Array, omega: Array) -> tuple[Array, Array]:
        def force(given: Array) -> Array:
            x, of = jnp.split(given, [len(motion)])
            law = dataclasses.replace(effect, **dict(zip(names, of, strict=True)))
            return analysis @ law.cycle_force(synthesis @ x, omega * (rates @ x))

        given = jnp.concatenate([motion, values])
        return force(given), jax.jacfwd(force)(given)

    return jax.vmap(one)(motion, frequency)
