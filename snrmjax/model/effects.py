"""Physical effects that a model may lack, each defined once by the force it exerts.

An effect acts on the mode of interest: f(q, q̇) is added on the left of
q̈ + 2ζω₀q̇ + ω₀²q + … = p, with q in kg^1/2 m. Its describing function (`averaging`), its
harmonic-balance residual and its Jacobian all follow from that one definition.
"""

import dataclasses
from abc import abstractmethod
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

Scalar = Float[Array, ""]


class AbstractEffect(eqx.Module):
    """One effect: its parameters are its fields, its physics is `force`."""

    kind: ClassVar[str]

    @abstractmethod
    def force(self, displacement: Scalar, velocity: Scalar) -> Scalar:
        """The force f(q, q̇) on the left of the modal equation, in kg^1/2 m/s²."""


class CubicStiffness(AbstractEffect):
    """f = a q³; raises ω̃² by ¾aQ²."""

    kind: ClassVar[str] = "cubic_stiffness"
    coefficient: Scalar

    def force(self, displacement: Scalar, velocity: Scalar) -> Scalar:
        """See `AbstractEffect.force`."""
        return self.coefficient * displacement**3


class QuadraticStiffness(AbstractEffect):
    """f = a q²; a mean displacement and a second harmonic, softening in second order."""

    kind: ClassVar[str] = "quadratic_stiffness"
    coefficient: Scalar

    def force(self, displacement: Scalar, velocity: Scalar) -> Scalar:
        """See `AbstractEffect.force`."""
        return self.coefficient * displacement**2


class QuinticStiffness(AbstractEffect):
    """f = a q⁵; raises ω̃² by ⅝aQ⁴."""

    kind: ClassVar[str] = "quintic_stiffness"
    coefficient: Scalar

    def force(self, displacement: Scalar, velocity: Scalar) -> Scalar:
        """See `AbstractEffect.force`."""
        return self.coefficient * displacement**5


class BilinearStiffness(AbstractEffect):
    """f = k|q|/2: stiffness differs by k between the two sides; even harmonics ∝ Q."""

    kind: ClassVar[str] = "bilinear_stiffness"
    stiffness: Scalar

    def force(self, displacement: Scalar, velocity: Scalar) -> Scalar:
        """See `AbstractEffect.force`."""
        return 0.5 * self.stiffness * jnp.abs(displacement)


class GapStiffness(AbstractEffect):
    """A spring k that engages beyond ±gap; threshold and odd harmonics."""

    kind: ClassVar[str] = "gap_stiffness"
    stiffness: Scalar
    gap: Scalar

    def force(self, displacement: Scalar, velocity: Scalar) -> Scalar:
        """See `AbstractEffect.force`."""
        beyond = jnp.maximum(jnp.abs(displacement) - self.gap, 0.0)
        return self.stiffness * beyond * jnp.sign(displacement)


class OneSidedStop(AbstractEffect):
    """A spring k that engages beyond +gap; threshold and even harmonics."""

    kind: ClassVar[str] = "one_sided_stop"
    stiffness: Scalar
    gap: Scalar

    def force(self, displacement: Scalar, velocity: Scalar) -> Scalar:
        """See `AbstractEffect.force`."""
        return self.stiffness * jnp.maximum(displacement - self.gap, 0.0)


class QuadraticDamping(AbstractEffect):
    """f = c|q̇|q̇ (fluid drag); 2ζ̃ω̃ rises by 8cΩQ/3π."""

    kind: ClassVar[str] = "quadratic_damping"
    coefficient: Scalar

    def force(self, displacement: Scalar, velocity: Scalar) -> Scalar:
        """See `AbstractEffect.force`."""
        return self.coefficient * jnp.abs(velocity) * velocity


class CubicDamping(AbstractEffect):
    """f = c q̇³; 2ζ̃ω̃ rises by ¾cΩ²Q²."""

    kind: ClassVar[str] = "cubic_damping"
    coefficient: Scalar

    def force(self, displacement: Scalar, velocity: Scalar) -> Scalar:
        """See `AbstractEffect.force`."""
        return self.coefficient * velocity**3


class VanDerPolDamping(AbstractEffect):
    """f = c q²q̇; 2ζ̃ω̃ rises by cQ²/4."""

    kind: ClassVar[str] = "van_der_pol_damping"
    coefficient: Scalar

    def force(self, displacement: Scalar, velocity: Scalar) -> Scalar:
        """See `AbstractEffect.force`."""
        return self.coefficient * displacement**2 * velocity


class StaticPreload(AbstractEffect):
    """A constant force; with a cubic stiffness it shifts ω₀ and brings a second harmonic."""

    kind: ClassVar[str] = "static_preload"
    constant_force: Scalar

    def force(self, displacement: Scalar, velocity: Scalar) -> Scalar:
        """See `AbstractEffect.force`."""
        return jnp.broadcast_to(self.constant_force, jnp.shape(displacement))


EFFECTS: dict[str, type[AbstractEffect]] = {
    effect.kind: effect
    for effect in (
        CubicStiffness,
        QuadraticStiffness,
        QuinticStiffness,
        BilinearStiffness,
        GapStiffness,
        OneSidedStop,
        QuadraticDamping,
        CubicDamping,
        VanDerPolDamping,
        StaticPreload,
    )
}
"""The effects that simulate, by the kind that files give them."""

DECLARED_EFFECTS: frozenset[str] = frozenset(
    {
        "linear_frequency_shift",
        "linear_damping_change",
        "coulomb_friction",
        "jenkins_slider",
        "iwan_microslip",
        "frequency_drift",
        "added_mass",
        "force_gain_error",
        "force_offset_error",
        "sensor_gain_error",
        "sensor_phase_error",
        "internal_resonance_1_3",
        "internal_resonance_1_2",
        "residual_mode",
        "mode_shape_change",
        "force_harmonics",
    }
)
"""Kinds whose names are reserved by the file format but that this version cannot simulate."""


def effect_parameters(kind: str) -> tuple[str, ...]:
    """Names of the parameters of one kind of effect, in the order of its constructor."""
    return tuple(field.name for field in dataclasses.fields(EFFECTS[kind]))


def make_effect(kind: str, parameters: dict[str, float]) -> AbstractEffect:
    """Build an effect from its kind and its parameters by name.

    Raises `ValueError` for an unknown kind, for an unknown, a missing and a non-finite parameter.

    >>> make_effect("cubic_stiffness", {"coefficient": 2.0}).force(jnp.array(3.0), jnp.array(0.0))
    Array(54., dtype=float64)
    """
    if kind not in EFFECTS:
        raise ValueError(f"unknown effect kind {kind!r}; known are {sorted(EFFECTS)}.")
    wanted = effect_parameters(kind)
    if set(parameters) != set(wanted):
        raise ValueError(f"{kind} takes the parameters {list(wanted)}, not {sorted(parameters)}.")
    for name, value in parameters.items():
        if not isinstance(value, jax.Array) and not np.isfinite(value):
            raise ValueError(f"`{name}` of {kind} must be finite, but is {value}.")
    return EFFECTS[kind](**{k: jnp.asarray(v, dtype=jnp.float64) for k, v in parameters.items()})
