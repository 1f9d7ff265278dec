"""Elastic restoring forces: smooth stiffness laws, contacts with a kink, and a preload."""

from collections.abc import Mapping
from typing import ClassVar

import jax.numpy as jnp

from snrmjax.model.effect_base import AbstractKinked, AbstractMemoryless, Scalar, ramp
from snrmjax.numerics.rules import NOT_NEGATIVE, Rule


class CubicStiffness(AbstractMemoryless):
    """f = a q³; raises ω̃² by ¾aQ²."""

    kind: ClassVar[str] = "cubic_stiffness"
    coefficient: Scalar

    def force(self, displacement: Scalar, velocity: Scalar) -> Scalar:
        """See `AbstractMemoryless.force`."""
        return self.coefficient * displacement**3


class QuadraticStiffness(AbstractMemoryless):
    """f = a q²; a mean displacement and a second harmonic, softening in second order."""

    kind: ClassVar[str] = "quadratic_stiffness"
    coefficient: Scalar

    def force(self, displacement: Scalar, velocity: Scalar) -> Scalar:
        """See `AbstractMemoryless.force`."""
        return self.coefficient * displacement**2


class QuinticStiffness(AbstractMemoryless):
    """f = a q⁵; raises ω̃² by ⅝aQ⁴."""

    kind: ClassVar[str] = "quintic_stiffness"
    coefficient: Scalar

    def force(self, displacement: Scalar, velocity: Scalar) -> Scalar:
        """See `AbstractMemoryless.force`."""
        return self.coefficient * displacement**5


class BilinearStiffness(AbstractKinked):
    """f = k|q|/2: stiffness differs by k between the two sides; even harmonics ∝ Q."""

    kind: ClassVar[str] = "bilinear_stiffness"
    stiffness: Scalar

    def rounded_force(self, displacement: Scalar, velocity: Scalar, width: Scalar) -> Scalar:
        """See `AbstractKinked.rounded_force`."""
        return 0.5 * self.stiffness * (ramp(displacement, width) + ramp(-displacement, width))


class GapStiffness(AbstractKinked):
    """A spring k that engages beyond ±gap; threshold and odd harmonics."""

    kind: ClassVar[str] = "gap_stiffness"
    rules: ClassVar[Mapping[str, tuple[Rule, ...]]] = {"gap": (NOT_NEGATIVE,)}
    stiffness: Scalar
    gap: Scalar

    def rounded_force(self, displacement: Scalar, velocity: Scalar, width: Scalar) -> Scalar:
        """See `AbstractKinked.rounded_force`."""
        above = ramp(displacement - self.gap, width)
        return self.stiffness * (above - ramp(-displacement - self.gap, width))


class OneSidedStop(AbstractKinked):
    """A spring k that engages beyond +gap; threshold and even harmonics."""

    kind: ClassVar[str] = "one_sided_stop"
    stiffness: Scalar
    gap: Scalar

    def rounded_force(self, displacement: Scalar, velocity: Scalar, width: Scalar) -> Scalar:
        """See `AbstractKinked.rounded_force`."""
        return self.stiffness * ramp(displacement - self.gap, width)


class StaticPreload(AbstractMemoryless):
    """A constant force; with a cubic stiffness it shifts ω₀ and brings a second harmonic."""

    kind: ClassVar[str] = "static_preload"
    constant_force: Scalar

    def force(self, displacement: Scalar, velocity: Scalar) -> Scalar:
        """See `AbstractMemoryless.force`."""
        return jnp.broadcast_to(self.constant_force, jnp.shape(displacement))
