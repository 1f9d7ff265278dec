"""What an effect is: the base classes, one for each way in which a model may lack something.

A force acts on the mode of interest: f is added on the left of q̈ + 2ζω₀q̇ + ω₀²q + … = p, with
q in kg^1/2 m. Other effects change the linear terms, add a mode, shape the force's spectrum or
falsify what the instruments write down.
"""

from abc import abstractmethod
from collections.abc import Mapping
from typing import ClassVar, Self

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Complex, Float

from snrmjax.model.modes import LinearModes
from snrmjax.model.potential import PolynomialPotential
from snrmjax.numerics.rules import Rule

Scalar = Float[Array, ""]


class AbstractEffect(eqx.Module):
    """One effect: its parameters are its fields without a default.

    Fields with a default are settings of the computation, which no file holds. `rules` says
    which values a parameter may have.
    """

    kind: ClassVar[str]
    rules: ClassVar[Mapping[str, tuple[Rule, ...]]] = {}


class AbstractForce(AbstractEffect):
    """A force on the mode of interest, known over one cycle of a steady motion."""

    @abstractmethod
    def cycle_force(
        self, displacement: Float[Array, " time"], velocity: Float[Array, " time"]
    ) -> Float[Array, " time"]:
        """The force at equally spaced samples of one period of a steady motion.

        Arguments: q in kg^1/2 m and q̇ in kg^1/2 m/s; sample 0 is at phase 0 of the force and the
        end of the period is left out. Returns kg^1/2 m/s², on the left of the modal equation.
        """


class AbstractMemoryless(AbstractForce):
    """A force f(q, q̇) that depends on the present state alone."""

    @abstractmethod
    def force(self, displacement: Scalar, velocity: Scalar) -> Scalar:
        """The force f(q, q̇) on the left of the modal equation, in kg^1/2 m/s²."""

    def cycle_force(
        self, displacement: Float[Array, " time"], velocity: Float[Array, " time"]
    ) -> Float[Array, " time"]:
        """See `AbstractForce.cycle_force`; valid for any samples, of one period or not."""
        return jax.vmap(self.force)(displacement, velocity)


class AbstractKinked(AbstractMemoryless):
    """A memoryless force whose slope jumps where a contact opens or closes.

    In time the kink is a kink. Over a cycle it is rounded over a hundredth of half the range of
    q to either side: harmonic balance sees a cycle at samples, and a kink between two of them
    would move in steps. The stiffness that a motion feels changes by less than 1e-4 of the
    contact's.
    """

    @abstractmethod
    def rounded_force(self, displacement: Scalar, velocity: Scalar, width: Scalar) -> Scalar:
        """The force with its kinks rounded over ±`width` (kg^1/2 m) of displacement."""

    def force(self, displacement: Scalar, velocity: Scalar) -> Scalar:
        """See `AbstractMemoryless.force`."""
        return self.rounded_force(displacement, velocity, jnp.zeros(()))

    def cycle_force(
        self, displacement: Float[Array, " time"], velocity: Float[Array, " time"]
    ) -> Float[Array, " time"]:
        """See `AbstractForce.cycle_force`; the kinks are rounded with the cycle's own range."""
        width = 0.5 * KINK_WIDTH * (jnp.max(displacement) - jnp.min(displacement))
        return jax.vmap(lambda q, v: self.rounded_force(q, v, width))(displacement, velocity)


KINK_WIDTH = 0.02  # over which a kink is rounded, to either side, over half the range of q


def ramp(beyond: Scalar, width: Scalar) -> Scalar:
    """max(x, 0), rounded over ±`width` so that the first two derivatives are continuous.

    >>> ramp(jnp.array([-1.0, 0.0, 3.0]), jnp.array(0.0))
    Array([0., 0., 3.], dtype=float64)
    """
    sharp = jnp.maximum(beyond, 0.0)
    safe = jnp.where(width > 0, width, 1.0)
    share = jnp.clip(beyond / safe, -1.0, 1.0)
    rounded = safe * (1 + share) ** 3 * (3 - share) / 16
    return jnp.where((width > 0) & (jnp.abs(beyond) < width), rounded, sharp)


class AbstractHysteresis(AbstractForce):
    """A force with a memory: internal states beside q and q̇ when it is integrated in time.

    `cycle_force` is that of the steady cycle, which needs no states. For integration in time,
    take the effect that `scaled_for` returns, begin with its `initial_states`, integrate
    `state_rate` and apply `state_force`.
    """

    def scaled_for(self, displacement: Scalar, velocity: Scalar) -> Self:
        """The same effect, set for integration in time of motions up to these amplitudes.

        Arguments: the largest |q| in kg^1/2 m and the typical |q̇| in kg^1/2 m/s to come.
        """
        return self

    @abstractmethod
    def initial_states(self) -> Float[Array, " state"]:
        """The internal states of a structure that has not moved yet."""

    @abstractmethod
    def state_force(
        self, displacement: Scalar, velocity: Scalar, states: Float[Array, " state"]
    ) -> Scalar:
        """The force for given internal states, in kg^1/2 m/s²."""

    @abstractmethod
    def state_rate(
        self, displacement: Scalar, velocity: Scalar, states: Float[Array, " state"]
    ) -> Float[Array, " state"]:
        """Rates of the internal states, per second."""

    @abstractmethod
    def settled_states(
        self, displacement: Float[Array, " time"], velocity: Float[Array, " time"]
    ) -> Float[Array, "time state"]:
        """Internal states over the steady cycle of a periodic motion; see `cycle_force`."""


class AbstractLinearChange(AbstractEffect):
    """A change of the linear terms of the mode of interest."""

    @abstractmethod
    def linear_terms(
        self, natural_frequency: Scalar, damping_ratio: Scalar, order: Scalar
    ) -> tuple[Scalar, Scalar, Scalar]:
        """What is added to the mass 1, the damping 2ζω₀ and the stiffness ω₀².

        Arguments: ω₀ in rad/s, ζ, and the test order from 0 to 1. Returns mass (relative to the
        modal mass), damping (1/s) and stiffness (1/s²). Several changes add up; their products,
        of second order, are left out.
        """


class AbstractAddedMode(AbstractEffect):
    """A further mode, coupled to the mode of interest through the potential."""

    @abstractmethod
    def expanded(
        self, modes: LinearModes, potential: PolynomialPotential
    ) -> tuple[LinearModes, PolynomialPotential]:
        """The modes and the potential with the further mode as the last one."""


class AbstractForceSpectrum(AbstractEffect):
    """Harmonics of the force beside its fundamental."""

    @abstractmethod
    def load_orders(self) -> Float[Array, " order"]:
        """Cosine amplitudes of the force's harmonics 0 to 3, relative to the fundamental."""


class AbstractMeasurementEffect(AbstractEffect):
    """What the instruments write down in place of what happens; the motion is untouched.

    Several act in the order of their `stage`: what the structure shows the sensors comes before
    what the instruments (stage 2) make of it.
    """

    stage: ClassVar[int] = 2

    @abstractmethod
    def recorded(
        self,
        frequency: Float[Array, " state"],
        force: Float[Array, " state"],
        velocity: Complex[Array, "state harmonic sensor"],
        displacement: Float[Array, " state"],
    ) -> tuple[Float[Array, " state"], Complex[Array, "state harmonic sensor"]]:
        """Force and velocity as they are recorded.

        Arguments: Ω in rad/s, the force's amplitude in N, the phasors e^{+ihΩt} of harmonics 0,
        1, … of the velocity in m/s, and the amplitude Q of the mode of interest's fundamental
        in kg^1/2 m. Returns the recorded force (N) and velocity (m/s).
        """
