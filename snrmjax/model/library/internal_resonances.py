"""Internal resonances: an added mode driven by the mode of interest through the potential."""

import dataclasses
from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from snrmjax.model.effect_base import AbstractAddedMode, Scalar
from snrmjax.model.effect_metadata import (
    ADDED_MODE_DAMPING,
    Part,
    Prior,
    Shape,
    Symmetry,
    parameter,
)
from snrmjax.model.modes import LinearModes
from snrmjax.model.potential import Monomial, PolynomialPotential
from snrmjax.numerics.rules import OF_A_DAMPING_RATIO, OF_A_FREQUENCY
from snrmjax.numerics.units import HERTZ


def _added_frequency(order: int) -> Any:
    """The added mode's frequency, within a fifth of `order` times that of the mode of interest."""
    return parameter(
        *("Hz", "natural frequency of the added mode"),
        rules=OF_A_FREQUENCY,
        prior=Prior(0.8 * order, 1.2 * order, lambda scales: scales.frequency / HERTZ),
    )


class AbstractInternalResonance(AbstractAddedMode):
    """V += b q_jⁿ q_new, with a mode of zero participation and zero shape at the sensors.

    `coefficient` b in (kg^1/2 m)^(1−n)/s²; `frequency_hz` and `damping_ratio` are those of the
    new mode, which resonates if it lies near n times the mode of interest.
    """

    order: ClassVar[int]  # n: cycles of the added mode per cycle of the mode of interest
    coefficient: Scalar
    frequency_hz: Scalar
    damping_ratio: Scalar = parameter(
        "1",
        "damping ratio of the added mode",
        rules=OF_A_DAMPING_RATIO,
        prior=ADDED_MODE_DAMPING,
    )

    def expanded(
        self, modes: LinearModes, potential: PolynomialPotential
    ) -> tuple[LinearModes, PolynomialPotential]:
        n_modes, frequency = modes.n_modes, HERTZ * jnp.asarray(self.frequency_hz)
        no_shape = jnp.zeros((modes.mode_shape.shape[0], 1))
        expanded_modes = dataclasses.replace(
            modes,
            natural_frequency=jnp.append(modes.natural_frequency, frequency),
            damping_ratio=jnp.append(modes.damping_ratio, self.damping_ratio),
            mode_shape=jnp.concatenate([modes.mode_shape, no_shape], axis=1),
            participation=jnp.append(modes.participation, 0.0),
            natural_frequency_std=jnp.append(modes.natural_frequency_std, 0.0),
            damping_ratio_std=jnp.append(modes.damping_ratio_std, 0.0),
            modal_mass_std=_padded(modes.modal_mass_std),
            point_shape=_padded(modes.point_shape),
            damping_coupling=_padded(modes.damping_coupling, axes=2),
            participation_lag=_padded(modes.participation_lag),
        )
        monomial = (*(modes.mode_of_interest,) * self.order, n_modes)
        return expanded_modes, _with_monomial(potential, monomial, self.coefficient, n_modes + 1)


class InternalResonanceOneToThree(AbstractInternalResonance):
    """V += b q_j³ q_new: the third harmonic resonates with an additional mode."""

    kind: ClassVar[str] = "internal_resonance_1_3"
    description: ClassVar[str] = (
        "A further mode near three times the frequency resonates with the third harmonic and "
        "draws energy from the mode of interest."
    )
    shape: ClassVar[Shape] = Shape(Part.HARMONICS, Symmetry.ODD, strength_order=2)
    order: ClassVar[int] = 3
    coefficient: Scalar = parameter("1/(kg m² s²)", "coupling of the two modes")
    frequency_hz: Scalar = _added_frequency(3)


class InternalResonanceOneToTwo(AbstractInternalResonance):
    """V += b q_j² q_new: the second harmonic resonates with an additional mode."""

    kind: ClassVar[str] = "internal_resonance_1_2"
    description: ClassVar[str] = (
        "A further mode near twice the frequency resonates with the second harmonic and draws "
        "energy from the mode of interest."
    )
    shape: ClassVar[Shape] = Shape(Part.HARMONICS, Symmetry.EVEN, strength_order=2)
    order: ClassVar[int] = 2
    coefficient: Scalar = parameter("1/(kg^1/2 m s²)", "coupling of the two modes")
    frequency_hz: Scalar = _added_frequency(2)


def _padded(values: Array | None, axes: int = 1) -> Array | None:
    """Modal arrays padded with a zero for the added mode along the last axes."""
    if values is None:
        return None
    return jnp.pad(values, [(0, 0)] * (values.ndim - axes) + [(0, 1)] * axes)


def _with_monomial(
    potential: PolynomialPotential, monomial: Monomial, coefficient: Array, n_modes: int
) -> PolynomialPotential:
    """The potential with one more monomial, in sorted order."""
    monomials = [*potential.monomials, monomial]
    rank = sorted(range(len(monomials)), key=lambda k: (len(monomials[k]), monomials[k]))
    values = jnp.append(potential.coefficient, coefficient)
    spread = jnp.append(potential.coefficient_std, 0.0)
    index = np.asarray(rank)
    return PolynomialPotential(
        values[index], spread[index], tuple(monomials[k] for k in rank), n_modes
    )
