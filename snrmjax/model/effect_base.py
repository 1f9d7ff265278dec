"""Base classes of effects, one for each way in which a model may be incomplete.

A force acts on the mode of interest, or at points of the structure. On the mode of interest f is
added on the left of q̈ + 2ζω₀q̇ + ω₀²q + … = p, with q in kg^1/2 m. At points it acts on their
displacement x in m and is a force in N, which is then what its parameters are in. Other effects
change the linear terms, add a mode, add harmonics to the force or change what the instruments
record.
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

from snrmjax.model.effect_metadata import (
    Confounder,
    MotionScales,
    Parameter,
    Part,
    Shape,
)
from snrmjax.model.modes import LinearModes
from snrmjax.model.nonsmooth_points import NonsmoothPoints, with_nonsmooth_points
from snrmjax.model.places import Row, checked_row
from snrmjax.model.potential import PolynomialPotential

Scalar = Float[Array, ""]
Samples = Float[Array, " time"]
States = Float[Array, " state"]
StateAt = Float[Array, ""] | Float[Array, " row"]
"""What a force acts on: one number, or one for every row of a force at several."""
Starts = list[tuple[float, ...]]
"""Parameters, in the order of the constructor, from which a fit begins."""
Bounds = list[tuple[float, float]]
"""Of every parameter the least and the largest value that a fit considers."""


class AbstractEffect(eqx.Module):
    """One physical effect, defined once: its equation, and what a diagnosis must know about it.

    Effects act on the mode of interest alone: on its modal coordinate q, its linear terms, or
    what is recorded of it. Forces may act at points instead (`AbstractForce`) and then couple
    modes, as the potential does.

    The parameters are the fields without a default, the first of them the effect's strength: at
    zero the effect does nothing. `parameter` gives a field its unit, rules and prior; a field
    without it has none. Fields with a default are settings of the computation, which no file
    holds.

    Only `kind`, the name in files, must be stated. Beside it a class may state

    - `description`: what the effect is physically, in one sentence that reports print;
    - `shape`: which part of the force balance it changes, its symmetry and its power of amplitude;
      of a force that states none it is computed (see `shape_of`);
    - `confounders`: other effects that the same data may show, and the measurement that separates
      them;
    - `like_force_gain`: a gain of all forces does the same;
    - `follows_force`: it adds a linear motion that the force drives, which beside a force of any
      size could be all that one sees;
    - `only_phase`: amplitudes do not show it;
    - `searched`: whether a diagnosis looks for it by itself, or only as an alternative to an
      answer.
    """

    kind: ClassVar[str]
    description: ClassVar[str] = ""
    shape: ClassVar[Shape | None] = None
    confounders: ClassVar[tuple[Confounder, ...]] = ()
    like_force_gain: ClassVar[bool] = False
    follows_force: ClassVar[bool] = False
    only_phase: ClassVar[bool] = False
    searched: ClassVar[bool] = True

    @classmethod
    def parameters(cls) -> dict[str, Parameter]:
        """The parameters by name, in the order of the constructor."""
        return {
            field.name: field.metadata.get("parameter", Parameter())
            for field in dataclasses.fields(cls)
            if field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING
        }

    @classmethod
    def starts(cls, scales: MotionScales) -> Starts:
        """Parameters from which a fit to measured states begins, of a strength plainly seen.

        One, of the parameters' own `start`, where the strength states one; those of a force whose
        `shape` has a factor and a power of amplitude follow from these. Empty where nothing is
        stated: the strength is then found from the force itself.
        """
        stated = list(cls.parameters().values())
        if stated[0].start is not None:
            return [tuple(of.start(scales) if of.start else of.typical for of in stated)]
        shape = cls.shape
        if shape is None or shape.factor is None or shape.power is None:
            return []
        size = shape.factor * scales.amplitude**shape.power
        strength = scales.change / (size * scales.frequency**shape.frequency_power)
        return [(strength, *(other.typical for other in stated[1:]))]

    @classmethod
    def bounds(cls, scales: MotionScales) -> Bounds:
        """The least and the largest value of every parameter that a fit considers."""
        return [parameter.prior.bounds(scales) for parameter in cls.parameters().values()]

    @classmethod
    def steps(cls, start: tuple[float, ...]) -> tuple[float, ...]:
        """A change of every parameter that is plainly seen, from the sizes of a start."""
        return start

    @classmethod
    def without_strength(cls, natural_frequency: float, damping_ratio: float) -> Self:
        """The effect at zero strength, its other parameters at their typical values.

        Arguments: natural frequency (rad/s) and damping ratio of the mode of interest.
        """
        _, *others = cls.parameters().values()
        values = (0.0, *(parameter.typical for parameter in others))
        return cls(*jax.device_put([np.asarray(value) for value in values]))

    def idle(self, natural_frequency: float, damping_ratio: float) -> Self:
        """An effect like this one, of the same structure, at zero strength.

        Arguments: see `without_strength`.
        """
        return type(self).without_strength(natural_frequency, damping_ratio)


class AbstractForce(AbstractEffect):
    """A force on the mode of interest or at points, known over one cycle of a steady motion.

    `at` says where: a point, `between("tip", "root")` for their relative motion, or points with
    weights b; the force then acts on x = Σ b x_point and, by b, on every point. Such a force is the
    whole element: the linear modes hold no part of it. Without `at` it acts on the mode of
    interest.
    """

    at: Row | None = eqx.field(default=None, static=True, kw_only=True, converter=checked_row)

    @property
    def rows(self) -> tuple[Row | None, ...]:
        """The rows on which it acts: one, but for contacts that move along and across a surface.

        With several, displacements, velocities and forces have a last axis for them.
        """
        return (self.at,)

    def idle(self, natural_frequency: float, damping_ratio: float) -> Self:
        """See `AbstractEffect`; it acts at the same place."""
        idle = super().idle(natural_frequency, damping_ratio)
        return dataclasses.replace(idle, at=self.at)

    @abstractmethod
    def cycle_force(self, displacement: Samples, velocity: Samples) -> Samples:
        """The force at equally spaced samples of one period of a steady motion.

        Arguments: q in kg^1/2 m and q̇ in kg^1/2 m/s (at points: m, m/s); sample 0 is at phase 0
        of the force and the end of the period is left out. Returns kg^1/2 m/s² (at points: N), on
        the left of the equations of motion.
        """

    def quick_cycle_force(self, displacement: Samples, velocity: Samples) -> Samples:
        """`cycle_force` by a shorter formula, where there is one; NaN where that does not hold.

        Of friction it is Masing's rule, which holds for cycles with two turning points.
        """
        return self.cycle_force(displacement, velocity)

    @classmethod
    def has_quick_formula(cls) -> bool:
        """Whether `quick_cycle_force` is another formula than `cycle_force`."""
        return cls.quick_cycle_force is not AbstractForce.quick_cycle_force


class AbstractMemoryless(AbstractForce):
    """A force f(q, q̇) that depends on the present state alone."""

    @abstractmethod
    def force(self, displacement: Scalar, velocity: Scalar) -> Scalar:
        """The force f(q, q̇) on the left of the modal equation, in kg^1/2 m/s²."""

    def cycle_force(self, displacement: Samples, velocity: Samples) -> Samples:
        """The force at any samples, of one period or not."""
        return jax.vmap(self.force)(displacement, velocity)


class AbstractNonsmooth(AbstractMemoryless):
    """A memoryless force whose slope jumps where a contact opens or closes.

    Harmonic balance evaluates a cycle at samples, of which a contact that opens between two of them
    would make jumps; `cycle_force` therefore finds these times (see `with_nonsmooth_points`). A
    class whose force is a straight line between such points may say so by `is_straight`.
    """

    is_straight: ClassVar[bool] = False

    @abstractmethod
    def nonsmooth_points(self) -> NonsmoothPoints:
        """Where the slope jumps; elsewhere the force is smooth, and everywhere continuous."""

    def cycle_force(self, displacement: Samples, velocity: Samples) -> Samples:
        """The force over one period, such that Fourier sums over its samples are integrals."""
        return with_nonsmooth_points(
            super().cycle_force(displacement, velocity), displacement, self.nonsmooth_points()
        )


class AbstractHysteresis(AbstractForce):
    """A force with memory: it has internal states beside q and q̇ in time integration.

    `cycle_force` is that of the steady cycle, which needs no states. For time integration take
    the effect that `scaled_for` returns, begin with its `initial_states`, integrate `state_rate`
    and apply `state_force`.
    """

    held_in_steps: ClassVar[bool] = False

    def scaled_for(self, displacement: Scalar, velocity: Scalar) -> Self:
        """The same effect, set for integration in time of motions up to these amplitudes.

        Arguments: the largest |q| in kg^1/2 m and the typical |q̇| in kg^1/2 m/s to come.
        """
        return self

    @abstractmethod
    def initial_states(self) -> States:
        """The internal states of a structure that has not moved yet."""

    def states_at_rest(self, displacement: StateAt) -> States:
        """The internal states of a structure that was brought to a displacement and held there."""
        return self.initial_states()

    @abstractmethod
    def state_force(self, displacement: StateAt, velocity: StateAt, states: States) -> StateAt:
        """The force for given internal states, in kg^1/2 m/s²."""

    @abstractmethod
    def state_rate(self, displacement: StateAt, velocity: StateAt, states: States) -> States:
        """Rates of the internal states, per second; not asked for with `held_in_steps`."""

    def after_step(
        self,
        states: States,
        begin: tuple[StateAt, StateAt],
        end: tuple[StateAt, StateAt],
        time: Array,
    ) -> States:
        """The internal states after a step of an integrator, from what it makes of them.

        Arguments: displacement and velocity at the `begin` and at the `end` of a step of `time` s.
        Effects with `held_in_steps`, whose states jump from holding to following, set them here.
        """
        return states

    def stuck_stiffness(self) -> Float[Array, " row"]:
        """The largest stiffness along every row, in 1/s²: what a step of an integrator resolves."""
        return jnp.zeros(len(self.rows))

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
        """The terms that are added to the mass 1, the damping 2ζω₀ and the stiffness ω₀².

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

    shape: ClassVar[Shape | None] = Shape(Part.HARMONICS)

    @abstractmethod
    def load_orders(self) -> Float[Array, " order"]:
        """Cosine amplitudes of the force's harmonics 0 to 3, relative to the fundamental."""


