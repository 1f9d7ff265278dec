"""Base classes of effects, one for each way in which a model may be incomplete.

A force acts on the mode of interest, or at points of the structure. On the mode of interest f is
added on the left of q̈ + 2ζω₀q̇ + ω₀²q + … = p, with q in kg^1/2 m. At points it is a force in N
that depends on their displacement x in m, and its parameters are in N and m. Other effects change
the linear terms, add a mode, add harmonics to the force or distort the measured signals.
"""

import dataclasses
import numbers
from abc import abstractmethod
from collections.abc import Iterable
from typing import Any, ClassVar, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from snrmjax.model.attachment import InfluenceVector, checked_influence_vector
from snrmjax.model.effect_metadata import Parameter, Part, Shape
from snrmjax.model.modes import LinearModes
from snrmjax.model.nonsmooth_points import NonsmoothPoints, with_nonsmooth_points
from snrmjax.model.potential import PolynomialPotential
from snrmjax.numerics.names import take_former, with_former_attributes
from snrmjax.numerics.rules import InputError

Scalar = Float[Array, ""]
Samples = Float[Array, " time"]
States = Float[Array, " state"]
StateAt = Float[Array, ""] | Float[Array, " attachment"]
"""Displacement or velocity at a force: a number, or one for each of several attachments."""


class AbstractEffect(eqx.Module):
    """One physical effect: its equation and its parameters.

    Effects act on the mode of interest alone: on its modal coordinate q, its linear terms, or
    its measured response. Forces may act at points instead (`AbstractForce`) and then couple
    modes, as the potential does.

    The parameters are the fields without a default, the first of them the effect's strength: at
    zero the effect vanishes. `parameter` gives a field its unit, rules and prior; a field
    without it has none. Fields with a default are numerical settings and are not written to files.

    Only `kind`, the name in files, is required. Optional are

    - `description`: the physical mechanism, in one sentence for reports;
    - `shape`: which part of the force balance it changes, its symmetry and its power of amplitude;
      computed from the force where not given (see `shape_of`).

    How a diagnosis looks for it is stated in `snrmjax.diagnose`: see `register_hypothesis`.
    """

    kind: ClassVar[str]
    description: ClassVar[str] = ""
    shape: ClassVar[Shape | None] = None

    @classmethod
    def parameters(cls) -> dict[str, Parameter]:
        """The parameters by name, in the order of the constructor."""
        return {
            field.name: field.metadata.get("parameter", Parameter())
            for field in dataclasses.fields(cls)
            if field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING
        }


@with_former_attributes({"rows": "influence_vectors"})
class AbstractForce(AbstractEffect):
    """A force on the mode of interest or at points, defined over one cycle of a steady motion.

    `at` is where it acts: a point, `between("tip", "root")` for their relative motion, or points
    with weights b; the force then acts on x = Σ b x_point and exerts b f on every point. Such a
    force is the whole element: its stiffness is not part of the linear modes. Without `at` it acts
    on the mode of interest.
    """

    at: InfluenceVector | None = eqx.field(
        default=None, static=True, kw_only=True, converter=checked_influence_vector
    )

    def __init_subclass__(cls, **named: Any) -> None:
        super().__init_subclass__(**named)
        take_former(cls, {"rows": "influence_vectors"})

    @property
    def influence_vectors(self) -> tuple[InfluenceVector | None, ...]:
        """Its influence vectors: one, or two for contacts with tangential and normal motion.

        With several, displacements, velocities and forces have a last axis for them.
        """
        return (self.at,)

    @abstractmethod
    def cycle_force(self, displacement: Samples, velocity: Samples) -> Samples:
        """The force at equally spaced samples of one period of a steady motion.

        Arguments: q in kg^1/2 m and q̇ in kg^1/2 m/s (at points: m, m/s); sample 0 is at phase 0
        of the force and the end point of the period is excluded. Returns kg^1/2 m/s² (at points:
        N), on the left of the equations of motion.
        """


class AbstractMemoryless(AbstractForce):
    """A force f(q, q̇) that depends on the instantaneous state alone."""

    @abstractmethod
    def force(self, displacement: Scalar, velocity: Scalar) -> Scalar:
        """The force f(q, q̇) on the left of the modal equation, in kg^1/2 m/s²."""

    def cycle_force(self, displacement: Samples, velocity: Samples) -> Samples:
        """The force at any samples, whether or not they span one period."""
        return jax.vmap(self.force)(displacement, velocity)


class AbstractNonsmooth(AbstractMemoryless):
    """A memoryless force whose slope jumps where a contact opens or closes.

    In harmonic balance a contact event between two samples of the cycle makes the Fourier
    coefficients jump; `cycle_force` therefore locates the events (see `with_nonsmooth_points`).
    `is_straight` marks a force that is piecewise linear between such points.
    """

    is_straight: ClassVar[bool] = False

    @abstractmethod
    def nonsmooth_points(self) -> NonsmoothPoints:
        """Where the slope jumps; the force is continuous there and smooth elsewhere."""

    def cycle_force(self, displacement: Samples, velocity: Samples) -> Samples:
        """The force over one period, corrected so that sums over its samples are integrals."""
        return with_nonsmooth_points(
            super().cycle_force(displacement, velocity), displacement, self.nonsmooth_points()
        )


