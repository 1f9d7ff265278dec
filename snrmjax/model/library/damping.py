"""Memoryless damping forces: drag and other functions of the velocity."""

from typing import ClassVar

import jax.numpy as jnp
import numpy as np

from snrmjax.model.effect_base import AbstractMemoryless, Scalar
from snrmjax.model.effect_metadata import NON_NEGATIVE, Argument, Part, Shape, Symmetry, parameter

_OF_VELOCITY = Shape(Part.DAMPING, Symmetry.ODD, Argument.VELOCITY)


class QuadraticDamping(AbstractMemoryless):
    """f = c|q̇|q̇, which raises 2ζ̃ω̃ by 8cΩQ/3π; `coefficient` is c in 1/(kg^1/2 m)."""

    kind: ClassVar[str] = "quadratic_damping"
    description: ClassVar[str] = (
        "Drag of the surrounding air or liquid: a damping force quadratic in the velocity."
    )
    shape: ClassVar[Shape] = _OF_VELOCITY._replace(
        power=1, factor=8 / (3 * np.pi), frequency_power=2
    )
    coefficient: Scalar = parameter("1/(kg^1/2 m)", "quadratic damping", prior=NON_NEGATIVE)

    def force(self, displacement: Scalar, velocity: Scalar) -> Scalar:
        return self.coefficient * jnp.abs(velocity) * velocity


class CubicDamping(AbstractMemoryless):
    """f = c q̇³, which raises 2ζ̃ω̃ by ¾cΩ²Q²; `coefficient` is c in s/(kg m²)."""

    kind: ClassVar[str] = "cubic_damping"
    description: ClassVar[str] = (
        "A damping force cubic in the velocity, as of some dampers and seals."
    )
    shape: ClassVar[Shape] = _OF_VELOCITY._replace(power=2, factor=0.75, frequency_power=3)
    coefficient: Scalar = parameter("s/(kg m²)", "cubic damping")

    def force(self, displacement: Scalar, velocity: Scalar) -> Scalar:
        return self.coefficient * velocity**3


class VanDerPolDamping(AbstractMemoryless):
    """f = c q²q̇, which raises 2ζ̃ω̃ by cQ²/4; `coefficient` is c in 1/(kg m² s)."""

    kind: ClassVar[str] = "van_der_pol_damping"
    description: ClassVar[str] = (
        "Damping that grows with the square of the displacement, as of a material under large "
        "strain; below zero, a self-excitation."
    )
    shape: ClassVar[Shape] = Shape(
        Part.DAMPING, Symmetry.ODD, Argument.BOTH, power=2, factor=0.25, frequency_power=1
    )
    coefficient: Scalar = parameter("1/(kg m² s)", "damping per squared displacement")

    def force(self, displacement: Scalar, velocity: Scalar) -> Scalar:
        return self.coefficient * displacement**2 * velocity
