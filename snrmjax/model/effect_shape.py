"""How an effect depends on amplitude, as declared or computed from its force alone.

Natural frequency and damping of one mode are by the method of averaging.
"""

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from snrmjax.model.effect_base import AbstractEffect, AbstractForce, AbstractMemoryless
from snrmjax.model.effect_metadata import Argument, Part, Shape, Symmetry

_AMPLITUDES = np.logspace(-5, -1, 5)  # kg^1/2 m, at which a force is evaluated
_FREQUENCY = 100.0  # rad/s, there
_SAMPLES = 256
_PHASE = 2 * np.pi * np.arange(_SAMPLES) / _SAMPLES
_ROUNDING = 1e-8  # of a force's amplitude, below which a component counts as zero
_SAME_POWER = 1e-3  # permitted spread of the powers between amplitudes


class AveragedForce(NamedTuple):
    """Equivalent stiffness and damping of a force on a mode that moves as q = Q cos Ωt."""

    stiffness: Float[Array, "*batch"]  # Δ(ω̃²), 1/s²
    damping: Float[Array, "*batch"]  # Δ(2ζ̃ω̃), 1/s


def averaged_effect(
    effect: AbstractForce,
    amplitude: Float[Array, "*batch"],
    frequency: Float[Array, "*batch"],
    *,
    n_samples: int = 512,
) -> AveragedForce:
    """Equivalent stiffness and damping of an effect over one steady cycle, hysteretic or not.

    Δ(ω̃²) = (1/πQ) ∮ f(Q cos β, −QΩ sin β) cos β dβ and
    Δ(2ζ̃ω̃) = −(1/πQΩ) ∮ f(Q cos β, −QΩ sin β) sin β dβ,
    by the trapezoidal rule, which converges exponentially for smooth f and with the square of
    the step for a continuous one and for friction.

    Arguments: `amplitude` Q in kg^1/2 m, not zero; `frequency` Ω in rad/s. Returns 1/s² and 1/s.
    First order in the force: harmonics of the response are neglected. Differentiable with respect
    to all arguments and the effect's parameters.
    Reference: Kwarta & Allen, Eqs. (9a) and (9b); (9b) as printed contradicts their Eq. (8) for
    linear damping and is corrected here, and (9a) is the first-order root of Δ(ω̃²).

    >>> from snrmjax.model.effects import make_effect
    >>> slider = make_effect("jenkins_slider", {"stiffness": 9.0, "slip_displacement": 1.0})
    >>> averaged_effect(slider, jnp.array(2.0), jnp.array(3.0)).stiffness.round(2)
    Array(-4.5, dtype=float64)
    """
    amplitude, frequency = jnp.broadcast_arrays(jnp.asarray(amplitude), jnp.asarray(frequency))
    beta = 2 * jnp.pi * jnp.arange(n_samples) / n_samples
    displacement = amplitude.reshape(-1, 1) * jnp.cos(beta)
    velocity = -(amplitude * frequency).reshape(-1, 1) * jnp.sin(beta)
    force = jax.vmap(effect.cycle_force)(displacement, velocity)
    force = force.reshape(*amplitude.shape, n_samples)
    cosine = 2.0 * jnp.mean(force * jnp.cos(beta), axis=-1)
    sine = 2.0 * jnp.mean(force * jnp.sin(beta), axis=-1)
    return AveragedForce(cosine / amplitude, -sine / (amplitude * frequency))


def shape_of(effect: type[AbstractEffect]) -> Shape | None:
    """How an effect depends on amplitude: as declared by its class, or computed from its force.

    The computed one has the part, the symmetry and the argument of the force with unit strength
    and typical parameters, and its power of amplitude if that is constant from 1e-5 to
    1e-1 kg^1/2 m. Returns None for an effect without a declared shape that is not a force, or
    whose force is zero there.

    >>> from snrmjax.model.library.damping import CubicDamping
    >>> shape_of(CubicDamping).power
    2
    """
    if effect.shape is not None or not issubclass(effect, AbstractForce):
        return effect.shape
    return computed_shape(effect)


