"""Reasons to doubt an answer that fits: what a law outside the library could do as well."""

from collections.abc import Iterator
from itertools import combinations
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from snrmjax.diagnose import priors
from snrmjax.diagnose.misfit.effect_fit import EffectFit
from snrmjax.diagnose.misfit.weighted_misfit import WeightedMisfit
from snrmjax.diagnose.search.locating import Located
from snrmjax.model.effect_base import AbstractForce, AbstractMemoryless
from snrmjax.model.effect_metadata import Imitation, Shape
from snrmjax.model.effect_shape import acts_like, shape_of
from snrmjax.model.effects import EFFECTS
from snrmjax.model.library.internal_resonances import AbstractInternalResonance
from snrmjax.numerics.facts import Fact


class Doubt(NamedTuple):
    """Why another law may explain the data as well, and what would separate them.

    Texts are those that an effect's class states.
    """

    reason: Fact | str
    decide_by: Fact | str
    refutes: bool = False
    identical: bool = False  # the other law changes all that was measured alike


WIDER = Fact("widen_levels")
"""The measurement that tells most laws apart."""


def doubts(
    effects: tuple[str, ...],
    located: tuple[Located, ...],
    orders: tuple[int, ...] = (),
    both_ways: frozenset[str] = frozenset(),
    own_power: float | None = None,
    feeding: frozenset[str] = frozenset(),
    wide: frozenset[str] = frozenset(),
) -> list[Doubt]:
    """Reasons to doubt the effects that were found.

    Arguments: `located` are the parts of the misfit before any effect was named; `orders` are the
    measured harmonics; `both_ways` are kinds of damping that by harmonic 2 act in both directions;
    `own_power` is the power of amplitude of one effect as fitted, which is that of its law to
    lowest order only; `feeding` are kinds of damping with a negative coefficient, which add
    energy; `wide` are internal resonances wider than the measured range (`wider_than_measured`).
    """
    found = []
    drags = [kind for kind in effects if is_drag(kind) and kind not in both_ways]
    if drags:
        record = Fact("record_second_harmonic", closer=2 in orders)
        found.append(Doubt(Fact("one_direction_alike", effect=drags[0]), record, identical=True))
    imitations = [imitation for kind in effects for imitation in EFFECTS[kind].imitations]
    found += [
        _doubt(imitation)
        for imitation in imitations
        if imitation.unless_harmonic not in (None, *orders)
    ]
    # Nothing passive adds energy: there is a source, whose law may be another one.
    silent = Fact("measure_without_feedback")
    found += [
        Doubt(Fact("adds_energy", effect=kind), silent, identical=True)
        for kind in effects
        if kind in feeding
    ]
    if len(effects) == 1:
        found += _of_exponent(effects[0], located, own_power)
    found += [
        _doubt(imitation)
        for imitation in imitations
        if imitation.unless_harmonic is None and imitation.near_power is None
    ]
    found += [
        Doubt(Fact("wider_than_measured", effect=kind), Fact("step_wider"))
        for kind in effects
        if kind in wide
    ]
    return found + list(_of_several(effects))


def _of_several(effects: tuple[str, ...]) -> Iterator[Doubt]:
    """What effects may stand for together."""
    if len(effects) > 2:
        yield Doubt(Fact("three_effects", effects=effects), WIDER)
    alike = [
        pair
        for pair in combinations(effects, 2)
        if acts_like(EFFECTS[pair[0]]) == acts_like(EFFECTS[pair[1]]) is not None
    ]
    if alike:
        yield Doubt(Fact("same_part_twice", effects=alike[0]), WIDER)
    elif len(effects) > 1 and any(_resonance(kind) for kind in effects):
        yield Doubt(Fact("further_mode_beside"), Fact("step_through_mode"))


def wider_than_measured(
    kind: str, shape: tuple[float, ...], frequency: Float[np.ndarray, " state"]
) -> bool:
    """Whether an internal resonance is wider than the range of frequencies measured.

    Arguments: the further mode's frequency in Hz and damping ratio; frequencies of states in rad/s.
    """
    resonance = _resonance(kind)
    if resonance is None:
        return False
    hz, ratio = shape
    width = 2 * ratio * hz / resonance.order  # half-power, as the force steps
    return width > float(np.ptp(frequency)) / (2 * np.pi)


def _doubt(one: Imitation) -> Doubt:
    return Doubt(one.reason, one.separated_by, identical=one.identical)


def _resonance(kind: str) -> type[AbstractInternalResonance] | None:
    """The internal resonance of a kind; None for other effects."""
    effect = EFFECTS[kind]
    return effect if issubclass(effect, AbstractInternalResonance) else None


def is_drag(kind: str) -> bool:
    """Whether an effect is a drag, which a valve may let act in one direction only."""
    shape = shape_of(EFFECTS[kind])
    return shape is not None and shape.is_drag


