"""Elastic restoring forces: smooth stiffness, piecewise linear contacts, and a preload."""

from typing import ClassVar

import jax.numpy as jnp

from snrmjax.model.effect_base import AbstractMemoryless, AbstractNonsmooth, Scalar
from snrmjax.model.effect_metadata import (
    NON_NEGATIVE,
    Argument,
    Part,
    Prior,
    Shape,
    Symmetry,
    parameter,
)
from snrmjax.model.nonsmooth_points import NonsmoothPoints
from snrmjax.numerics.rules import NOT_NEGATIVE

_ODD = Shape(Part.STIFFNESS, Symmetry.ODD, Argument.DISPLACEMENT)
_EVEN = Shape(Part.STIFFNESS, Symmetry.EVEN, Argument.DISPLACEMENT, strength_order=2)
_OF_A_GAP = Prior(0.0, 1.2, lambda scales: scales.largest)


class CubicStiffness(AbstractMemoryless):
    """f = a q³, which raises ω̃² by ¾aQ²; `coefficient` is a in 1/(kg m² s²)."""

    kind: ClassVar[str] = "cubic_stiffness"
    description: ClassVar[str] = (
        "A spring that stiffens (below zero: softens) with the square of the amplitude, as by "
        "midplane stretching of a clamped beam."
    )
    shape: ClassVar[Shape] = _ODD._replace(power=2, factor=0.75)
    coefficient: Scalar = parameter("1/(kg m² s²)", "cubic stiffness")

    def force(self, displacement: Scalar, velocity: Scalar) -> Scalar:
        return self.coefficient * displacement**3


class QuadraticStiffness(AbstractMemoryless):
    """f = a q²; `coefficient` is a in 1/(kg^1/2 m s²).

    To first order it generates a mean displacement and a second harmonic; through these it
    softens: Δ(ω̃²) = −(5/6) a²Q²/ω₀².
    """

    kind: ClassVar[str] = "quadratic_stiffness"
    description: ClassVar[str] = (
        "A spring that is stiffer on one side than on the other, as by curvature or a static "
        "load: the motion loses its symmetry and softens."
    )
    shape: ClassVar[Shape] = _EVEN._replace(power=2)
    coefficient: Scalar = parameter("1/(kg^1/2 m s²)", "quadratic stiffness")

    def force(self, displacement: Scalar, velocity: Scalar) -> Scalar:
        return self.coefficient * displacement**2


class QuinticStiffness(AbstractMemoryless):
    """f = a q⁵, which raises ω̃² by ⅝aQ⁴; `coefficient` is a in 1/(kg² m⁴ s²)."""

    kind: ClassVar[str] = "quintic_stiffness"
    description: ClassVar[str] = (
        "A spring whose stiffness changes with the fourth power of the amplitude, as at large "
        "deflections."
    )
    shape: ClassVar[Shape] = _ODD._replace(power=4, factor=0.625)
    coefficient: Scalar = parameter("1/(kg² m⁴ s²)", "quintic stiffness")

    def force(self, displacement: Scalar, velocity: Scalar) -> Scalar:
        return self.coefficient * displacement**5


class BilinearStiffness(AbstractNonsmooth):
    """f = k|q|/2: the stiffness differs by k between the two sides; `stiffness` is k in 1/s².

    Its even harmonics are proportional to the amplitude.
    """

    kind: ClassVar[str] = "bilinear_stiffness"
    is_straight: ClassVar[bool] = True
    description: ClassVar[str] = (
        "A spring with one stiffness for each direction, as of a breathing crack or a contact "
        "that opens and closes."
    )
    shape: ClassVar[Shape] = _EVEN
    stiffness: Scalar = parameter("1/s²", "difference of stiffness between the two sides")

    def force(self, displacement: Scalar, velocity: Scalar) -> Scalar:
        return 0.5 * self.stiffness * jnp.abs(displacement)

    def nonsmooth_points(self) -> NonsmoothPoints:
        stiffness = jnp.asarray(self.stiffness)[None]
        return NonsmoothPoints(jnp.zeros_like(stiffness), stiffness)


class GapStiffness(AbstractNonsmooth):
    """A spring that engages beyond ±`gap` (kg^1/2 m); its `stiffness` is in 1/s².

    It acts only above an amplitude of `gap`, and generates odd harmonics.
    """

    kind: ClassVar[str] = "gap_stiffness"
    is_straight: ClassVar[bool] = True
    description: ClassVar[str] = (
        "A clearance with contacts on both sides: a further spring that engages where the "
        "displacement exceeds the gap."
    )
    shape: ClassVar[Shape] = _ODD
    stiffness: Scalar = parameter("1/s²", "stiffness of the contact", prior=NON_NEGATIVE)
    gap: Scalar = parameter(
        "kg^1/2 m", "displacement at contact", rules=(NOT_NEGATIVE,), prior=_OF_A_GAP
    )

    def force(self, displacement: Scalar, velocity: Scalar) -> Scalar:
        above = jnp.maximum(displacement - self.gap, 0.0)
        return self.stiffness * (above - jnp.maximum(-displacement - self.gap, 0.0))

    def nonsmooth_points(self) -> NonsmoothPoints:
        gap, stiffness = jnp.asarray(self.gap), jnp.asarray(self.stiffness)
        return NonsmoothPoints(jnp.stack([gap, -gap]), jnp.stack([stiffness, -stiffness]))


class OneSidedStop(AbstractNonsmooth):
    """A spring that engages beyond +`gap` (kg^1/2 m); its `stiffness` is in 1/s².

    It acts only above an amplitude of `gap`, and generates even and odd harmonics.
    """

    kind: ClassVar[str] = "one_sided_stop"
    is_straight: ClassVar[bool] = True
    description: ClassVar[str] = (
        "A stop on one side: a further spring that engages where the displacement exceeds the gap."
    )
    shape: ClassVar[Shape] = Shape(Part.STIFFNESS, Symmetry.NEITHER, Argument.DISPLACEMENT)
    stiffness: Scalar = parameter("1/s²", "stiffness of the contact", prior=NON_NEGATIVE)
    gap: Scalar = parameter("kg^1/2 m", "displacement at contact", prior=_OF_A_GAP)

    def force(self, displacement: Scalar, velocity: Scalar) -> Scalar:
        return self.stiffness * jnp.maximum(displacement - self.gap, 0.0)

    def nonsmooth_points(self) -> NonsmoothPoints:
        return NonsmoothPoints(jnp.asarray(self.gap)[None], jnp.asarray(self.stiffness)[None])


class StaticPreload(AbstractMemoryless):
    """A constant force; with a nonlinear stiffness it shifts ω₀ and generates a second harmonic.

    At points, such as a weight, it pushes the structure: a positive `constant_force` F moves the
    equilibrium in the positive direction, f = −F. On the mode of interest it is, like all
    forces there, a restoring force on the left of the equation of motion, f = F, and moves the
    equilibrium in the negative direction.
    """

    kind: ClassVar[str] = "static_preload"
    description: ClassVar[str] = (
        "A constant force, such as weight or a clamping force, that moves the equilibrium to where "
        "a nonlinear spring is stiffer or softer; at points along the positive direction."
    )
    shape: ClassVar[Shape] = _EVEN
    constant_force: Scalar = parameter("kg^1/2 m/s²", "constant force")

    def force(self, displacement: Scalar, velocity: Scalar) -> Scalar:
        force = self.constant_force if self.at is None else -self.constant_force
        return jnp.broadcast_to(force, jnp.shape(displacement))
