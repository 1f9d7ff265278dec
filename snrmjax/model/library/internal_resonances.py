"""Internal resonances: a further mode that the mode of interest drives through the potential."""

import dataclasses
from collections.abc import Mapping
from typing import ClassVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from snrmjax.model.effect_base import AbstractAddedMode, Scalar
from snrmjax.model.modes import LinearModes
from snrmjax.model.potential import Monomial, PolynomialPotential
from snrmjax.numerics.rules import OF_A_MODE, Rule


class AbstractInternalResonance(AbstractAddedMode):
    """V gains b q_jⁿ q_new, with a mode that no sensor sees and that the force does not drive.

    `coefficient` b in (kg^1/2 m)^(1−n)/s²; `frequency_hz` and `damping_ratio` are those of the
    new mode, which is excited strongly where it lies near n times the mode of interest.
    """

    order: ClassVar[int]
    rules: ClassVar[Mapping[str, tuple[Rule, ...]]] = OF_A_MODE
    coefficient: Scalar
    frequency_hz: Scalar
    damping_ratio: Scalar

    def expanded(
        self, modes: LinearModes, potential: PolynomialPotential
    ) -> tuple[LinearModes, PolynomialPotential]:
        """See `AbstractAddedMode.expanded`."""
        n_modes, frequency = modes.n_modes, 2 * jnp.pi * jnp.asarray(self.frequency_hz)
        unseen = jnp.zeros((modes.mode_shape.shape[0], 1))
        expanded_modes = dataclasses.replace(
            modes,
            natural_frequency=jnp.append(modes.natural_frequency, frequency),
            damping_ratio=jnp.append(modes.damping_ratio, self.damping_ratio),
            mode_shape=jnp.concatenate([modes.mode_shape, unseen], axis=1),
            participation=jnp.append(modes.participation, 0.0),
            natural_frequency_std=jnp.append(modes.natural_frequency_std, 0.0),
            damping_ratio_std=jnp.append(modes.damping_ratio_std, 0.0),
        )
        monomial = (*(modes.mode_of_interest,) * self.order, n_modes)
        return expanded_modes, _with_monomial(potential, monomial, self.coefficient, n_modes + 1)


class InternalResonanceOneToThree(AbstractInternalResonance):
    """V gains b q_j³ q_new: a third harmonic that resonates with a further mode."""

    kind: ClassVar[str] = "internal_resonance_1_3"
    order: ClassVar[int] = 3


class InternalResonanceOneToTwo(AbstractInternalResonance):
    """V gains b q_j² q_new: a second harmonic that resonates with a further mode."""

    kind: ClassVar[str] = "internal_resonance_1_2"
    order: ClassVar[int] = 2


def _with_monomial(
    potential: PolynomialPotential, monomial: Monomial, coefficient: Array, n_modes: int
) -> PolynomialPotential:
    """The potential of more modes with one more monomial, in the order of the others."""
    monomials = [*potential.monomials, monomial]
    rank = sorted(range(len(monomials)), key=lambda k: (len(monomials[k]), monomials[k]))
    values = jnp.append(potential.coefficient, coefficient)
    spread = jnp.append(potential.coefficient_std, 0.0)
    index = np.asarray(rank)
    return PolynomialPotential(
        values[index], spread[index], tuple(monomials[k] for k in rank), n_modes
    )
