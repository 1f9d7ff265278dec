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
from snrmjax.model.library.friction import AbstractSliders, Sliders
from snrmjax.numerics.rules import NOT_NEGATIVE, POSITIVE

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


def drawn_force(x: Scalar, knots: Knots, force: Knots, reversed_force: Knots) -> Scalar:
    """The force at x from a table: `force` at x = knots, −`reversed_force` at x = −knots."""
    values = jnp.where(x < 0, reversed_force, force) / knots
    return x * secant_at(jnp.abs(x), knots, values)


class AbstractLaw(AbstractEffect):
    """A law given by a table of knots in place of a formula with few parameters.

    A diagnosis estimates it from the data.
    """


def _displacements() -> Any:
    text = "displacement of a knot, above zero"
    return parameter("kg^1/2 m", text, rules=(POSITIVE,), entries=Entries.KNOTS)


def _velocities() -> Any:
    text = "velocity of a knot, above zero"
    return parameter("kg^1/2 m/s", text, rules=(POSITIVE,), entries=Entries.KNOTS)


def _forces(meaning: str) -> Any:
    return parameter("kg^1/2 m/s²", meaning, entries=Entries.VALUES)


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
    restoring_force: Knots = _forces("restoring force at the displacement")

    def force(self, displacement: Scalar, velocity: Scalar) -> Scalar:
        table = self.restoring_force
        return drawn_force(displacement, self.displacement, table, table)


class UnevenStiffnessLaw(AbstractLaw, AbstractMemoryless):
    """A restoring force f(q) that differs between the two directions.

    `restoring_force` at q = `displacement` and −`reversed_force` at q = −`displacement`, in
    kg^1/2 m/s² and kg^1/2 m, by ascending displacement: two equal tables are an odd law, a reversed
    table of zeros is a one-sided stop.
    """

    kind: ClassVar[str] = "uneven_stiffness_law"
    description: ClassVar[str] = (
        "A restoring force of the displacement that differs between the two directions, drawn from "
        "data."
    )
    shape: ClassVar[Shape] = Shape(Part.STIFFNESS, Symmetry.NEITHER, Argument.DISPLACEMENT)
    displacement: Knots = _displacements()
    restoring_force: Knots = _forces("restoring force at the displacement")
    reversed_force: Knots = _forces("restoring force in the other direction")

    def force(self, displacement: Scalar, velocity: Scalar) -> Scalar:
        tables = self.displacement, self.restoring_force, self.reversed_force
        return drawn_force(displacement, *tables)


class DampingLaw(AbstractLaw, AbstractMemoryless):
    """An odd damping force g(q̇): `damping_force` at every `velocity`, mirrored below zero.

    Both tables by ascending velocity, in kg^1/2 m/s² and kg^1/2 m/s.
    """

    kind: ClassVar[str] = "damping_law"
    description: ClassVar[str] = (
        "A damping force of the velocity, the same in both directions, drawn from data."
    )
    shape: ClassVar[Shape] = Shape(Part.DAMPING, Symmetry.ODD, Argument.VELOCITY)
    velocity: Knots = _velocities()
    damping_force: Knots = _forces("damping force at the velocity")

    def force(self, displacement: Scalar, velocity: Scalar) -> Scalar:
        table = self.damping_force
        return drawn_force(velocity, self.velocity, table, table)


class UnevenDampingLaw(AbstractLaw, AbstractMemoryless):
    """A damping force g(q̇) that differs between the two directions.

    `damping_force` at q̇ = `velocity` and −`reversed_force` at q̇ = −`velocity`, in kg^1/2 m/s² and
    kg^1/2 m/s, by ascending velocity.
    """

    kind: ClassVar[str] = "uneven_damping_law"
    description: ClassVar[str] = (
        "A damping force of the velocity that differs between the two directions, drawn from data."
    )
    shape: ClassVar[Shape] = Shape(Part.DAMPING, Symmetry.NEITHER, Argument.VELOCITY)
    velocity: Knots = _velocities()
    damping_force: Knots = _forces("damping force at the velocity")
    reversed_force: Knots = _forces("damping force in the other direction")

    def force(self, displacement: Scalar, velocity: Scalar) -> Scalar:
        return drawn_force(velocity, self.velocity, self.damping_force, self.reversed_force)


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


class SlipLaw(AbstractLaw, AbstractSliders):
    """Friction with a free backbone: parallel sliders, each with its own slip displacement.

    `stiffness` k_t (1/s²) of the sliders that slip at every `slip_displacement` x_s (kg^1/2 m),
    a discrete Iwan density: f = −Σ k_t z with |q − z| ≤ x_s. The stuck stiffness is part of
    the linear frequency, so that the first loading loses Σ k_t max(q − x_s, 0), and Masing's
    rule gives the loops.
    Reference: Iwan, ASME J. Appl. Mech. 33 (1966), 893, doi:10.1115/1.3625199.
    """

    kind: ClassVar[str] = "slip_law"
    description: ClassVar[str] = (
        "Friction of a joint with microslip and a backbone of any shape, drawn from data."
    )
    shape: ClassVar[Shape] = Shape(Part.STIFFNESS_AND_DAMPING, Symmetry.ODD, Argument.HISTORY)
    slip_displacement: Knots = parameter(
        "kg^1/2 m", "displacement at slip", rules=(POSITIVE,), entries=Entries.KNOTS
    )
    stiffness: Knots = parameter(
        "1/s²", "stiffness while it sticks", rules=(NOT_NEGATIVE,), entries=Entries.VALUES
    )

    def sliders(self) -> Sliders:
        return Sliders(jnp.asarray(self.stiffness), jnp.asarray(self.slip_displacement))
