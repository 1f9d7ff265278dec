"""Effects as a user defines them: one with units and a prior, one of which nothing is stated."""

from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array

from snrmjax.model.effect_base import AbstractMemoryless
from snrmjax.model.effect_metadata import Prior, parameter
from snrmjax.numerics.rules import POSITIVE


class OwnDrag(AbstractMemoryless):
    """f = c |q̇|^p sgn q̇: an effect of a user, who states units and a prior."""

    kind: ClassVar[str] = "own_drag"
    coefficient: Array = parameter("(kg^1/2 m/s)^(1-exponent)/s", prior=Prior(lower=0.0))
    exponent: Array = parameter("1", rules=(POSITIVE,), prior=Prior(1.0, 3.0), typical=1.5)

    def force(self, displacement, velocity):
        """See `AbstractMemoryless.force`."""
        speed = jnp.abs(velocity)
        safe = jnp.where(speed > 0, speed, 1.0)
        return (
            self.coefficient * jnp.sign(velocity) * jnp.where(speed > 0, safe, 0) ** self.exponent
        )


class OwnAsymmetry(AbstractMemoryless):
    """f = a q⁴, of which nothing is stated."""

    kind: ClassVar[str] = "own_asymmetry"
    coefficient: Array

    def force(self, displacement, velocity):
        """See `AbstractMemoryless.force`."""
        return self.coefficient * displacement**4
