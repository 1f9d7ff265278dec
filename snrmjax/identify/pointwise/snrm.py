"""The single nonlinear resonant mode function: one mode with amplitude-dependent properties."""

import jax.numpy as jnp
from jaxtyping import Array, Complex, Float

from snrmjax.model.modes import LinearModes, residual_velocity
from snrmjax.model.modes import reference_sensor as reference_sensor


def nonlinear_mode_velocity(
    modal_constant: Float[Array, "*batch"],
    natural_frequency: Float[Array, "*batch"],
    damping_ratio: Float[Array, "*batch"],
    frequency: Float[Array, "*batch"],
) -> Complex[Array, "*batch"]:
    """Velocity of the nonlinear mode, V = iΩA / (ω̃² − Ω² + 2iζ̃ω̃Ω).

    Arguments: `modal_constant` A = Φ_r Φᵀb F of one sensor in m/s² (its sign turns the phase by
    180°), frequencies in rad/s. Returns the phasor relative to the force, in m/s; differentiable.
    Reference: Kwarta & Allen, V^nl in Eq. (10b), turned by +90° (the paper forces with a sine).

    >>> nonlinear_mode_velocity(*jnp.array([6.0, 500.0, 0.01, 500.0])).real.round(6)
    Array(0.6, dtype=float64)
    """
    modal_constant, natural_frequency, damping_ratio, frequency = (
        jnp.asarray(of) for of in (modal_constant, natural_frequency, damping_ratio, frequency)
    )
    squares = natural_frequency**2 - frequency**2
    cross = 2 * damping_ratio * natural_frequency * frequency
    return 1j * frequency * modal_constant / (squares + 1j * cross)


def snrm_velocity(
    modes: LinearModes,
    natural_frequency: Float[Array, "*batch"],
    damping_ratio: Float[Array, "*batch"],
    frequency: Float[Array, "*batch"],
    force: Float[Array, "*batch"],
) -> Complex[Array, "*batch sensor"]:
    """The SNRM function: the nonlinear mode, the other linear modes and the rigid-body modes.

    Arguments: `natural_frequency` ω̃ and `damping_ratio` ζ̃ of the mode of interest at the
    amplitude of motion, `frequency` Ω in rad/s, `force` in N. Returns phasors relative to the
    force in m/s at every sensor; differentiable by all of them and by the modes. With the linear
    ω and ζ it is the linear response, Eq. (23).
    Valid for well-separated modes without internal resonance and a mode shape that does not
    change with amplitude. Reference: Kwarta & Allen, Eq. (10).
    """
    j = modes.mode_of_interest
    constant = modes.mode_shape[:, j] * (modes.participation[j] * jnp.asarray(force)[..., None])
    of_mode = nonlinear_mode_velocity(
        constant,
        jnp.asarray(natural_frequency)[..., None],
        jnp.asarray(damping_ratio)[..., None],
        jnp.asarray(frequency)[..., None],
    )
    return of_mode + residual_velocity(modes, frequency, force)
