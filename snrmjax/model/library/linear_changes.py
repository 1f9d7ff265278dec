"""Changes of the linear terms of the mode of interest: frequency, damping and mass."""

from collections.abc import Mapping
from typing import ClassVar

import jax.numpy as jnp

from snrmjax.model.effect_base import AbstractLinearChange, Scalar
from snrmjax.numerics.rules import ABOVE_MINUS_ONE, Rule


def _shifted(
    natural_frequency: Scalar, damping_ratio: Scalar, relative_shift: Scalar
) -> tuple[Scalar, Scalar, Scalar]:
    """What ω₀ → ω₀(1 + s) with the same ζ adds."""
    damping = 2 * damping_ratio * natural_frequency * relative_shift
    stiffness = natural_frequency**2 * relative_shift * (2 + relative_shift)
    return jnp.zeros(()), damping, stiffness


class LinearFrequencyShift(AbstractLinearChange):
    """ω₀ → ω₀(1 + s) with the damping ratio unchanged; `relative_shift` is s."""

    kind: ClassVar[str] = "linear_frequency_shift"
    rules: ClassVar[Mapping[str, tuple[Rule, ...]]] = {"relative_shift": (ABOVE_MINUS_ONE,)}
    relative_shift: Scalar

    def linear_terms(
        self, natural_frequency: Scalar, damping_ratio: Scalar, order: Scalar
    ) -> tuple[Scalar, Scalar, Scalar]:
        """See `AbstractLinearChange.linear_terms`."""
        return _shifted(natural_frequency, damping_ratio, self.relative_shift)


class FrequencyDrift(AbstractLinearChange):
    """ω₀ → ω₀(1 + d·order) with the damping ratio unchanged; `relative_drift` is d.

    The test order runs from 0 for the first measured state to 1 for the last.
    """

    kind: ClassVar[str] = "frequency_drift"
    rules: ClassVar[Mapping[str, tuple[Rule, ...]]] = {"relative_drift": (ABOVE_MINUS_ONE,)}
    relative_drift: Scalar

    def linear_terms(
        self, natural_frequency: Scalar, damping_ratio: Scalar, order: Scalar
    ) -> tuple[Scalar, Scalar, Scalar]:
        """See `AbstractLinearChange.linear_terms`."""
        return _shifted(natural_frequency, damping_ratio, self.relative_drift * order)


class LinearDampingChange(AbstractLinearChange):
    """ζ → ζ + Δ: 2ζω₀ rises by 2Δω₀; `damping_ratio_change` is Δ, a fraction of critical."""

    kind: ClassVar[str] = "linear_damping_change"
    damping_ratio_change: Scalar

    def linear_terms(
        self, natural_frequency: Scalar, damping_ratio: Scalar, order: Scalar
    ) -> tuple[Scalar, Scalar, Scalar]:
        """See `AbstractLinearChange.linear_terms`."""
        return jnp.zeros(()), 2 * self.damping_ratio_change * natural_frequency, jnp.zeros(())


class AddedMass(AbstractLinearChange):
    """f = m q̈: Δ(ω̃²) = −mΩ²; `mass` is m, relative to the modal mass."""

    kind: ClassVar[str] = "added_mass"
    rules: ClassVar[Mapping[str, tuple[Rule, ...]]] = {"mass": (ABOVE_MINUS_ONE,)}
    mass: Scalar

    def linear_terms(
        self, natural_frequency: Scalar, damping_ratio: Scalar, order: Scalar
    ) -> tuple[Scalar, Scalar, Scalar]:
        """See `AbstractLinearChange.linear_terms`."""
        return jnp.asarray(self.mass), jnp.zeros(()), jnp.zeros(())