@lru_cache(maxsize=256)
def computed_shape(effect: type[AbstractForce]) -> Shape | None:
    """The shape computed from the force, whatever the class declares; see `shape_of`."""
    unit = _with_unit_strength(effect)
    q = _AMPLITUDES[:, None] * np.cos(_PHASE)
    v = -_AMPLITUDES[:, None] * _FREQUENCY * np.sin(_PHASE)
    force = np.asarray(jax.vmap(unit.cycle_force)(jnp.asarray(q), jnp.asarray(v)))
    magnitude = np.max(np.abs(force), axis=1)
    if not np.all(np.isfinite(force)) or not np.any(magnitude > 0):
        return None
    later = np.roll(force, _SAMPLES // 2, axis=1)  # at the reversed motion
    by_symmetry = {Symmetry.ODD: later + force, Symmetry.EVEN: later - force}
    symmetry = Symmetry.NEITHER
    for name, remainder in by_symmetry.items():
        if np.all(np.abs(remainder) <= _ROUNDING * magnitude[:, None]):
            symmetry = name
    average = averaged_effect(
        unit, jnp.asarray(_AMPLITUDES), jnp.asarray(_FREQUENCY), n_samples=_SAMPLES
    )
    changes = np.abs([average.stiffness, average.damping * _FREQUENCY])
    visible = changes > _ROUNDING * magnitude / _AMPLITUDES
    power, order = None, 1
    if visible.any(axis=1).all():
        part = Part.STIFFNESS_AND_DAMPING
    elif visible.any():
        number = int(np.argmax(visible.any(axis=1)))
        part = (Part.STIFFNESS, Part.DAMPING)[number]
        power = _power(changes[number]) if visible[number].all() else None
    else:  # the fundamental changes through other harmonics only
        part, order = Part.STIFFNESS, 2
    argument = _argument(unit, q, v)
    return Shape(part, symmetry, argument, power, strength_order=order)


def conservative_effects(effects: Sequence[AbstractEffect]) -> tuple[AbstractEffect, ...]:
    """Those effects that dissipate nothing: neither friction nor forces that depend on velocity."""

    def is_elastic(effect: AbstractForce) -> bool:
        with jax.ensure_compile_time_eval():
            shape = shape_of(type(effect))
        by_displacement = shape is not None and shape.argument is Argument.DISPLACEMENT
        return isinstance(effect, AbstractMemoryless) and by_displacement

    return tuple(e for e in effects if not isinstance(e, AbstractForce) or is_elastic(e))


def _with_unit_strength(effect: type[AbstractForce]) -> AbstractForce:
    typical = [parameter.typical for parameter in effect.parameters().values()]
    return effect(*(jnp.asarray(value) for value in (1.0, *typical[1:])))


def _power(changes: Float[np.ndarray, " amplitude"]) -> float | None:
    powers = np.diff(np.log(changes)) / np.diff(np.log(_AMPLITUDES))
    return float(np.round(np.mean(powers), 3)) if np.ptp(powers) < _SAME_POWER else None


def _argument(effect: AbstractForce, q: np.ndarray, v: np.ndarray) -> Argument:
    if not isinstance(effect, AbstractMemoryless):
        return Argument.HISTORY
    zero, law = np.zeros_like(q), jax.vmap(jax.vmap(effect.force))
    states = ((q, v), (q, zero), (zero, v))
    both, of_q, of_v = (np.asarray(law(*(jnp.asarray(a) for a in state))) for state in states)
    scale = _ROUNDING * np.max(np.abs(both))
    if np.max(np.abs(of_q - both)) <= scale:
        return Argument.DISPLACEMENT
    return Argument.VELOCITY if np.max(np.abs(of_v - both)) <= scale else Argument.BOTH
