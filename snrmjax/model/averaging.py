"""Natural frequency and damping of one mode by the method of averaging."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from snrmjax.model.effect_base import AbstractForce


class AveragedForce(NamedTuple):
    """Equivalent stiffness and damping of a force on a mode that moves as q = Q cos Ωt."""

    stiffness: Float[Array, "*batch"]  # Δ(ω̃²), 1/s²
    damping: Float[Array, "*batch"]  # Δ(2ζ̃ω̃), 1/s


def averaged_effect(
    effect: AbstractForce,
    amplitude: Float[Array, "*batch"],
    frequency: Float[Array, "*batch"],
    *,
    n_samples: int = 512,
) -> AveragedForce:
    """Equivalent stiffness and damping of an effect over one steady cycle, hysteretic or not.

    Δ(ω̃²) = (1/πQ) ∮ f(Q cos β, −QΩ sin β) cos β dβ and
    Δ(2ζ̃ω̃) = −(1/πQΩ) ∮ f(Q cos β, −QΩ sin β) sin β dβ,
    by the trapezoidal rule, which converges exponentially for smooth f and with the square of
    the step for a continuous one and for friction.

    Arguments: `amplitude` Q in kg^1/2 m, not zero; `frequency` Ω in rad/s. Returns 1/s² and 1/s.
    First order in the force: harmonics of the response are neglected. Differentiable with respect
    to all arguments and the effect's parameters.
    Reference: Kwarta & Allen, Eqs. (9a) and (9b); (9b) as printed contradicts their Eq. (8) for
    linear damping and is corrected here, and (9a) is the first-order root of Δ(ω̃²).

    >>> from snrmjax.model.effects import make_effect
    >>> slider = make_effect("jenkins_slider", {"stiffness": 9.0, "slip_displacement": 1.0})
    >>> averaged_effect(slider, jnp.array(2.0), jnp.array(3.0)).stiffness.round(2)
    Array(-4.5, dtype=float64)
    """
    amplitude, frequency = jnp.broadcast_arrays(jnp.asarray(amplitude), jnp.asarray(frequency))
    beta = 2 * jnp.pi * jnp.arange(n_samples) / n_samples
    displacement = amplitude.reshape(-1, 1) * jnp.cos(beta)
    velocity = -(amplitude * frequency).reshape(-1, 1) * jnp.sin(beta)
    force = jax.vmap(effect.cycle_force)(displacement, velocity)
    force = force.reshape(*amplitude.shape, n_samples)
    cosine = 2.0 * jnp.mean(force * jnp.cos(beta), axis=-1)
    sine = 2.0 * jnp.mean(force * jnp.sin(beta), axis=-1)
    return AveragedForce(cosine / amplitude, -sine / (amplitude * frequency))
