"""Changes of the linear terms of the mode of interest: frequency, damping and mass."""

from typing import ClassVar

import jax.numpy as jnp

from snrmjax.model.effect_base import AbstractLinearChange, Scalar
from snrmjax.model.effect_metadata import POSITIVE_FACTOR, Part, Shape, parameter
from snrmjax.numerics.rules import ABOVE_MINUS_ONE


def _shifted(
    natural_frequency: Scalar, damping_ratio: Scalar, relative_shift: Scalar
) -> tuple[Scalar, Scalar, Scalar]:
    """Additions to mass, damping and stiffness for ω₀ → ω₀(1 + s) at constant ζ."""
    damping = 2 * damping_ratio * natural_frequency * relative_shift
    stiffness = natural_frequency**2 * relative_shift * (2 + relative_shift)
    return jnp.zeros(()), damping, stiffness


class LinearFrequencyShift(AbstractLinearChange):
    """ω₀ → ω₀(1 + s) with the damping ratio unchanged; `relative_shift` is s."""

    kind: ClassVar[str] = "linear_frequency_shift"
    description: ClassVar[str] = (
        "The natural frequency differs from the model's: the linear stiffness is not that of "
        "the linear test."
    )
    shape: ClassVar[Shape] = Shape(Part.STIFFNESS, power=0)
    relative_shift: Scalar = parameter(
        "1",
        "relative shift of the natural frequency",
        rules=(ABOVE_MINUS_ONE,),
        prior=POSITIVE_FACTOR,
        start=lambda scales: 0.5 * scales.change / scales.frequency**2,
    )

    def linear_terms(
        self, natural_frequency: Scalar, damping_ratio: Scalar, order: Scalar
    ) -> tuple[Scalar, Scalar, Scalar]:
        return _shifted(natural_frequency, damping_ratio, self.relative_shift)


class FrequencyDrift(AbstractLinearChange):
    """ω₀ → ω₀(1 + d·order) with the damping ratio unchanged; `relative_drift` is d.

    The test order runs from 0 for the first measured state to 1 for the last.
    """

    kind: ClassVar[str] = "frequency_drift"
    description: ClassVar[str] = (
        "The natural frequency drifts during the test, with temperature or as a joint settles."
    )
    shape: ClassVar[Shape] = Shape(Part.TIME)
    relative_drift: Scalar = parameter(
        "1",
        "relative shift of the natural frequency over the test",
        rules=(ABOVE_MINUS_ONE,),
        prior=POSITIVE_FACTOR,
        start=lambda scales: scales.change / scales.frequency**2,
    )

    def linear_terms(
        self, natural_frequency: Scalar, damping_ratio: Scalar, order: Scalar
    ) -> tuple[Scalar, Scalar, Scalar]:
        return _shifted(natural_frequency, damping_ratio, self.relative_drift * order)


class LinearDampingChange(AbstractLinearChange):
    """ζ → ζ + Δ: 2ζω₀ rises by 2Δω₀; `damping_ratio_change` is Δ, a fraction of critical."""

    kind: ClassVar[str] = "linear_damping_change"
    description: ClassVar[str] = "The linear damping differs from the model's."
    shape: ClassVar[Shape] = Shape(Part.DAMPING, power=0)
    damping_ratio_change: Scalar = parameter(
        "1",
        "change of the damping ratio",
        start=lambda scales: 0.5 * scales.change / scales.frequency**2,
    )

    def linear_terms(
        self, natural_frequency: Scalar, damping_ratio: Scalar, order: Scalar
    ) -> tuple[Scalar, Scalar, Scalar]:
        return jnp.zeros(()), 2 * self.damping_ratio_change * natural_frequency, jnp.zeros(())


class AddedMass(AbstractLinearChange):
    """f = m q̈: Δ(ω̃²) = −mΩ²; `mass` is m, relative to the modal mass."""

    kind: ClassVar[str] = "added_mass"
    description: ClassVar[str] = (
        "A mass missing in the model, such as that of a sensor or of a shaker's armature."
    )
    shape: ClassVar[Shape] = Shape(Part.STIFFNESS, power=0)
    mass: Scalar = parameter(
        "1",
        "mass over the modal mass",
        rules=(ABOVE_MINUS_ONE,),
        prior=POSITIVE_FACTOR,
        start=lambda scales: scales.change / scales.frequency**2,
    )

    def linear_terms(
        self, natural_frequency: Scalar, damping_ratio: Scalar, order: Scalar
    ) -> tuple[Scalar, Scalar, Scalar]:
        return jnp.asarray(self.mass), jnp.zeros(()), jnp.zeros(())
