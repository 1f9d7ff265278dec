"""The single nonlinear resonant mode function: one mode with amplitude-dependent properties.

With damping coupling C between the modes, eliminating all others o leaves for the mode j, at
s = iΩ:

  (f(s) + N) q_j = (p_j − s C_jo D_oo⁻¹ p_o) F,   f = D_jj − s² C_jo D_oo⁻¹ C_oj,
  V_s = s (Φ_sj − s Φ_so D_oo⁻¹ C_oj) q_j + s Φ_so D_oo⁻¹ p_o F,

where D is the modal dynamic stiffness, N the contribution of the nonlinear elements, and p the
participations, complex for a force with phases. With f = κ(s)·(s² + 2ζ̃₀ω̃₀s + ω̃₀²), of which ω̃₀
and ζ̃₀ are those of the eigenvalue of the linear structure, the left side divided by κ is that of
one mode again. Its ω̃ and ζ̃ are those of the complex mode: exact for a linear structure at every
frequency, and to first order in the coupling for the nonlinear elements.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from snrmjax.model.modes import LinearModes, dynamic_stiffness, phasor_of_load, residual_velocity
from snrmjax.model.modes import reference_sensor as reference_sensor
from snrmjax.numerics.compiled import compiled

_STEPS = 20  # of Newton's method, from the uncoupled mode
_AT_THE_POLE = 1e-6  # relative distance of Ω from a pole within which κ is evaluated next to it


class SensedMode(NamedTuple):
    """Effective shape and participation of the mode of interest under damping coupling.

    Factors, all one for modal damping and a force without phases: the mode's velocity at a sensor
    is Φ q times `seen`, its participation that of `participation_of` times `driven`.
    """

    seen: Complex[Array, "*batch sensor"] | float
    driven: Complex[Array, "*batch"] | float

    @property
    def phase_factor(self) -> Any:
        """Unit factor that makes a velocity relative to the phase of the effective force."""
        return jnp.conj(self.driven) / jnp.abs(self.driven)

    @property
    def ratio(self) -> Any:
        """Magnitude of the effective participation over `participation_of`."""
        return jnp.abs(self.driven)

    def to_mode(self, sensor: int) -> Any:
        """Factor from a sensor's velocity, without residual modes, to the mode's own velocity.

        Relative to the phase of the effective force.
        """
        return self.phase_factor / (
            self.seen if isinstance(self.seen, float) else self.seen[..., sensor]
        )


def is_single(modes: LinearModes) -> bool:
    """Whether neither damping couples the modes nor a force has phases."""
    return modes.damping_coupling is None and modes.participation_lag is None


def participation_of(modes: LinearModes) -> Float[Array, ""]:
    """Φᵀb of the mode of interest in kg^-1/2; for a force with phases its magnitude, with the sign
    of the in-phase part.
    """
    own = modes.participation[modes.mode_of_interest]
    if modes.participation_lag is None:
        return own
    sine = modes.participation_lag[modes.mode_of_interest]
    return jnp.where(own < 0, -1.0, 1.0) * jnp.hypot(own, sine)


def linear_mode(modes: LinearModes) -> tuple[Any, Any]:
    """Natural frequency (rad/s) and damping ratio of the mode of interest of the linear structure.

    Those of the eigenvalue λ, |λ| and −Re λ/|λ|, where damping couples the modes.
    """
    j = modes.mode_of_interest
    if modes.damping_coupling is None:
        return modes.natural_frequency[j], modes.damping_ratio[j]
    return _eigenvalue(modes)


def sensed_mode(
    modes: LinearModes, frequency: Float[Array | np.ndarray, "*batch"] | float
) -> SensedMode:
    """Effective shape and participation of the mode of interest at frequencies in rad/s."""
    return SensedMode(1.0, 1.0) if is_single(modes) else SensedMode(*_sensed(modes, frequency))


class _Eliminated(NamedTuple):
    """f(s), effective shape and effective participation at one s."""

    stiffness: Complex[Array, ""]
    shape: Complex[Array, " sensor"]
    participation: Complex[Array, ""]


def _eliminated(modes: LinearModes, s: Complex[Array, ""]) -> _Eliminated:
    j, keep = modes.mode_of_interest, np.asarray(modes.residual_modes, dtype=int)
    load, shape = phasor_of_load(modes), modes.mode_shape
    whole = dynamic_stiffness(modes, np.arange(modes.n_modes), s)
    if not keep.size or modes.damping_coupling is None:
        return _Eliminated(whole[j, j], shape[:, j] + 0j, load[j])
    right = jnp.stack([whole[keep, j], load[keep]], axis=1)
    moved, driven = jnp.linalg.solve(whole[np.ix_(keep, keep)], right).T
    return _Eliminated(
        whole[j, j] - whole[j, keep] @ moved,
        shape[:, j] - shape[:, keep] @ moved,
        load[j] - whole[j, keep] @ driven,
    )


@compiled
def _eigenvalue(modes: LinearModes) -> tuple[Array, Array]:
    j = modes.mode_of_interest
    natural, ratio = modes.natural_frequency[j], modes.damping_ratio[j]

    def step(_: int, s: Array) -> Array:
        value, slope = jax.jvp(lambda s: _eliminated(modes, s).stiffness, (s,), (s,))
        return s - s * value / slope

    start = natural * (-ratio + 1j * jnp.sqrt(1 - ratio**2))
    pole = jax.lax.fori_loop(0, _STEPS, step, start)
    return jnp.abs(pole), -pole.real / jnp.abs(pole)


@compiled
def _sensed(modes: LinearModes, frequency: Array) -> tuple[Array, Array]:
    omega = jnp.asarray(frequency)
    natural, ratio = linear_mode(modes)
    near = jnp.abs(omega**2 - natural**2) + ratio * natural * omega < _AT_THE_POLE * omega**2
    # κ is smooth: where numerator and denominator vanish it is evaluated next to the pole.
    s = 1j * omega * jnp.where(near, 1 + 2 * _AT_THE_POLE, 1.0)
    one = jnp.vectorize(lambda s: tuple(_eliminated(modes, s)), signature="()->(),(s),()")
    stiffness, shape, participation = one(s)
    kappa = stiffness / (s**2 + 2 * ratio * natural * s + natural**2)
    own = modes.mode_shape[:, modes.mode_of_interest]
    # At a node of the mode the factor is undefined: left at one.
    still = own == 0
    seen = jnp.where(still, 1.0, shape / jnp.where(still, 1.0, own))
    return seen, participation / (kappa * participation_of(modes))


def nonlinear_mode_velocity(
    modal_constant: Float[Array, "*batch"],
    natural_frequency: Float[Array, "*batch"],
    damping_ratio: Float[Array, "*batch"],
    frequency: Float[Array, "*batch"],
) -> Complex[Array, "*batch"]:
    """Velocity of the nonlinear mode, V = iΩA / (ω̃² − Ω² + 2iζ̃ω̃Ω).

    Arguments: `modal_constant` A = Φ_r Φᵀb F of one sensor in m/s² (negative: a phase
    of 180°), frequencies in rad/s. Returns the phasor relative to the force in m/s; differentiable.
    Reference: Kwarta & Allen, V^nl in Eq. (10b), rotated by +90° (the paper forces with a sine).

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
    force in m/s at every sensor; differentiable by all of them and by the modes. With those of
    `linear_mode` it is the linear response, Eq. (23).
    Valid for well-separated modes without internal resonance and a mode shape that does not
    change with amplitude. Reference: Kwarta & Allen, Eq. (10).
    """
    j = modes.mode_of_interest
    constant = modes.mode_shape[:, j] * (participation_of(modes) * jnp.asarray(force)[..., None])
    sensed = sensed_mode(modes, frequency)
    if not is_single(modes):
        constant = constant * sensed.seen * jnp.asarray(sensed.driven)[..., None]
    of_mode = nonlinear_mode_velocity(
        constant,
        jnp.asarray(natural_frequency)[..., None],
        jnp.asarray(damping_ratio)[..., None],
        jnp.asarray(frequency)[..., None],
    )
    return of_mode + residual_velocity(modes, frequency, force)
