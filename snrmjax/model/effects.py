"""Registry of effects by kind: those of the library and those registered by users."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from snrmjax.model.attachment import InfluenceVector, influence_vector, unit_at
from snrmjax.model.effect_base import AbstractEffect, AbstractForce
from snrmjax.model.effect_metadata import Entries
from snrmjax.model.library.damping import CubicDamping, QuadraticDamping, VanDerPolDamping
from snrmjax.model.library.free_laws import (
    AbstractLaw,
    DisplacementDampingLaw,
    StiffnessLaw,
)
from snrmjax.model.library.friction import CoulombFriction, IwanMicroslip, JenkinsSlider
from snrmjax.model.library.hysteresis import BoucWen, FrictionContact
from snrmjax.model.library.internal_resonances import (
    InternalResonanceOneToThree,
    InternalResonanceOneToTwo,
)
from snrmjax.model.library.joints import FourParameterIwan, RegularisedFriction, SpringLinkage
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
from snrmjax.numerics.compiled import keep_no_programs
from snrmjax.numerics.rules import InputError, require
from snrmjax.numerics.units import unit_in_print


class EffectTable(dict[str, type[AbstractEffect]]):
    """Effects by their kind. Prints as a table: kind, parameters with units, description."""

    further: Mapping[str, type[AbstractEffect]] = MappingProxyType({})  # printed below its own

    def __repr__(self) -> str:
        """One line for each effect, then for each element that only acts at points."""
        width = max((len(kind) for kind in (*self, *self.further)), default=0)

        def table(effects: Mapping[str, type[AbstractEffect]], at: InfluenceVector | None) -> str:
            lines = (
                f"{k:{width}}  {_parameters(e, at)}: {_description(e)}" for k, e in effects.items()
            )
            return "\n".join(line.rstrip() for line in lines)

        further = f"\n\nOnly at points, by `at`:\n{table(self.further, influence_vector('x'))}"
        return table(self, None) + (further if self.further else "")


def _parameters(effect: type[AbstractEffect], at: InfluenceVector | None) -> str:
    """Names of the parameters with their units at the attachment."""
    return ", ".join(
        f"{name} ({unit_in_print(unit_at(at, of.unit)) or 'no unit'})" if of.unit else name
        for name, of in effect.parameters().items()
    )


def _description(effect: type[AbstractEffect]) -> str:
    text = effect.description or effect.__doc__ or ""
    return text.strip().split("\n")[0]


EFFECTS: EffectTable = EffectTable(
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
"""The effects by their kind in files; `print(EFFECTS)` is a table of them."""

LAWS: dict[str, type[AbstractLaw]] = {
    law.kind: law for law in (StiffnessLaw, DisplacementDampingLaw)
}
"""Tabulated laws by their kind: identified from data where no effect of the library fits."""

ELEMENTS: dict[str, type[AbstractEffect]] = EffectTable(
    (element.kind, element)
    for element in (
        RegularisedFriction,
        SpringLinkage,
        FourParameterIwan,
        BoucWen,
        FrictionContact,
    )
)
"""Further nonlinear elements between points, by their kind; not hypotheses of a diagnosis."""

EFFECTS.further = ELEMENTS

_FORMER_KINDS = {"static_load": StaticPreload.kind}
_FURTHER_NAMES = {
    (StaticPreload.kind, "load"): "constant_force",
    (RegularisedFriction.kind, "force_limit"): "slip_force",
    # `force` in files and results, by their definition; `slip_force` as in all other friction.
    (CoulombFriction.kind, "slip_force"): "force",
}

SURFACES = (FrictionContact.kind,)
"""Kinds of elements with a normal (`normal_at`) and a tangential (`at`) attachment."""

# `help(EFFECTS)` shows the docstring of its class.
EffectTable.__doc__ = f"{EffectTable.__doc__}\n\n{EFFECTS!r}"


def register_effect(effect: type[AbstractEffect]) -> type[AbstractEffect]:
    """Register an effect of your own for files, simulations, calibrations and diagnoses.

    Use as a decorator of a class with a `kind`, parameters as fields and a force, whose
    derivatives must be finite, at rest too. What the class does not define (see `AbstractEffect`
    and `parameter`) is computed from its force, and it is treated like an effect of the library:

        @sj.model.register_effect
        class RootDamping(sj.model.AbstractMemoryless):
            kind: ClassVar[str] = "root_damping"
            description: ClassVar[str] = "Damping with the square root of the velocity."
            coefficient: Array = sj.model.parameter("(kg^1/2 m/s)^(1/2)/s", "root damping")

            def force(self, displacement, velocity):
                return self.coefficient * velocity / (velocity**2 + 1e-12) ** 0.25

    Returns the class. Raises `ValueError` for an existing kind and for a class without
    parameters.
    """
    if effect.kind in known_effects():
        raise InputError(f"an effect of the kind {effect.kind!r} is already registered.")
    if not effect.parameters():
        raise InputError(f"{effect.kind!r} must have a parameter: a field without a default.")
    keep_no_programs()  # they would not distinguish this class from a later one of its name
    EFFECTS[effect.kind] = effect
    return effect


def effect_class(kind: str) -> type[AbstractEffect]:
    """The class of a kind of effect, of an element or of a tabulated law.

    Raises `KeyError` for an unknown kind.
    """
    return known_effects()[kind]


def is_own(kind: str) -> bool:
    """Whether an effect was registered by a user."""
    return not effect_class(kind).__module__.startswith("snrmjax.")


def known_effects() -> dict[str, type[AbstractEffect]]:
    """All classes of effects by their kinds: `EFFECTS`, `ELEMENTS` and `LAWS`."""
    return {**EFFECTS, **ELEMENTS, **LAWS}


def effect_parameters(kind: str) -> tuple[str, ...]:
    """Names of the parameters of one kind of effect, in the order of its constructor."""
    return tuple(effect_class(kind).parameters())


def present_names(
    kind: str, entries: Mapping[str, Any], *, at_points: bool
) -> tuple[str, dict[str, Any]]:
    """A kind and its entries, of which former and further names are accepted.

    Raises `ValueError` for two names of one parameter, and for a former element of points alone
    on the mode of interest.

    >>> present_names("regularised_friction", {"force_limit": 2.0, "velocity": 0.1}, at_points=True)
    ('regularised_friction', {'slip_force': 2.0, 'velocity': 0.1})
    """
    if kind in _FORMER_KINDS and not at_points:
        raise InputError(f"{kind} acts at points only: state them by `at`.")
    kind = _FORMER_KINDS.get(kind, kind)
    named = {_FURTHER_NAMES.get((kind, name), name): value for name, value in entries.items()}
    if len(named) < len(entries):
        raise InputError(f"{kind} has two names of one parameter: {sorted(entries)}.")
    return kind, named


def make_effect(
    kind: str,
    parameters: Mapping[str, float | Array | np.ndarray],
    *,
    at: str | Mapping[str, float] | InfluenceVector | None = None,
    normal_at: str | Mapping[str, float] | InfluenceVector | None = None,
) -> AbstractEffect:
    """Build an effect from its kind and its parameters by name.

    `at` is where a force acts, with parameters in N and m: a point, an influence vector such as
    `between("tip", "root")`, or points with weights; without it on the mode of interest.
    `normal_at`, likewise, is the normal direction of a contact.

    Raises `ValueError` for an unknown kind, for an unknown, missing or non-finite parameter, for
    one out of its range (traced parameters are not checked), for tables of a law with fewer than
    two knots, different lengths or knots that do not ascend, and for `at` of an effect that is
    not a force.

    >>> drag = make_effect("quadratic_damping", {"coefficient": 2.0})
    >>> drag.cycle_force(jnp.array([1.0, 0.0]), jnp.array([0.0, -3.0]))
    Array([  0., -18.], dtype=float64)
    """
    kind, parameters = present_names(kind, parameters, at_points=at is not None)
    if kind not in known_effects():
        raise InputError(f"unknown effect kind {kind!r}; known are {sorted(known_effects())}.")
    wanted = effect_class(kind).parameters()
    if set(parameters) != set(wanted):
        raise InputError(f"{kind} takes the parameters {list(wanted)}, not {sorted(parameters)}.")
    for name, value in parameters.items():
        require(f"`{name}` of {kind}", value, *wanted[name].rules)
    arrays = {k: jnp.asarray(v, dtype=jnp.float64) for k, v in parameters.items()}
    _check_tables(kind, arrays)
    attachments = {"at": at, "normal_at": normal_at}
    given = {name: influence_vector(b) for name, b in attachments.items() if b is not None}
    if given and not issubclass(effect_class(kind), AbstractForce):
        raise InputError(f"{kind} is not a force: it cannot act at a point.")
    if normal_at is not None and kind not in SURFACES:
        raise InputError(f"{kind} has a single attachment: it takes no `normal_at`.")
    return effect_class(kind)(**arrays, **given)


def _check_tables(kind: str, arrays: Mapping[str, Array]) -> None:
    """Refuse tables of a law with wrong shapes or knots that do not ascend."""
    shape: tuple[int, ...] = ()
    for name, parameter in effect_class(kind).parameters().items():
        value = arrays[name]
        if parameter.entries is Entries.ONE:
            continue
        if value.ndim != 1 or value.shape[0] < 2:
            raise InputError(
                f"`{name}` of {kind} must be two numbers or more, one for every knot, but has the "
                f"shape {value.shape}."
            )
        if shape and value.shape != shape:
            raise InputError(
                f"`{name}` of {kind} must have {shape[0]} numbers, one for every knot, but has "
                f"{value.shape[0]}."
            )
        shape = value.shape
        if parameter.entries is Entries.KNOTS and not isinstance(value, jax.core.Tracer):
            steps = np.diff(np.asarray(value))
            if np.any(steps <= 0):
                first = int(np.argmax(steps <= 0))
                raise InputError(
                    f"`{name}` of {kind} must rise from knot to knot, but has "
                    f"{float(value[first + 1]):g} after {float(value[first]):g}."
                )
