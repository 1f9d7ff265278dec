"""Damping forces without memory: drag and other laws of the velocity."""

from typing import ClassVar

import jax.numpy as jnp

from snrmjax.model.effect_base import AbstractMemoryless, Scalar


class QuadraticDamping(AbstractMemoryless):
    """f = c|q̇|q̇ (fluid drag); 2ζ̃ω̃ rises by 8cΩQ/3π."""

    kind: ClassVar[str] = "quadratic_damping"
    coefficient: Scalar

    def force(self, displacement: Scalar, velocity: Scalar) -> Scalar:
        """See `AbstractMemoryless.force`."""
        return self.coefficient * jnp.abs(velocity) * velocity


class CubicDamping(AbstractMemoryless):
    """f = c q̇³; 2ζ̃ω̃ rises by ¾cΩ²Q²."""

    kind: ClassVar[str] = "cubic_damping"
    coefficient: Scalar

    def force(self, displacement: Scalar, velocity: Scalar) -> Scalar:
        """See `AbstractMemoryless.force`."""
        return self.coefficient * velocity**3


class VanDerPolDamping(AbstractMemoryless):
    """f = c q²q̇; 2ζ̃ω̃ rises by cQ²/4."""

    kind: ClassVar[str] = "van_der_pol_damping"
    coefficient: Scalar

    def force(self, displacement: Scalar, velocity: Scalar) -> Scalar:
        """See `AbstractMemoryless.force`."""
        return self.coefficient * displacement**2 * velocity
