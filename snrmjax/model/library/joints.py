"""Elements of joints and linkages between points, with parameters in N and m."""

import dataclasses
from typing import ClassVar, Self

import jax.numpy as jnp

from snrmjax.model.effect_base import AbstractMemoryless, Samples, Scalar
from snrmjax.model.effect_metadata import Argument, Part, Shape, Symmetry, parameter
from snrmjax.model.library.friction import NODE, WEIGHT, AbstractSliders, Sliders
from snrmjax.numerics.rules import ABOVE_MINUS_ONE, NOT_NEGATIVE, POSITIVE


class RegularisedFriction(AbstractMemoryless):
    """f = F tanh(ẋ/v): regularised dry friction, which creeps below the velocity v.

    `slip_force` F and `velocity` v, a property of the model, not of the motion: below it the
    friction is a damper F/v. Coulomb's law itself is `coulomb_friction`.
    """

    kind: ClassVar[str] = "regularised_friction"
    description: ClassVar[str] = "Dry friction whose jump is smoothed over a given velocity."
    shape: ClassVar[Shape] = Shape(Part.DAMPING, Symmetry.ODD, Argument.VELOCITY)
    slip_force: Scalar = parameter("kg^1/2 m/s²", "friction force", rules=(NOT_NEGATIVE,))
    velocity: Scalar = parameter("kg^1/2 m/s", "velocity of the jump", rules=(POSITIVE,))

    def force(self, displacement: Scalar, velocity: Scalar) -> Scalar:
        return self.slip_force * jnp.tanh(velocity / self.velocity)


class SpringLinkage(AbstractMemoryless):
    """f = k x (1 − l₀/√(l² + x²)): a pivoted spring perpendicular to the motion.

    `stiffness` k, `length` l between its ends at x = 0, `free_length` l₀ of the unloaded spring:
    with l₀ > l it is compressed at x = 0 and drives the motion away from there, otherwise back.
    """

    kind: ClassVar[str] = "spring_linkage"
    description: ClassVar[str] = (
        "A linear spring perpendicular to the motion at rest, which rotates with it."
    )
    shape: ClassVar[Shape] = Shape(Part.STIFFNESS, Symmetry.ODD, Argument.DISPLACEMENT)
    stiffness: Scalar = parameter("1/s²", "stiffness of the spring", rules=(NOT_NEGATIVE,))
    length: Scalar = parameter("kg^1/2 m", "distance of its ends at rest", rules=(POSITIVE,))
    free_length: Scalar = parameter("kg^1/2 m", "length without load", rules=(NOT_NEGATIVE,))

    def force(self, displacement: Scalar, velocity: Scalar) -> Scalar:
        now = jnp.sqrt(self.length**2 + displacement**2)
        return self.stiffness * displacement * (1 - self.free_length / now)


class FourParameterIwan(AbstractSliders):
    """Segalman's joint: sliders of density R φ^χ up to φ_max, and a Dirac density at φ_max.

    `slip_force` F_s of macroslip, stuck `stiffness` K_t, `exponent` χ (from above −1 to 0: the
    loss per cycle grows with the power χ + 3 of the amplitude) and `ratio` β of the stiffness of
    the sliders at φ_max to that of the others. Sliders up to the largest displacement of a motion
    are integrated by Gauss's rule with 48 points, in the power of φ with uniform density; the
    others stick.
    Reference: Segalman, ASME J. Appl. Mech. 72 (2005), 752, doi:10.1115/1.1989354.
    """

    kind: ClassVar[str] = "four_parameter_iwan"
    description: ClassVar[str] = "A bolted joint with microslip, and macroslip at a limiting force."
    shape: ClassVar[Shape] = Shape(Part.STIFFNESS_AND_DAMPING, Symmetry.ODD, Argument.HISTORY)
    slip_force: Scalar = parameter("kg^1/2 m/s²", "force of macroslip", rules=(POSITIVE,))
    stiffness: Scalar = parameter("1/s²", "stiffness while it sticks", rules=(POSITIVE,))
    exponent: Scalar = parameter("1", "power of the density", rules=(ABOVE_MINUS_ONE,))
    ratio: Scalar = parameter("1", "stiffness at φ_max over the rest", rules=(NOT_NEGATIVE,))
    largest_slip: Scalar | None = None  # of the sliders that are resolved, in m

    @property
    def end(self) -> Scalar:
        """φ_max, the displacement at which the last sliders slip."""
        mean = (self.exponent + 1) / (self.exponent + 2)
        return self.slip_force * (1 + self.ratio) / (self.stiffness * (self.ratio + mean))

    def scaled_for(self, displacement: Scalar, velocity: Scalar) -> Self:
        return dataclasses.replace(self, largest_slip=jnp.asarray(displacement, jnp.float64))

    def sliders(self) -> Sliders:
        """Sliders up to `largest_slip`, those at φ_max, and one for the others, which stick."""
        power, end = self.exponent + 1, self.end
        largest = end if self.largest_slip is None else jnp.minimum(self.largest_slip, end)
        spread = self.stiffness / (1 + self.ratio)  # of all below φ_max
        fraction = jnp.where(largest > 0, largest, 0.0) / end
        slipping = jnp.where(fraction > 0, fraction, 1.0) ** power * jnp.where(
            fraction > 0, spread, 0.0
        )
        slip = largest * jnp.asarray(NODE) ** (1 / power)
        rest = jnp.stack([self.stiffness - spread, spread - slipping])
        return Sliders(
            jnp.concatenate([slipping * WEIGHT, rest]),
            jnp.concatenate([slip, jnp.stack([end, end])]),
        )

    def for_cycle(self, displacement: Samples) -> Self:
        return self.scaled_for(jnp.max(jnp.abs(displacement)), jnp.zeros(()))
