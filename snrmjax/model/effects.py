"""Physical effects that a model may lack, each defined once: the forces without memory, and all.

Friction is in `friction`, changes of the linear terms in `linear_changes`, internal resonances in
`mode_coupling`, errors of force and instruments in `measurement_chain`. A memoryless effect acts
on the mode of interest: f(q, q̇) is added on the left of q̈ + 2ζω₀q̇ + ω₀²q + … = p, with q in
kg^1/2 m. Its describing function (`averaging`), its harmonic-balance residual and its Jacobian
all follow from that one definition.
"""

import dataclasses
from collections.abc import Mapping
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from snrmjax.model.effect_base import (
    AbstractEffect,
    AbstractKinked,
    AbstractMemoryless,
    Scalar,
    ramp,
)
from snrmjax.model.friction import CoulombFriction, IwanMicroslip, JenkinsSlider
from snrmjax.model.linear_changes import (
    AddedMass,
    FrequencyDrift,
    LinearDampingChange,
    LinearFrequencyShift,
)
from snrmjax.model.measurement_chain import (
    CloseMode,
    ForceGainError,
    ForceHarmonics,
    ForceOffsetError,
    ModeShapeChange,
    ResidualMode,
    SensorGainError,
    SensorPhaseError,
)
from snrmjax.model.mode_coupling import InternalResonanceOneToThree, InternalResonanceOneToTwo
from snrmjax.numerics.rules import NOT_NEGATIVE, Rule


class CubicStiffness(AbstractMemoryless):
    """f = a q³; raises ω̃² by ¾aQ²."""

    kind: ClassVar[str] = "cubic_stiffness"
    coefficient: Scalar

    def force(self, displacement: Scalar, velocity: Scalar) -> Scalar:
        """See `AbstractMemoryless.force`."""
        return self.coefficient * displacement**3


class QuadraticStiffness(AbstractMemoryless):
    """f = a q²; a mean displacement and a second harmonic, softening in second order."""

    kind: ClassVar[str] = "quadratic_stiffness"
    coefficient: Scalar

    def force(self, displacement: Scalar, velocity: Scalar) -> Scalar:
        """See `AbstractMemoryless.force`."""
        return self.coefficient * displacement**2


class QuinticStiffness(AbstractMemoryless):
    """f = a q⁵; raises ω̃² by ⅝aQ⁴."""

    kind: ClassVar[str] = "quintic_stiffness"
    coefficient: Scalar

    def force(self, displacement: Scalar, velocity: Scalar) -> Scalar:
        """See `AbstractMemoryless.force`."""
        return self.coefficient * displacement**5


class BilinearStiffness(AbstractKinked):
    """f = k|q|/2: stiffness differs by k between the two sides; even harmonics ∝ Q."""

    kind: ClassVar[str] = "bilinear_stiffness"
    stiffness: Scalar

    def rounded_force(self, displacement: Scalar, velocity: Scalar, width: Scalar) -> Scalar:
        """See `AbstractKinked.rounded_force`."""
        return 0.5 * self.stiffness * (ramp(displacement, width) + ramp(-displacement, width))


class GapStiffness(AbstractKinked):
    """A spring k that engages beyond ±gap; threshold and odd harmonics."""

    kind: ClassVar[str] = "gap_stiffness"
    rules: ClassVar[Mapping[str, tuple[Rule, ...]]] = {"gap": (NOT_NEGATIVE,)}
    stiffness: Scalar
    gap: Scalar

    def rounded_force(self, displacement: Scalar, velocity: Scalar, width: Scalar) -> Scalar:
        """See `AbstractKinked.rounded_force`."""
        above = ramp(displacement - self.gap, width)
        return self.stiffness * (above - ramp(-displacement - self.gap, width))


class OneSidedStop(AbstractKinked):
    """A spring k that engages beyond +gap; threshold and even harmonics."""

    kind: ClassVar[str] = "one_sided_stop"
    stiffness: Scalar
    gap: Scalar

    def rounded_force(self, displacement: Scalar, velocity: Scalar, width: Scalar) -> Scalar:
        """See `AbstractKinked.rounded_force`."""
        return self.stiffness * ramp(displacement - self.gap, width)


class QuadraticDamping(AbstractMemoryless):
    """f = c|q̇|q̇ (fluid drag); 2ζ̃ω̃ rises by 8cΩQ/3π."""

    kind: ClassVar[str] = "quadratic_damping"
    coefficient: Scalar

    def force(self, displacement: Scalar, velocity: Scalar) -> Scalar:
        """See `AbstractMemoryless.force`."""
        return self.coefficient * jnp.abs(velocity) * velocity