class AbstractMeasurementEffect(AbstractEffect):
    """A difference between the true motion and its record; the motion itself is unchanged.

    Several act in the order of their `stage`: what the sensors see of the structure (0 and 1)
    comes before what the instruments make of it (2).
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
        """Force and velocity as they are recorded.

        Arguments: Ω in rad/s, the force's amplitude in N, the phasors e^{+ihΩt} of harmonics 0,
        1, … of the velocity in m/s, and the amplitude Q of the mode of interest's fundamental
        in kg^1/2 m. Returns the recorded force (N) and velocity (m/s).
        """


def checked_effects(effects: AbstractEffect | Iterable[AbstractEffect]) -> tuple[Any, ...]:
    """Effects as a structure holds them: a tuple, their parameters as arrays.

    Parameters that are plain numbers become arrays of 64-bit floats; arrays stay as they are,
    traced ones too. One effect counts as a tuple of one.
    Raises `ValueError` for a class in place of an effect, and for what is no effect.
    """
    several = isinstance(effects, Iterable) and not isinstance(effects, type)
    given: Any = effects if several else (effects,)
    return tuple(_with_arrays(effect) for effect in given)


def _with_arrays(effect: Any) -> Any:
    if isinstance(effect, type) and issubclass(effect, AbstractEffect):
        values = ", ".join(f"{name}=…" for name in effect.parameters())
        raise ValueError(
            f"`effects` has {effect.__name__}, which is a class: give its parameters, "
            f"`{effect.__name__}({values})`."
        )
    if not isinstance(effect, AbstractEffect):
        raise ValueError(f"`effects` must be effects such as those of `EFFECTS`, not {effect!r}.")
    plain = [
        name
        for name in effect.parameters()
        if isinstance(getattr(effect, name), numbers.Real | np.ndarray)
    ]
    if not plain:
        return effect
    arrays = [jnp.asarray(getattr(effect, name), dtype=jnp.float64) for name in plain]
    return eqx.tree_at(lambda owner: [getattr(owner, name) for name in plain], effect, arrays)
