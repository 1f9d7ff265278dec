"""Effects as users give them to a structure: with plain numbers, singly, or as a class."""

from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import pytest

import snrmjax as sj
from snrmjax.model.effect_base import AbstractMemoryless, Scalar
from snrmjax.model.effects import EFFECTS, ELEMENTS, make_effect


class ThreeHalvesDamping(AbstractMemoryless):
    """A user's effect, whose parameter is nothing but an annotation."""

    kind: ClassVar[str] = "three_halves_damping_of_a_user"
    coefficient: jax.Array

    def force(self, displacement: Scalar, velocity: Scalar) -> Scalar:
        """See `AbstractMemoryless.force`."""
        return self.coefficient * velocity * (velocity**2 + 1e-12) ** 0.25


def modes():
    return sj.model.linear_modes([100.0], [0.01], [[1.0]], [1.0], sensors=("tip",))


@pytest.mark.parametrize("effect", [EFFECTS["quadratic_damping"], ThreeHalvesDamping])
def test_parameters_may_be_plain_numbers(effect):
    plain = sj.model.structure(modes(), effects=(effect(2.0),))
    whole = sj.model.structure(modes(), effects=(effect(2),))
    same = sj.model.structure(modes(), effects=(effect(jnp.asarray(2.0)),))
    assert plain.effects[0].coefficient.dtype == whole.effects[0].coefficient.dtype == jnp.float64
    assert eqx.tree_equal(plain, whole, same)
    assert sj.model.parameter_values(plain)[f"{effect.kind}.coefficient"] == 2.0


def test_traced_parameters_pass():
    def strength(value):
        model = sj.model.structure(modes(), effects=ThreeHalvesDamping(value))
        return model.effects[0].force(jnp.zeros(()), jnp.asarray(4.0))

    assert float(jax.jit(jax.grad(strength))(2.0)) == pytest.approx(8.0)


def test_one_effect_is_a_tuple_of_one():
    drag = make_effect("quadratic_damping", {"coefficient": 2.0})
    assert sj.model.structure(modes(), effects=drag).effects == (drag,)


def test_a_class_and_what_is_no_effect_are_refused_by_name():
    for given in (EFFECTS["quadratic_damping"], [EFFECTS["quadratic_damping"]]):
        with pytest.raises(ValueError, match=r"is a class.*`QuadraticDamping\(coefficient=…\)`"):
            sj.model.structure(modes(), effects=given)
    for given in (2.0, ["quadratic_damping"]):
        with pytest.raises(ValueError, match="must be effects"):
            sj.model.structure(modes(), effects=given)


def test_effects_and_families_print_as_tables():
    candidates, further = repr(EFFECTS).split("\n\n")
    assert [line.split()[0] for line in further.splitlines()[1:]] == list(ELEMENTS)
    lines = candidates.splitlines()
    assert [line.split()[0] for line in lines] == list(EFFECTS)
    (drag,) = (line for line in lines if line.startswith("quadratic_damping "))
    assert "coefficient (1/(√kg m)): Drag of the surrounding air" in drag
    assert drag in type(EFFECTS).__doc__
    families = repr(sj.identify.FAMILIES)
    assert [line.split()[0] for line in families.splitlines()] == list(sj.identify.FAMILIES)
    assert "class" not in families