class CubicDamping(AbstractMemoryless):
    """f = c q̇³; 2ζ̃ω̃ rises by ¾cΩ²Q²."""

    kind: ClassVar[str] = "cubic_damping"
    coefficient: Scalar

    def force(self, displacement: Scalar, velocity: Scalar) -> Scalar:
        """See `AbstractMemoryless.force`."""
        return self.coefficient * velocity**3


class VanDerPolDamping(AbstractMemoryless):
    """f = c q²q̇; 2ζ̃ω̃ rises by cQ²/4."""

    kind: ClassVar[str] = "van_der_pol_damping"
    coefficient: Scalar

    def force(self, displacement: Scalar, velocity: Scalar) -> Scalar:
        """See `AbstractMemoryless.force`."""
        return self.coefficient * displacement**2 * velocity


class StaticPreload(AbstractMemoryless):
    """A constant force; with a cubic stiffness it shifts ω₀ and brings a second harmonic."""

    kind: ClassVar[str] = "static_preload"
    constant_force: Scalar

    def force(self, displacement: Scalar, velocity: Scalar) -> Scalar:
        """See `AbstractMemoryless.force`."""
        return jnp.broadcast_to(self.constant_force, jnp.shape(displacement))


EFFECTS: dict[str, type[AbstractEffect]] = {
    effect.kind: effect
    for effect in (
        LinearFrequencyShift,
        LinearDampingChange,
        CubicStiffness,
        QuadraticStiffness,
        QuinticStiffness,
        BilinearStiffness,
        GapStiffness,
        OneSidedStop,
        CoulombFriction,
        JenkinsSlider,
        IwanMicroslip,
        QuadraticDamping,
        CubicDamping,
        VanDerPolDamping,
        FrequencyDrift,
        AddedMass,
        ForceGainError,
        ForceOffsetError,
        SensorGainError,
        SensorPhaseError,
        InternalResonanceOneToThree,
        InternalResonanceOneToTwo,
        ResidualMode,
        CloseMode,
        ModeShapeChange,
        ForceHarmonics,
        StaticPreload,
    )
}
"""The effects by the kind that files give them."""


def register_effect(effect: type[AbstractEffect]) -> type[AbstractEffect]:
    """Make an effect of your own known to files, simulations, calibrations and diagnoses.

    Use as a decorator of a class with a `kind`, parameters as fields and a force. A diagnosis
    begins where the first parameter changes the motion plainly, with the others at what a class
    attribute `typical` gives (a mapping; 1 where it is silent).
    Raises `ValueError` for a kind that exists already.
    """
    if effect.kind in EFFECTS:
        raise ValueError(f"there is an effect of the kind {effect.kind!r} already.")
    EFFECTS[effect.kind] = effect
    return effect


def effect_parameters(kind: str) -> tuple[str, ...]:
    """Names of the parameters of one kind of effect, in the order of its constructor."""
    return tuple(
        field.name
        for field in dataclasses.fields(EFFECTS[kind])
        if field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING
    )


def make_effect(kind: str, parameters: Mapping[str, float | Array]) -> AbstractEffect:
    """Build an effect from its kind and its parameters by name.

    Raises `ValueError` for an unknown kind, for an unknown, a missing and a non-finite parameter,
    and for one out of its range (traced parameters are not looked at).

    >>> drag = make_effect("quadratic_damping", {"coefficient": 2.0})
    >>> drag.cycle_force(jnp.array([1.0, 0.0]), jnp.array([0.0, -3.0]))
    Array([  0., -18.], dtype=float64)
    """
    if kind not in EFFECTS:
        raise ValueError(f"unknown effect kind {kind!r}; known are {sorted(EFFECTS)}.")
    wanted = effect_parameters(kind)
    if set(parameters) != set(wanted):
        raise ValueError(f"{kind} takes the parameters {list(wanted)}, not {sorted(parameters)}.")
    for name, value in parameters.items():
        if isinstance(value, jax.core.Tracer):
            continue
        for entry in np.ravel(value).tolist():
            if not np.isfinite(entry):
                raise ValueError(f"`{name}` of {kind} must be finite, but is {entry}.")
            for rule in EFFECTS[kind].rules.get(name, ()):
                if not rule.good(entry):
                    raise ValueError(
                        f"`{name}` of {kind} must be {rule.expected}, but is {entry:g}."
                    )
    return EFFECTS[kind](**{k: jnp.asarray(v, dtype=jnp.float64) for k, v in parameters.items()})