def grows(kind: str) -> bool:
    """Whether an effect is a damping that grows with amplitude, from a positive strength."""
    shape = shape_of(EFFECTS[kind])
    return shape is not None and shape.grows


def part_of(effects: tuple[str, ...]) -> str | None:
    """The part that a single force changes with a power of amplitude; None for others."""
    law = _power_law(effects[0]) if len(effects) == 1 else None
    return None if law is None else law.part


def _power_law(kind: str) -> Shape | None:
    """The shape of a force that changes one part with a power of amplitude; None for others."""
    shape = shape_of(EFFECTS[kind])
    force = issubclass(EFFECTS[kind], AbstractForce)
    return shape if force and shape is not None and shape.power is not None else None


def _of_exponent(effect: str, located: tuple[Located, ...], own_power: float | None) -> list[Doubt]:
    """The power of amplitude in the data, compared with that of the law that was named."""
    law = _power_law(effect)
    if law is None or law.power is None:
        return []
    part, expected = law.part, law.power if own_power is None else own_power
    measured = [p for p in located if p.part == part and p.exponent is not None]
    if not measured or measured[0].exponent is None or measured[0].exponent_std is None:
        return []
    exponent, std = measured[0].exponent, float(np.hypot(measured[0].exponent_std, 0.05))
    if abs(exponent - expected) > priors.CONTRADICTED * std:
        power = {"exponent": exponent, "exponent_std": std, "expected": expected}
        reason = Fact("other_power", effect=effect, part=part, **power)
        return [Doubt(reason, WIDER, refutes=True)]
    return [
        _doubt(imitation)
        for imitation in EFFECTS[effect].imitations
        if imitation.near_power is not None and abs(exponent - imitation.near_power) < 2 * std
    ]


def acts_both_ways(misfit: WeightedMisfit, fit: EffectFit, kind: str) -> bool:
    """Whether harmonic 2 excludes that a damping acts in one direction only.

    The force of such a one, such as c|q̇|ⁿ⁻¹q̇, has an even part c|q̇|ⁿ beside it.
    """
    chosen = misfit.predictions.chosen
    if not is_drag(kind) or 2 not in chosen.orders or chosen.phase_unknown.any():
        return False
    share, std = even_share(misfit, fit, kind)
    return abs(share) < 3 * std and abs(share) + 2 * std < 1


def even_share(misfit: WeightedMisfit, fit: EffectFit, kind: str) -> tuple[float, float]:
    """Ratio of a damping's even part to its odd part by harmonic 2, and its 1σ.

    To first order, (ω₀² − 4Ω² + 4iζω₀Ω) X₂ = −F₂, where F₂ is the second harmonic of the force
    f(|q̇|): c V²/2 for c|q̇|², with the modal velocity V.
    """
    states, modes = misfit.predictions.chosen.states, misfit.predictions.model.modes
    j, sensors = modes.mode_of_interest, misfit.predictions.chosen.sensors
    shape = float(modes.mode_shape[sensors[0], j])
    natural, ratio = modes.natural_frequency.item(j), modes.damping_ratio.item(j)
    omega = np.asarray(states.frequency)
    measured = np.asarray(states.velocity)[:, 0]
    velocity = measured / shape
    force = _second_harmonic(kind, fit.of_kind(kind), np.abs(velocity))
    force = force * (velocity / np.abs(velocity)) ** 2
    answer = -force / (natural**2 - 4 * omega**2 + 4j * ratio * natural * omega)
    column = 2j * omega * shape * answer / np.abs(measured)
    columns = np.zeros((1, *misfit.noise.known.shape))
    place = 2 * (len(sensors) + misfit.predictions.chosen.orders.index(2))
    columns[0, :, place], columns[0, :, place + 1] = column.real, column.imag
    arm = misfit.noise.decorrelated(misfit.noise.noise_units(columns)[0])
    basis = np.linalg.qr(misfit.noise.decorrelated(fit.slopes.T).T)[0]
    arm = arm - basis @ (basis.T @ arm)
    square = float(arm @ arm)
    if not square > 0:
        return 0.0, np.inf
    left = misfit.noise.decorrelated(fit.rows)
    return -float(arm @ left) / square, 1 / float(np.sqrt(square))


def _second_harmonic(
    kind: str, parameters: tuple[float, ...], speed: Float[np.ndarray, " state"]
) -> Float[np.ndarray, " state"]:
    """Cosine amplitude of harmonic 2 of a drag's force f(|q̇|) over q̇ = V cos β."""
    effect = EFFECTS[kind](*(jnp.asarray(value) for value in parameters))
    if not isinstance(effect, AbstractMemoryless):
        return np.zeros_like(speed)
    phase = 2 * np.pi * np.arange(256) / 256
    velocity = jnp.asarray(speed[:, None] * np.abs(np.cos(phase)))
    force = jax.vmap(jax.vmap(effect.force))(jnp.zeros_like(velocity), velocity)
    return 2 * np.mean(np.asarray(force) * np.cos(2 * phase), axis=1)
