"""Natural frequency and damping of one mode by the method of averaging, for any force law."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Complex, Float

from snrmjax.model.effect_base import AbstractForce

ForceLaw = Callable[[Float[Array, ""], Float[Array, ""]], Float[Array, ""]]


class AveragedForce(NamedTuple):
    """Equivalent stiffness and damping of a force on a mode that moves as q = Q cos Ωt."""

    stiffness: Float[Array, "*batch"]  # Δ(ω̃²), 1/s²
    damping: Float[Array, "*batch"]  # Δ(2ζ̃ω̃), 1/s


def averaged_force(
    force: ForceLaw,
    amplitude: Float[Array, "*batch"],
    frequency: Float[Array, "*batch"],
    *,
    n_samples: int = 1024,
) -> AveragedForce:
    """Equivalent stiffness and damping of a force law over one cycle.

    Δ(ω̃²) = (1/πQ) ∮ f(Q cos β, −QΩ sin β) cos β dβ and
    Δ(2ζ̃ω̃) = −(1/πQΩ) ∮ f(Q cos β, −QΩ sin β) sin β dβ,
    by the trapezoidal rule, which converges exponentially for smooth f and with the square of
    the step for a continuous one.

    Arguments: `force` f(q, q̇) in kg^1/2 m/s²; `amplitude` Q in kg^1/2 m, not zero; `frequency`
    Ω in rad/s. Returns 1/s² and 1/s. First order in f: harmonics of the response are neglected.
    Differentiable by amplitude, frequency and what `force` depends on.
    Reference: Kwarta & Allen, Eqs. (9a) and (9b); (9b) as printed contradicts their Eq. (8) for
    linear damping and is corrected here, and (9a) is the first-order root of Δ(ω̃²).

    >>> drag = averaged_force(lambda q, v: 0.1 * v, jnp.array(2.0), jnp.array(3.0))
    >>> drag.damping.round(12)
    Array(0.1, dtype=float64)
    """
    # Half a step off zero, so that no sample falls on the turning points, where jumps sit.
    beta = 2 * jnp.pi * (jnp.arange(n_samples) + 0.5) / n_samples
    displacement = jnp.asarray(amplitude)[..., None] * jnp.cos(beta)
    velocity = -jnp.asarray(amplitude * frequency)[..., None] * jnp.sin(beta)
    flat = jax.vmap(force)(displacement.reshape(-1), velocity.reshape(-1))
    return _first_harmonic(flat.reshape(displacement.shape), beta, amplitude, frequency)


def averaged_effect(
    effect: AbstractForce,
    amplitude: Float[Array, "*batch"],
    frequency: Float[Array, "*batch"],
    *,
    n_samples: int = 512,
) -> AveragedForce:
    """Equivalent stiffness and damping of an effect over one steady cycle, with a memory or not.

    The integrals of `averaged_force` for q = Q cos Ωt, with the turning points among the samples;
    the error of friction falls with the square of the step.

    Arguments: `amplitude` Q in kg^1/2 m, not zero; `frequency` Ω in rad/s. Returns 1/s² and 1/s.
    First order in the force: harmonics of the response are neglected. Differentiable by all of
    them and by the effect's parameters.
    Reference: Kwarta & Allen, Eqs. (9a) and (9b), corrected as `averaged_force` says.

    >>> from snrmjax.model.effects import make_effect
    >>> slider = make_effect("jenkins_slider", {"stiffness": 9.0, "slip_displacement": 1.0})
    >>> averaged_effect(slider, jnp.array(2.0), jnp.array(3.0)).stiffness.round(2)
    Array(-4.5, dtype=float64)
    """
    amplitude, frequency = jnp.broadcast_arrays(jnp.asarray(amplitude), jnp.asarray(frequency))
    beta = 2 * jnp.pi * jnp.arange(n_samples) / n_samples
    displacement = amplitude.reshape(-1, 1) * jnp.cos(beta)
    velocity = -(amplitude * frequency).reshape(-1, 1) * jnp.sin(beta)
    values = jax.vmap(effect.cycle_force)(displacement, velocity)
    return _first_harmonic(values.reshape(*amplitude.shape, n_samples), beta, amplitude, frequency)


def _first_harmonic(
    force: Float[Array, "*batch time"],
    phase: Float[Array, " time"],
    amplitude: Float[Array, "*batch"],
    frequency: Float[Array, "*batch"],
) -> AveragedForce:
    cosine = 2.0 * jnp.mean(force * jnp.cos(phase), axis=-1)
    sine = 2.0 * jnp.mean(force * jnp.sin(phase), axis=-1)
    return AveragedForce(cosine / amplitude, -sine / (amplitude * frequency))


def averaged_response(
    natural_frequency: Float[Array, ""],
    damping_ratio: Float[Array, ""],
    force: ForceLaw,
    amplitude: Float[Array, "*batch"],
    frequency: Float[Array, "*batch"],
) -> Complex[Array, "*batch"]:
    """Modal force that is needed for q = Q cos Ωt, as a phasor relative to the displacement.

    P = Q [ω₀² + Δ(ω̃²) − Ω² + iΩ(2ζω₀ + Δ(2ζ̃ω̃))]: the complex form of Eq. (8).

    Arguments: `natural_frequency` and `frequency` in rad/s, `amplitude` in kg^1/2 m. Returns
    kg^1/2 m/s²; differentiable as `averaged_force` is.
    Reference: Kwarta & Allen, Eq. (8), with the phase of their Eq. (13).
    """
    average = averaged_force(force, amplitude, frequency)
    stiffness = natural_frequency**2 + average.stiffness
    damping = 2 * damping_ratio * natural_frequency + average.damping
    return amplitude * (stiffness - frequency**2 + 1j * frequency * damping)
