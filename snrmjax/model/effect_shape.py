"""What follows from a force by itself: its shape, and the strength from which a fit begins."""

from functools import lru_cache

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from snrmjax.model.averaging import averaged_effect
from snrmjax.model.effect_base import AbstractEffect, AbstractForce, AbstractMemoryless, Starts
from snrmjax.model.effect_metadata import Argument, MotionScales, Part, Shape, Symmetry

_AMPLITUDES = np.logspace(-5, -1, 5)  # kg^1/2 m, at which a force is looked at
_FREQUENCY = 100.0  # rad/s, there
_SAMPLES = 256
_PHASE = 2 * np.pi * np.arange(_SAMPLES) / _SAMPLES
_NOTHING = 1e-8  # of a force's size: what rounding leaves of a part that is not there
_SAME_POWER = 1e-3  # by which powers between amplitudes may differ


def shape_of(effect: type[AbstractEffect]) -> Shape | None:
    """How an effect depends on amplitude: as its class states, or computed from its force.

    The computed one has the part, the symmetry and the argument of the force with unit strength
    and typical parameters, and its power of amplitude where that is the same from 1e-5 to
    1e-1 kg^1/2 m. Returns None for an effect that states nothing and is no force, or whose force
    is zero there.

    >>> from snrmjax.model.library.damping import CubicDamping
    >>> shape_of(CubicDamping).power
    2
    """
    if effect.shape is not None or not issubclass(effect, AbstractForce):
        return effect.shape
    return computed_shape(effect)


@lru_cache(maxsize=256)
def computed_shape(effect: type[AbstractForce]) -> Shape | None:
    """The shape that follows from a force alone, whatever the class states; see `shape_of`."""
    unit = _with_unit_strength(effect)
    q = _AMPLITUDES[:, None] * np.cos(_PHASE)
    v = -_AMPLITUDES[:, None] * _FREQUENCY * np.sin(_PHASE)
    force = np.asarray(jax.vmap(unit.cycle_force)(jnp.asarray(q), jnp.asarray(v)))
    size = np.max(np.abs(force), axis=1)
    if not np.all(np.isfinite(force)) or not np.any(size > 0):
        return None
    later = np.roll(force, _SAMPLES // 2, axis=1)  # at the reversed motion
    by_symmetry = {Symmetry.ODD: later + force, Symmetry.EVEN: later - force}
    symmetry = Symmetry.NEITHER
    for name, left in by_symmetry.items():
        if np.all(np.abs(left) <= _NOTHING * size[:, None]):
            symmetry = name
    average = averaged_effect(
        unit, jnp.asarray(_AMPLITUDES), jnp.asarray(_FREQUENCY), n_samples=_SAMPLES
    )
    changes = np.abs([average.stiffness, average.damping * _FREQUENCY])
    seen = changes > _NOTHING * size / _AMPLITUDES
    power, order = None, 1
    if seen.any(axis=1).all():
        part = Part.STIFFNESS_AND_DAMPING
    elif seen.any():
        number = int(np.argmax(seen.any(axis=1)))
        part = (Part.STIFFNESS, Part.DAMPING)[number]
        power = _power(changes[number]) if seen[number].all() else None
    else:  # the fundamental changes through other harmonics only
        part, order = Part.STIFFNESS, 2
    argument = _argument(unit, q, v)
    return Shape(part, symmetry, argument, power, strength_order=order)


def _with_unit_strength(effect: type[AbstractForce]) -> AbstractForce:
    typical = [parameter.typical for parameter in effect.parameters().values()]
    return effect(*(jnp.asarray(value) for value in (1.0, *typical[1:])))


def _power(changes: Float[np.ndarray, " amplitude"]) -> float | None:
    powers = np.diff(np.log(changes)) / np.diff(np.log(_AMPLITUDES))
    return float(np.round(np.mean(powers), 3)) if np.ptp(powers) < _SAME_POWER else None


def _argument(effect: AbstractForce, q: np.ndarray, v: np.ndarray) -> Argument:
    if not isinstance(effect, AbstractMemoryless):
        return Argument.HISTORY
    nothing, law = np.zeros_like(q), jax.vmap(jax.vmap(effect.force))
    states = ((q, v), (q, nothing), (nothing, v))
    both, of_q, of_v = (np.asarray(law(*(jnp.asarray(a) for a in state))) for state in states)
    scale = _NOTHING * np.max(np.abs(both))
    if np.max(np.abs(of_q - both)) <= scale:
        return Argument.DISPLACEMENT
    return Argument.VELOCITY if np.max(np.abs(of_v - both)) <= scale else Argument.BOTH


def starts_of(effect: type[AbstractEffect], scales: MotionScales) -> Starts:
    """Parameters from which a fit begins: those that the class states, or of a visible strength.

    A force that states none has its parameters at their typical values and the strength with
    which it changes the dynamic stiffness plainly; where it acts on the fundamental through other
    harmonics only, either sign. Other effects begin at their typical values.
    """
    if stated := effect.starts(scales):
        return stated
    typical = [parameter.typical for parameter in effect.parameters().values()]
    if not issubclass(effect, AbstractForce):
        return [tuple(typical)]
    first, *others = typical
    typical_effect = effect(*(jnp.asarray(value) for value in typical))
    shape = shape_of(effect)
    if shape is not None and shape.strength_order > 1:
        # As a quadratic stiffness softens: Δ(ω̃²) = −(5/6) (f/Q)²/ω₀².
        q = scales.amplitude * np.cos(_PHASE)
        v = -scales.amplitude * scales.frequency * np.sin(_PHASE)
        size = float(jnp.max(jnp.abs(typical_effect.cycle_force(jnp.asarray(q), jnp.asarray(v)))))
        strength = np.sqrt(1.2 * scales.change) * scales.frequency * scales.amplitude / size
        return [(float(sign * first * strength), *others) for sign in (1.0, -1.0)]
    at = (jnp.asarray(scales.amplitude), jnp.asarray(scales.frequency))
    change = averaged_effect(typical_effect, *at)
    size = float(jnp.hypot(change.stiffness, scales.frequency * change.damping))
    return [(first * (scales.change / size if size > 0 else 1.0), *others)]
