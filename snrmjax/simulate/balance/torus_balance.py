"""Harmonic balance in two frequencies: quasi-periodic motions as functions of two phases.

q(τ₁, τ₂) with τ₁ = Ωt of the force and τ₂ = ωt of the motion's own slow frequency: a Fourier series
in cos(k₁τ₁ + k₂τ₂) and its sine, with |k₁| up to H and k₂ up to K.
"""

from functools import lru_cache
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from snrmjax.simulate.balance.harmonic_balance import HarmonicBalance
from snrmjax.simulate.balance.harmonics import alias_free_samples


class TorusBasis(NamedTuple):
    """Constant matrices of the series; a coefficient is the mean, a cosine or a sine."""

    fast: np.ndarray  # (coefficient,) k₁
    slow: np.ndarray  # (coefficient,) k₂
    synthesis: np.ndarray  # (sample, coefficient), over both phases
    analysis: np.ndarray  # (coefficient, sample), its left inverse
    by_fast: np.ndarray  # (coefficient, coefficient): ∂/∂τ₁
    by_slow: np.ndarray  # (coefficient, coefficient): ∂/∂τ₂


@lru_cache(maxsize=8)
def torus_basis(fast_order: int, slow_order: int, n_fast: int, n_slow: int) -> TorusBasis:
    """The basis of these harmonic orders and numbers of samples over each phase.

    The coefficients of k₂ = 0 come first, ordered as those of a periodic motion.
    """
    pairs = [(k, 0) for k in range(1, fast_order + 1)]
    for slow in range(1, slow_order + 1):
        pairs += [(k, slow) for k in range(-fast_order, fast_order + 1)]
    fast, slow = np.repeat(np.array(pairs), 2, axis=0).T
    one, two = (2 * np.pi * np.arange(n) / n for n in (n_fast, n_slow))
    first, second = (part.ravel() for part in np.meshgrid(one, two, indexing="ij"))
    angle = np.outer(first, fast[::2]) + np.outer(second, slow[::2])
    size = 2 * len(pairs) + 1
    synthesis = np.ones((first.size, size))
    synthesis[:, 1::2], synthesis[:, 2::2] = np.cos(angle), np.sin(angle)
    analysis = synthesis.T * (2.0 / first.size)
    analysis[0] *= 0.5
    derivative = np.zeros((2, size, size))
    cosines = np.arange(1, size, 2)
    for part, order in zip(derivative, (fast, slow), strict=True):
        part[cosines, cosines + 1], part[cosines + 1, cosines] = order[::2], -order[::2]
    k_fast, k_slow = (np.concatenate([[0], order]) for order in (fast, slow))
    return TorusBasis(k_fast, k_slow, synthesis, analysis, derivative[0], derivative[1])


class TorusBalance(eqx.Module):
    """The balance R(x, ω, Ω) = 0 of quasi-periodic motions under one force.

    A point holds the scaled (coefficient, mode) displacements, then ω and Ω over the scale of
    frequencies. The last equation is the phase condition of τ₂: `phase` · x = 0.
    """

    balance: HarmonicBalance  # of the periodic motions
    phase: Float[Array, " unknown"]  # over the coefficients
    slow_order: int = eqx.field(static=True)

    @property
    def basis(self) -> TorusBasis:
        """The basis, with samples that are alias-free for a polynomial potential."""
        model, order = self.balance.model, self.balance.harmonic_order
        degree = max(model.potential.degree - 1, 1)
        wide = 8 if model.forces else 0
        n_fast = max(alias_free_samples(order, degree), wide * (order + 1))
        n_slow = max(alias_free_samples(self.slow_order, degree), wide * (self.slow_order + 1))
        return torus_basis(order, self.slow_order, n_fast, n_slow)

    @property
    def size(self) -> int:
        """Number of displacement coefficients."""
        return len(self.basis.fast) * self.balance.model.n_modes

    def linearised(
        self, point: Float[Array, " unknown"]
    ) -> tuple[Float[Array, " equation"], Float[Array, "equation unknown"]]:
        """The equations and their Jacobian."""
        balance, basis, size = self.balance, self.basis, self.size
        model, fs, n = balance.model, balance.frequency_scale, balance.model.n_modes
        terms, (slow, fast) = model.linear_terms(), point[-2:]
        x = point[:size].reshape(-1, n)
        rate = fast * basis.by_fast + slow * basis.by_slow
        speed = rate @ x
        scale, unit = balance.displacement_scale, fs**2 * balance.displacement_scale
        synthesis = jnp.asarray(basis.synthesis)
        q, v = synthesis @ (scale * x), synthesis @ (scale * fs * speed)
        inner = basis.analysis @ (model.memoryless_force(q, v) / unit)
        order = fast * basis.fast + slow * basis.slow
        stiffness = terms.stiffness / fs**2
        linear = (stiffness - order[:, None] ** 2 * terms.mass) * x + terms.damped(speed) / fs
        load = jnp.zeros(size).at[: balance.size].set(balance.newtons(fast) * balance.load())
        residual = (linear + inner).reshape(-1) - load

        k, c = model.slopes(q, v)
        moved = synthesis @ rate
        by_x = jnp.einsum("ct,tmn,td->cmdn", basis.analysis, k / fs**2, synthesis)
        by_x = by_x + jnp.einsum("ct,tmn,td->cmdn", basis.analysis, c / fs, moved)
        eye, diagonal = np.eye(len(basis.fast)), np.eye(n)
        own = stiffness - order[:, None] ** 2 * terms.mass
        by_x = by_x + jnp.einsum("cd,cm,mn->cmdn", eye, own, diagonal)
        by_x = by_x + jnp.einsum("cd,mn->cmdn", rate, terms.damping_matrix() / fs)

        def by_frequency(derivative: np.ndarray, orders: np.ndarray) -> Float[Array, " equation"]:
            change = jnp.asarray(derivative) @ x
            rate_change = synthesis @ (scale * change)
            nonlinear = basis.analysis @ (jnp.einsum("tmn,tn->tm", c, rate_change) * fs / unit)
            inertia = -2 * (order * orders)[:, None] * terms.mass * x
            return (terms.damped(change) / fs + nonlinear + inertia).reshape(-1)

        columns = [
            by_frequency(basis.by_slow, basis.slow),
            by_frequency(basis.by_fast, basis.fast),
        ]
        if model.modes.unbalance is not None:
            columns[1] = columns[1] - 2 / fast * load
        top = jnp.concatenate([by_x.reshape(size, size), jnp.stack(columns, axis=1)], axis=1)
        bottom = jnp.concatenate([self.phase, jnp.zeros(2)])
        equations = jnp.append(residual, self.phase @ point[:size])
        return equations, jnp.concatenate([top, bottom[None]])
