"""Tabulated laws identified from data: forces given by knots with a smooth curve through them.

A force f(x) of the displacement or of the velocity is x k(ln|x|), with the secant k = f/x a cubic
spline through the knots' values over the logarithm of x. Below the first knot k is constant, so
that the force is exactly zero at rest; beyond the last one f is extrapolated linearly. In this
form a power of x, dry friction and a contact are all smooth.
"""

from typing import Any, ClassVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from snrmjax.model.effect_base import AbstractEffect, AbstractMemoryless, Scalar
from snrmjax.model.effect_metadata import Argument, Entries, Part, Shape, Symmetry, parameter
from snrmjax.numerics.rules import POSITIVE

Knots = Float[Array, " knot"]


def secant_at(magnitude: Scalar, knots: Knots, secant: Knots) -> Scalar:
    """The secant at |x|: by a cubic spline over ln|x|, constant below the first knot.

    Beyond the last knot the force is extrapolated linearly. Linear in the knots' values.

    >>> knots, force = jnp.array([1.0, 2.0, 4.0]), jnp.array([1.0, 4.0, 16.0])
    >>> secant_at(jnp.array([0.5, 2.0, 4.0]), knots, force / knots)
    Array([1., 2., 4.], dtype=float64)
    """
    with (
        jax.ensure_compile_time_eval()
    ):  # imported only when a law is tabulated, and outside a trace
        import interpax

    position, last = jnp.log(knots), knots[-1]
    # The first slope makes the secant level below the first knot.
    slope = interpax.approx_df(position, secant, method="cubic2").at[0].set(0.0)
    inside = jnp.log(jnp.clip(magnitude, knots[0], last))
    value = interpax.interp1d(inside, position, secant, method="cubic2", fx=slope)
    # f = f_n + f'_n (x − x_n) with f'_n = k_n + dk/d ln x.
    beyond = jnp.maximum(1.0 - last / jnp.maximum(magnitude, last), 0.0)
    return value + slope[-1] * beyond


class AbstractLaw(AbstractEffect):
    """A law given by a table of knots in place of a formula with few parameters.

    A diagnosis estimates it from the data.
    """


def _displacements() -> Any:
    text = "displacement of a knot, above zero"
    return parameter("kg^1/2 m", text, rules=(POSITIVE,), entries=Entries.KNOTS)


class StiffnessLaw(AbstractLaw, AbstractMemoryless):
    """An odd restoring force f(q): `restoring_force` at every `displacement`, mirrored below zero.

    Both tables by ascending displacement, in kg^1/2 m/s² and kg^1/2 m.
    """

    kind: ClassVar[str] = "stiffness_law"
    description: ClassVar[str] = (
        "A restoring force of the displacement, the same in both directions, drawn from data."
    )
    shape: ClassVar[Shape] = Shape(Part.STIFFNESS, Symmetry.ODD, Argument.DISPLACEMENT)
    displacement: Knots = _displacements()
    restoring_force: Knots = parameter(
        "kg^1/2 m/s²", "restoring force at the displacement", entries=Entries.VALUES
    )

    def force(self, displacement: Scalar, velocity: Scalar) -> Scalar:
        values = self.restoring_force / self.displacement
        return displacement * secant_at(jnp.abs(displacement), self.displacement, values)


class DisplacementDampingLaw(AbstractLaw, AbstractMemoryless):
    """A damping c(|q|)q̇: `coefficient` (1/s) at every `displacement` (kg^1/2 m), ascending.

    Below the first knot c is constant; beyond the last one c(|q|)|q| is extrapolated linearly.
    """

    kind: ClassVar[str] = "displacement_damping_law"
    description: ClassVar[str] = (
        "A damping that depends on the displacement, as in a thin gap, drawn from data."
    )
    shape: ClassVar[Shape] = Shape(Part.DAMPING, Symmetry.ODD, Argument.BOTH)
    displacement: Knots = _displacements()
    coefficient: Knots = parameter("1/s", "damping at the displacement", entries=Entries.VALUES)

    def force(self, displacement: Scalar, velocity: Scalar) -> Scalar:
        magnitude = jnp.abs(displacement)
        return velocity * secant_at(magnitude, self.displacement, self.coefficient)