class AbstractHysteresis(AbstractForce):
    """A hysteretic force: time integration needs its internal variables in addition to q and q̇.

    `cycle_force` is that of the steady cycle, which needs no states. For time integration take
    the effect that `scaled_for` returns, start from its `initial_states`, integrate `state_rate`
    and apply `state_force`. With `constant_in_steps` the states are constant within a step of the
    integrator and are updated by `after_step`.
    """

    constant_in_steps: ClassVar[bool] = False

    def __init_subclass__(cls, **settings: Any) -> None:
        super().__init_subclass__(**settings)
        take_former(cls, {"held_in_steps": "constant_in_steps"})

    def scaled_for(self, displacement: Scalar, velocity: Scalar) -> Self:
        """The same effect, prepared for time integration of motions up to these amplitudes.

        Arguments: the largest expected |q| in kg^1/2 m and the typical |q̇| in kg^1/2 m/s.
        """
        return self

    @abstractmethod
    def initial_states(self) -> States:
        """The internal states of the undeformed structure."""

    def states_at_rest(self, displacement: StateAt) -> States:
        """The internal states after a quasi-static displacement from zero."""
        return self.initial_states()

    @abstractmethod
    def state_force(self, displacement: StateAt, velocity: StateAt, states: States) -> StateAt:
        """The force for given internal states, in kg^1/2 m/s²."""

    @abstractmethod
    def state_rate(self, displacement: StateAt, velocity: StateAt, states: States) -> States:
        """Rates of the internal states, per second; not used with `constant_in_steps`."""

    def after_step(
        self,
        states: States,
        begin: tuple[StateAt, StateAt],
        end: tuple[StateAt, StateAt],
        time: Array,
    ) -> States:
        """The internal states after a step of the integrator, corrected from its own result.

        Arguments: displacement and velocity at the `begin` and at the `end` of a step of `time` s.
        Effects with `constant_in_steps`, whose states switch between stick and slip, update them
        here.
        """
        return states

    def stuck_stiffness(self) -> Float[Array, " attachment"]:
        """The largest stiffness at every attachment, in 1/s², which limits the time step."""
        return jnp.zeros(len(self.influence_vectors))

    @abstractmethod
    def settled_states(
        self, displacement: Samples, velocity: Samples
    ) -> Float[Array, "time state"]:
        """Internal states over the steady cycle of a periodic motion; see `cycle_force`."""


class AbstractLinearChange(AbstractEffect):
    """A change of the linear terms of the mode of interest."""

    @abstractmethod
    def linear_terms(
        self, natural_frequency: Scalar, damping_ratio: Scalar, order: Scalar
    ) -> tuple[Scalar, Scalar, Scalar]:
        """The terms added to the mass 1, the damping 2ζω₀ and the stiffness ω₀².

        Arguments: ω₀ in rad/s, ζ, and the test order from 0 to 1. Returns mass (relative to the
        modal mass), damping (1/s) and stiffness (1/s²). Several changes add up; their
        second-order products are neglected.
        """


class AbstractAddedMode(AbstractEffect):
    """An additional mode, coupled to the mode of interest through the potential."""

    @abstractmethod
    def expanded(
        self, modes: LinearModes, potential: PolynomialPotential
    ) -> tuple[LinearModes, PolynomialPotential]:
        """The modes and the potential with the additional mode as the last one."""


class AbstractForceSpectrum(AbstractEffect):
    """Harmonics of the force in addition to its fundamental."""

    shape: ClassVar[Shape | None] = Shape(Part.HARMONICS)

    @abstractmethod
    def load_orders(self) -> Float[Array, " order"]:
        """Cosine amplitudes of the force's harmonics 0 to 3, relative to the fundamental."""


class AbstractMeasurementEffect(AbstractEffect):
    """A difference between the true and the recorded motion; the motion itself is unchanged.

    Several act in the order of their `stage`: response at the sensors (0 and 1) before errors of
    the instruments (2).
    """

    shape: ClassVar[Shape | None] = Shape(Part.INSTRUMENTS)
    stage: ClassVar[int] = 2

    @abstractmethod
    def recorded(
        self,
        frequency: Float[Array, " state"],
        force: Float[Array, " state"],
        velocity: Complex[Array, "state harmonic sensor"],
        displacement: Float[Array, " state"],
    ) -> tuple[Float[Array, " state"], Complex[Array, "state harmonic sensor"]]:
        """The recorded force and velocity.

        Arguments: Ω in rad/s, the force's amplitude in N, the phasors e^{+ihΩt} of harmonics 0,
        1, … of the velocity in m/s, and the amplitude Q of the mode of interest's fundamental
        in kg^1/2 m. Returns the recorded force (N) and velocity (m/s).
        """


def checked_effects(effects: AbstractEffect | Iterable[AbstractEffect]) -> tuple[Any, ...]:
    """Effects as a structure stores them: a tuple, with their parameters as arrays.

    Parameters that are plain numbers become arrays of 64-bit floats; arrays are unchanged, traced
    ones too. A single effect becomes a tuple of one.
    Raises `ValueError` for a class in place of an instance, and for anything but effects.
    """
    several = isinstance(effects, Iterable) and not isinstance(effects, type)
    given: Any = effects if several else (effects,)
    return tuple(_with_arrays(effect) for effect in given)


def _with_arrays(effect: Any) -> Any:
    if isinstance(effect, type) and issubclass(effect, AbstractEffect):
        values = ", ".join(f"{name}=…" for name in effect.parameters())
        raise InputError(
            f"`effects` has {effect.__name__}, which is a class: give its parameters, "
            f"`{effect.__name__}({values})`."
        )
    if not isinstance(effect, AbstractEffect):
        raise InputError(f"`effects` must be effects such as those of `EFFECTS`, not {effect!r}.")
    plain = [
        name
        for name in effect.parameters()
        if isinstance(getattr(effect, name), numbers.Real | np.ndarray)
    ]
    if not plain:
        return effect
    arrays = [jnp.asarray(getattr(effect, name), dtype=jnp.float64) for name in plain]
    return eqx.tree_at(lambda owner: [getattr(owner, name) for name in plain], effect, arrays)
