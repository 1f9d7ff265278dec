"""What follows from a force by itself: its shape, a strength that is seen, and its drawing."""

from functools import lru_cache
from typing import NamedTuple

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
    own = _with_unit_strength(effect)
    phase = 2 * np.pi * np.arange(_SAMPLES) / _SAMPLES
    q = _AMPLITUDES[:, None] * np.cos(phase)
    v = -_AMPLITUDES[:, None] * _FREQUENCY * np.sin(phase)
    force = np.asarray(jax.vmap(own.cycle_force)(jnp.asarray(q), jnp.asarray(v)))
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
        own, jnp.asarray(_AMPLITUDES), jnp.asarray(_FREQUENCY), n_samples=_SAMPLES
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
    argument = _argument(own, q, v, force)
    return Shape(part, symmetry, argument, power, strength_order=order)


def _with_unit_strength(effect: type[AbstractForce]) -> AbstractForce:
    typical = [one.typical for one in effect.parameters().values()]
    return effect(*(jnp.asarray(value) for value in (1.0, *typical[1:])))


def _power(changes: Float[np.ndarray, " amplitude"]) -> float | None:
    powers = np.diff(np.log(changes)) / np.diff(np.log(_AMPLITUDES))
    return float(np.round(np.mean(powers), 3)) if np.ptp(powers) < _SAME_POWER else None


def _argument(own: AbstractForce, q: np.ndarray, v: np.ndarray, force: np.ndarray) -> Argument:
    if not isinstance(own, AbstractMemoryless):
        return Argument.HISTORY
    scale = _NOTHING * np.max(np.abs(force))

    def law(displacement: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        both = jnp.asarray(displacement), jnp.asarray(velocity)
        return np.asarray(jax.vmap(jax.vmap(own.force))(*both))

    nothing = np.zeros_like(q)
    if np.max(np.abs(law(q, nothing) - force)) <= scale:
        return Argument.DISPLACEMENT
    if np.max(np.abs(law(nothing, v) - force)) <= scale:
        return Argument.VELOCITY
    return Argument.BOTH


def starts_of(effect: type[AbstractEffect], scales: MotionScales) -> Starts:
    """Parameters from which a fit begins: those that the class states, or of a visible strength.

    A force that states none has its parameters at their typical values and the strength with
    which it changes the dynamic stiffness plainly; where it acts on the fundamental through other
    harmonics only, either sign. Other effects begin at their typical values.
    """
    if stated := effect.starts(scales):
        return stated
    typical = [one.typical for one in effect.parameters().values()]
    if not issubclass(effect, AbstractForce):
        return [tuple(typical)]
    first, *others = typical
    own = effect(*(jnp.asarray(value) for value in typical))
    shape = shape_of(effect)
    if shape is not None and shape.strength_order > 1:
        # As a quadratic stiffness softens: Δ(ω̃²) = −(5/6) (f/Q)²/ω₀².
        size = float(np.max(np.abs(sampled_law(own, scales.amplitude, scales.frequency).force)))
        strength = np.sqrt(1.2 * scales.change) * scales.frequency * scales.amplitude / size
        return [(float(sign * first * strength), *others) for sign in (1.0, -1.0)]
    at = (jnp.asarray(scales.amplitude), jnp.asarray(scales.frequency))
    change = averaged_effect(own, *at)
    size = float(jnp.hypot(change.stiffness, scales.frequency * change.damping))
    return [(first * (scales.change / size if size > 0 else 1.0), *others)]


def acts_like(effect: type[AbstractEffect]) -> str | None:
    """What an effect acts like: two effects alike may stand for one law that the library lacks.

    As its class states; forces that state nothing act like those that change the same part.
    """
    if effect.acts_like is not None or not issubclass(effect, AbstractForce):
        return effect.acts_like
    shape = shape_of(effect)
    return None if shape is None else shape.part


class SampledLaw(NamedTuple):
    """A force over one cycle of q = Q cos Ωt, as it is drawn."""

    argument: Argument  # against what it is drawn: displacement or velocity
    displacement: Float[np.ndarray, " time"]  # kg^1/2 m
    velocity: Float[np.ndarray, " time"]  # kg^1/2 m/s
    force: Float[np.ndarray, " time"]  # kg^1/2 m/s²

    @property
    def abscissa(self) -> Float[np.ndarray, " time"]:
        """The displacement or the velocity, whichever the force is drawn against."""
        return self.velocity if self.argument is Argument.VELOCITY else self.displacement


def sampled_law(
    effect: AbstractForce, amplitude: float, frequency: float, *, n_samples: int = _SAMPLES
) -> SampledLaw:
    """The force of an effect over one cycle, for a drawing of its law.

    Arguments: amplitude Q in kg^1/2 m and frequency Ω in rad/s of the motion q = Q cos Ωt.
    Friction is drawn as a loop over the displacement, damping over the velocity.

    >>> from snrmjax.model.effects import make_effect
    >>> law = sampled_law(make_effect("cubic_stiffness", {"coefficient": 2.0}), 1.0, 3.0)
    >>> law.argument, float(law.force.max())
    (<Argument.DISPLACEMENT: 'displacement'>, 2.0)
    """
    phase = 2 * np.pi * np.arange(n_samples) / n_samples
    q, v = amplitude * np.cos(phase), -amplitude * frequency * np.sin(phase)
    force = np.asarray(effect.cycle_force(jnp.asarray(q), jnp.asarray(v)))
    shape = shape_of(type(effect))
    drawn = None if shape is None else shape.drawn_against
    return SampledLaw(drawn or Argument.DISPLACEMENT, q, v, force)
