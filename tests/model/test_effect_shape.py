"""Metadata of effects against their forces and their dimensions."""

import re

import jax
import numpy as np
import pytest
from truths.kinds import dimension
from truths.own_effects import OwnAsymmetry, OwnDrag

from snrmjax.model.effect_base import AbstractForce
from snrmjax.model.effect_metadata import Argument, Part, Shape, Symmetry
from snrmjax.model.effect_shape import computed_shape, shape_of
from snrmjax.model.effects import EFFECTS, effect_parameters, make_effect

FORCES = [kind for kind, effect in EFFECTS.items() if issubclass(effect, AbstractForce)]


# Contacts have a typical gap of 1 kg^1/2 m, which no motion looked at reaches.
@pytest.mark.parametrize("kind", [k for k in FORCES if "gap" not in effect_parameters(k)])
def test_a_stated_shape_is_that_of_the_force(kind):
    effect = EFFECTS[kind]
    stated, result = effect.shape, computed_shape(effect)
    if kind == "jenkins_slider":  # nor does a slip displacement of 1
        assert result is None
        return
    # One cycle does not reveal internal variables, and a law of several orders has its own power.
    assert result.part == stated.part
    assert result.symmetry == stated.symmetry
    assert result.strength_order == stated.strength_order
    assert result.argument in (stated.argument, Argument.HISTORY)
    if stated.factor is not None:
        assert result.power == pytest.approx(stated.power, abs=1e-3)


@pytest.mark.parametrize("kind", EFFECTS)
def test_an_effect_is_described(kind):
    effect = EFFECTS[kind]
    assert re.fullmatch(r"[A-Z][^.]*\.", effect.description)  # one sentence
    assert kind not in effect.description
    for one in effect.parameters().values():
        assert one.unit
        assert one.meaning
    assert effect.shape is not None


@pytest.mark.parametrize("kind", FORCES)
def test_units_are_the_dimensions_of_the_force(kind):
    """In grams, inches and minutes the same parameters, converted, give the same force."""
    scale = np.log([1000.0, 39.37, 1 / 60])
    typical = {"exponent": 1.7, "gap": 3e-4, "slip_displacement": 3e-4}
    effect = EFFECTS[kind]
    values = {name: typical.get(name, 2.0) for name in effect.parameters()}
    other = {
        name: values[name] * np.exp(dimension(one.unit, 1.7) @ scale)
        for name, one in effect.parameters().items()
    }
    phase = 2 * np.pi * np.arange(64) / 64
    q, v = 1e-3 * np.cos(phase), -0.3 * np.sin(phase)
    length, time = np.exp(np.array([0.5, 1, 0]) @ scale), np.exp(scale[2])
    force = make_effect(kind, values).cycle_force(q, v)
    converted = make_effect(kind, other).cycle_force(length * q, length / time * v)
    # Rounding in powers of a hundred.
    np.testing.assert_allclose(converted, length / time**2 * np.asarray(force), rtol=1e-9)
    assert np.any(np.asarray(force) != 0)


def test_what_a_user_does_not_state_follows_from_the_force():
    drag, even = shape_of(OwnDrag), shape_of(OwnAsymmetry)
    assert drag == Shape(Part.DAMPING, Symmetry.ODD, Argument.VELOCITY, pytest.approx(0.5))
    assert drag.lowest_harmonic == 3
    wanted = Shape(Part.STIFFNESS, Symmetry.EVEN, Argument.DISPLACEMENT, strength_order=2)
    assert even == wanted
    assert even.lowest_harmonic == 2


def test_slopes_pass_through_effects_with_parameters():
    slope = jax.grad(lambda c: make_effect("cubic_damping", {"coefficient": c}).force(1.0, 2.0))
    assert slope(3.0) == 8.0
