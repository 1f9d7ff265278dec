"""All effects by their kind: the library's and those that a user registers."""

from collections.abc import Mapping

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from snrmjax.model.effect_base import AbstractEffect
from snrmjax.model.library.damping import CubicDamping, QuadraticDamping, VanDerPolDamping
from snrmjax.model.library.friction import CoulombFriction, IwanMicroslip, JenkinsSlider
from snrmjax.model.library.internal_resonances import (
    InternalResonanceOneToThree,
    InternalResonanceOneToTwo,
)
from snrmjax.model.library.linear_changes import (
    AddedMass,
    FrequencyDrift,
    LinearDampingChange,
    LinearFrequencyShift,
)
from snrmjax.model.library.measurement_chain import (
    CloseMode,
    ForceGainError,
    ForceHarmonics,
    ForceOffsetError,
    ModeShapeChange,
    ResidualMode,
    SensorGainError,
    SensorPhaseError,
)
from snrmjax.model.library.stiffness import (
    BilinearStiffness,
    CubicStiffness,
    GapStiffness,
    OneSidedStop,
    QuadraticStiffness,
    QuinticStiffness,
    StaticPreload,
)


class EffectTable(dict[str, type[AbstractEffect]]):
    """Effects by their kind. It prints as a table: kind, parameters with units, description."""

    def __repr__(self) -> str:
        """One line for each effect."""
        return describe_effects(self)


def describe_effects(effects: Mapping[str, type[AbstractEffect]] | None = None) -> str:
    """A table of effects, one line each: kind, parameters with their units, description.

    Arguments: `effects` by kind, by default all of `EFFECTS`, with those that are registered.
    """
    every = EFFECTS if effects is None else effects
    if not every:
        return "no effects"
    rows = [(kind, _parameters_with_units(one), _description(one)) for kind, one in every.items()]
    width = max(len(kind) for kind, *_ in rows)
    return "\n".join(f"{kind:{width}}  {own}: {text}".rstrip() for kind, own, text in rows)


def _parameters_with_units(effect: type[AbstractEffect]) -> str:
    return ", ".join(
        f"{name} ({'no unit' if one.unit == '1' else one.unit})" if one.unit else name
        for name, one in effect.parameters().items()
    )


def _description(effect: type[AbstractEffect]) -> str:
    text = effect.description or effect.__doc__ or ""
    return text.strip().split("\n")[0]


EFFECTS: dict[str, type[AbstractEffect]] = EffectTable(
    (effect.kind, effect)
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
)
"""The effects by the kind that files give them; `print(EFFECTS)` is a table of them."""

# `help(EFFECTS)` shows the docstring of its class.
EffectTable.__doc__ = f"{EffectTable.__doc__}\n\n{describe_effects()}"


def register_effect(effect: type[AbstractEffect]) -> type[AbstractEffect]:
    """Make an effect of your own known to files, simulations, calibrations and diagnoses.

    Use as a decorator of a class with a `kind`, parameters as fields and a force, whose
    derivatives must be finite, at rest too. What the class does not state (see `AbstractEffect`
    and `parameter`) is computed from its force, and it is treated like an effect of the library
    wherever and whenever it is registered:

        @sj.model.register_effect
        class RootDamping(sj.model.AbstractMemoryless):
            kind: ClassVar[str] = "root_damping"
            description: ClassVar[str] = "Damping with the square root of the velocity."
            coefficient: Array = sj.model.parameter("(kg^1/2 m/s)^(1/2)/s", "root damping")

            def force(self, displacement, velocity):
                return self.coefficient * velocity / (velocity**2 + 1e-12) ** 0.25

    Returns the class. Raises `ValueError` for a kind that exists already and for a class without
    parameters.
    """
    if effect.kind in EFFECTS:
        raise ValueError(f"there is an effect of the kind {effect.kind!r} already.")
    if not effect.parameters():
        raise ValueError(f"{effect.kind!r} must have a parameter: a field without a default.")
    EFFECTS[effect.kind] = effect
    return effect


def effect_parameters(kind: str) -> tuple[str, ...]:
    """Names of the parameters of one kind of effect, in the order of its constructor."""
    return tuple(EFFECTS[kind].parameters())


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
    wanted = EFFECTS[kind].parameters()
    if set(parameters) != set(wanted):
        raise ValueError(f"{kind} takes the parameters {list(wanted)}, not {sorted(parameters)}.")
    for name, value in parameters.items():
        if isinstance(value, jax.core.Tracer):
            continue
        for entry in np.ravel(value).tolist():
            if not np.isfinite(entry):
                raise ValueError(f"`{name}` of {kind} must be finite, but is {entry}.")
            for rule in wanted[name].rules:
                if not rule.good(entry):
                    raise ValueError(
                        f"`{name}` of {kind} must be {rule.expected}, but is {entry:g}."
                    )
    return EFFECTS[kind](**{k: jnp.asarray(v, dtype=jnp.float64) for k, v in parameters.items()})
