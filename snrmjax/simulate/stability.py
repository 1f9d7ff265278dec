"""Stability of periodic motions from the monodromy matrix of the linearised equations."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from snrmjax.model.structure import Structure


def steps_per_period(model: Structure, lowest_frequency: float) -> int:
    """Runge-Kutta steps over one period that resolve the fastest mode (32 per its cycle)."""
    ratio = float(np.max(np.asarray(model.modes.natural_frequency))) / lowest_frequency
    return max(128, 32 * int(np.ceil(ratio)))


@eqx.filter_jit
def floquet_multipliers(
    model: Structure,
    coefficients: Float[Array, "point coefficient mode"],
    frequency: Float[Array, " point"],
    n_steps: int,
) -> Complex[Array, "point multiplier"]:
    """Floquet multipliers of periodic motions: eigenvalues of the map over one period.

    Integrates δq̈ + C(t)δq̇ + K(t)δq = 0 by the classical fourth-order Runge-Kutta method with
    the tangent matrices along the motion. A motion is stable when all multipliers lie inside
    the unit circle.

    Arguments: Fourier coefficients (kg^1/2 m), `frequency` in rad/s, `n_steps` per period
    (static; see `steps_per_period`).
    """
    n, j = model.n_modes, model.modes.mode_of_interest
    harmonic_order = (coefficients.shape[1] - 1) // 2
    orders = jnp.arange(1, harmonic_order + 1)
    stiffness = jnp.diag(model.modes.natural_frequency**2)
    damping = jnp.diag(2 * model.modes.damping_ratio * model.modes.natural_frequency)

    def matrices(phase: Array) -> tuple[Array, Array]:
        """K and C (scaled to τ = Ωt) of all points at one phase."""
        cosine, sine = jnp.cos(orders * phase), jnp.sin(orders * phase)
        pairs = jnp.stack([cosine, sine], axis=1).reshape(-1)
        rates = jnp.stack([-orders * sine, orders * cosine], axis=1).reshape(-1)
        q = jnp.einsum("c,pcm->pm", jnp.append(1.0, pairs), coefficients)
        v = frequency[:, None] * jnp.einsum("c,pcm->pm", jnp.append(0.0, rates), coefficients)
        k = stiffness + model.tangent_stiffness(q, v)
        c = jnp.broadcast_to(damping, k.shape).at[:, j, j].add(model.tangent_damping(q, v))
        return k / frequency[:, None, None] ** 2, c / frequency[:, None, None]

    def slope(kc: tuple[Array, Array], state: Array) -> Array:
        q, v = state[:, :n], state[:, n:]
        return jnp.concatenate([v, -(kc[0] @ q) - kc[1] @ v], axis=1)

    step = 2 * jnp.pi / n_steps

    def advance(state: Array, k: Array) -> tuple[Array, None]:
        begin, middle, end = (matrices((k + s) * step) for s in (0.0, 0.5, 1.0))
        s1 = slope(begin, state)
        s2 = slope(middle, state + 0.5 * step * s1)
        s3 = slope(middle, state + 0.5 * step * s2)
        s4 = slope(end, state + step * s3)
        return state + step / 6 * (s1 + 2 * s2 + 2 * s3 + s4), None

    start = jnp.broadcast_to(jnp.eye(2 * n), (coefficients.shape[0], 2 * n, 2 * n))
    monodromy, _ = jax.lax.scan(advance, start, jnp.arange(n_steps))
    return jnp.linalg.eigvals(monodromy)


def is_stable(multipliers: Complex[Array, "point multiplier"]) -> Array:
    """Whether every multiplier lies inside the unit circle."""
    return jnp.max(jnp.abs(multipliers), axis=-1) < 1.0
