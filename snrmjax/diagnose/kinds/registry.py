"""The hypothesis of a kind of effect, its starting values, and the effect at zero strength."""

import dataclasses
import warnings
from functools import lru_cache
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from snrmjax.diagnose.kinds.hypothesis import Hypothesis, Start
from snrmjax.diagnose.kinds.table import HYPOTHESES
from snrmjax.model.effect_base import AbstractEffect, AbstractForce
from snrmjax.model.effect_metadata import Entries, MotionScales
from snrmjax.model.effect_shape import averaged_effect, shape_of
from snrmjax.model.effects import effect_class, is_own
from snrmjax.numerics.rules import InputError

_FORMER = (
    *("confounders", "like_force_gain", "follows_force", "only_phase", "searched"),
    *("starts", "steps"),
)
_PHASE = 2 * np.pi * np.arange(256) / 256
Effect = TypeVar("Effect", bound=AbstractEffect)


def register_hypothesis(kind: str, hypothesis: Hypothesis) -> None:
    """State how a diagnosis looks for a registered effect of your own.

    Without it the first-order change, the starting values and the rest are computed from the force,
    and no other effect is known to give the same data:

        sj.diagnose.register_hypothesis(
            "root_damping",
            sj.diagnose.Hypothesis(
                confounders=(sj.diagnose.Confounder("record harmonic 3 at the largest level"),)
            ),
        )

    Raises `ValueError` for an effect of the library, and for an unknown kind.
    """
    try:
        own = is_own(kind)
    except KeyError:
        raise InputError(f"unknown effect kind {kind!r}: register the effect first.") from None
    if not own:
        raise InputError(f"the hypothesis of {kind!r}, an effect of the library, is fixed.")
    HYPOTHESES[kind] = hypothesis


def hypothesis_of(kind: str) -> Hypothesis:
    """What a diagnosis knows of a kind of effect."""
    if kind in HYPOTHESES:
        return HYPOTHESES[kind]
    if not is_own(kind):
        raise KeyError(f"{kind} has no row in HYPOTHESES of snrmjax/diagnose/kinds/table.py.")
    return _stated_by_class(effect_class(kind))


@lru_cache(maxsize=256)
def _stated_by_class(effect: type[AbstractEffect]) -> Hypothesis:
    """The hypothesis of a user's own effect, from attributes of its class as formerly."""
    stated = {name: getattr(effect, name) for name in _FORMER if hasattr(effect, name)}
    if stated:
        warnings.warn(
            f"{effect.__name__} states {', '.join(stated)} in its class: state them by "
            "`sj.diagnose.register_hypothesis`; the former way goes in the next release.",
            DeprecationWarning,
            stacklevel=3,
        )
    return Hypothesis(**stated)


def starts_of(kind: str, scales: MotionScales) -> list[Start]:
    """Starting values of a fit to measured states, of clearly visible strength.

    Those of the hypothesis, otherwise of the parameters (`Parameter.start`), otherwise typical
    values with the strength that changes the dynamic stiffness by `MotionScales.change`: from the
    shape's factor and power of amplitude or from the force itself, with either sign if it acts on
    the fundamental only through other harmonics. Effects that are no forces start from their
    typical values.
    """
    stated = hypothesis_of(kind).starts
    if stated is not None and (values := stated(scales)):
        return values
    effect = effect_class(kind)
    parameters = list(effect.parameters().values())
    if parameters[0].start is not None:
        return [tuple(of.start(scales) if of.start else of.typical for of in parameters)]
    first, *others = (parameter.typical for parameter in parameters)
    return [(strength, *others) for strength in _strengths(effect, (first, *others), scales)]


def _strengths(
    effect: type[AbstractEffect], typical: Start, scales: MotionScales
) -> tuple[float, ...]:
    """Strengths of a clearly visible change."""
    shape = shape_of(effect)
    if shape is not None and shape.factor is not None and shape.power is not None:
        per_strength = shape.factor * scales.amplitude**shape.power
        return (scales.change / (per_strength * scales.frequency**shape.frequency_power),)
    if not issubclass(effect, AbstractForce):
        return (typical[0],)
    force = effect(*(jnp.asarray(value) for value in typical))
    if shape is not None and shape.strength_order > 1:
        # As a quadratic stiffness softens: Δ(ω̃²) = −(5/6) (f/Q)²/ω₀².
        q = scales.amplitude * np.cos(_PHASE)
        v = -scales.amplitude * scales.frequency * np.sin(_PHASE)
        magnitude = float(jnp.max(jnp.abs(force.cycle_force(jnp.asarray(q), jnp.asarray(v)))))
        strength = np.sqrt(1.2 * scales.change) * scales.frequency * scales.amplitude / magnitude
        return float(typical[0] * strength), float(-typical[0] * strength)
    change = averaged_effect(force, jnp.asarray(scales.amplitude), jnp.asarray(scales.frequency))
    magnitude = float(jnp.hypot(change.stiffness, scales.frequency * change.damping))
    return (typical[0] * (scales.change / magnitude if magnitude > 0 else 1.0),)


def without_strength(kind: str, natural_frequency: float, damping_ratio: float) -> AbstractEffect:
    """The effect at zero strength, its other parameters at their typical values.

    Arguments: natural frequency (rad/s) and damping ratio of the mode of interest.
    """
    effect, idle = effect_class(kind), hypothesis_of(kind).idle
    if idle is not None:
        values = idle(natural_frequency, damping_ratio)
    else:
        values = (0.0, *[of.typical for of in effect.parameters().values()][1:])
    return effect(*jax.device_put([np.asarray(value) for value in values]))


def idle_effect(effect: Effect, natural_frequency: float, damping_ratio: float) -> Effect:
    """An effect of the same array shapes, at the same points, at zero strength.

    Arguments: see `without_strength`. A tabulated law has the same knots and zero values.
    """
    tables = [n for n, of in effect.parameters().items() if of.entries is Entries.VALUES]
    if tables:
        values = {name: 0.0 * getattr(effect, name) for name in tables}
    else:
        other = without_strength(effect.kind, natural_frequency, damping_ratio)
        values = {name: getattr(other, name) for name in effect.parameters()}
    return dataclasses.replace(effect, **values)
