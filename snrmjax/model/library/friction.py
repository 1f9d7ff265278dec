"""Friction: forces that depend on the history and the direction of the motion.

A slider with the stuck stiffness k_t and the slip displacement x_s is a spring k_t to a block
on a friction surface. The block's position z follows where the spring's stretch q − z would
exceed ±x_s (the "play" of q). On the mode of interest the linear frequency is that of the stuck
structure, so that a slider adds k_t (q − z) − k_t q = −k_t z: nothing before the first slip. At
points it is the whole force k_t (x − z), with no part in the linear structure.

Reference: Iwan, ASME J. Appl. Mech. 33 (1966), 893, doi:10.1115/1.3625199.
"""

import dataclasses
from abc import abstractmethod
from typing import ClassVar, NamedTuple, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from snrmjax.model.effect_base import AbstractHysteresis, Samples, Scalar, States
from snrmjax.model.effect_metadata import (
    NON_NEGATIVE,
    Argument,
    Part,
    Prior,
    Shape,
    Symmetry,
    parameter,
)
from snrmjax.model.nonsmooth_points import with_extremes, with_slip_corners
from snrmjax.numerics.rules import BETWEEN_ONE_AND_THREE, NOT_NEGATIVE, POSITIVE, InputError

_SLIP = Shape(Part.STIFFNESS_AND_DAMPING, Symmetry.ODD, Argument.HISTORY)
SMOOTHING = 0.05  # width of the smoothed jump of Coulomb's force over the rms velocity
# In w = u^(p−1) on (0, 1), in which the slip thresholds of an Iwan element have uniform density.
NODE, WEIGHT = (0.5 * part for part in np.polynomial.legendre.leggauss(48))
NODE = NODE + 0.5


class Sliders(NamedTuple):
    """Parallel sliders."""

    stiffness: Float[Array, " slider"]  # k_t, 1/s²
    slip_displacement: Float[Array, " slider"]  # x_s, kg^1/2 m


def settled_positions(
    displacement: Float[Array, " time"], slip_displacement: Float[Array, " slider"]
) -> Float[Array, "time slider"]:
    """Positions of sliders over the steady cycle of a periodic motion, in kg^1/2 m.

    z ↦ clip(z, q − x_s, q + x_s) from sample to sample, from z = 0. Such maps are closed under
    composition, and that of a whole cycle is idempotent: the second cycle is exactly the steady
    one. A slider that never slips stays where the first loading from rest to sample 0 left it.

    Every position is a sample of q plus or minus x_s, or 0. The index of the sample is computed
    without derivatives and the position then looked up: exact and cheap derivatives.
    """
    return _settled(displacement[:, None], slip_displacement)


def corrected_positions(
    displacement: Float[Array, " time"], slip_displacement: Float[Array, " slider"]
) -> Float[Array, "time slider"]:
    """`settled_positions` of a cycle that turns between samples, with corners corrected.

    See `with_slip_corners`.
    """
    position = _settled(with_extremes(displacement), slip_displacement)
    return _with_corners(position, displacement, slip_displacement)


_with_corners = jax.vmap(with_slip_corners, (1, None, 0), 1)


def _settled(
    path: Float[Array, "time step"], slip_displacement: Float[Array, " slider"]
) -> Float[Array, "time slider"]:
    """Positions after every row of displacements."""
    n = path.size
    q, slip = jax.lax.stop_gradient((path, slip_displacement))
    untouched = 2 * n

    def moved(
        before: tuple[Array, Array], sample: tuple[Array, Array]
    ) -> tuple[tuple[Array, Array], Array]:
        position, source = before
        for at, k in zip(*sample, strict=True):
            dragged_up, dragged_down = position < at - slip, position > at + slip
            source = jnp.where(dragged_up, k, jnp.where(dragged_down, k + n, source))
            position = jnp.clip(position, at - slip, at + slip)
        return (position, source), source

    samples = (q, jnp.arange(n, dtype=jnp.int32).reshape(path.shape))
    rest = (jnp.zeros_like(slip), jnp.full(slip.shape, untouched, dtype=jnp.int32))
    settled, _ = jax.lax.scan(moved, rest, samples)
    sources: Int[Array, "time slider"]
    _, sources = jax.lax.scan(moved, settled, samples)
    picked = path.reshape(-1)[jnp.where(sources == untouched, 0, sources % n)]
    position = picked + jnp.where(sources < n, -1.0, 1.0) * slip_displacement
    return jnp.where(sources == untouched, 0.0, position)


class AbstractSliders(AbstractHysteresis):
    """Friction by parallel sliders; the states are their positions in kg^1/2 m."""

    constant_in_steps: ClassVar[bool] = True

    @abstractmethod
    def sliders(self) -> Sliders:
        """The sliders, for time integration."""

    def added_stiffness(self) -> Scalar:
        """Stiffness that the stuck sliders add to the structure: all their springs, at points."""
        return jnp.zeros(()) if self.at is None else jnp.sum(self.sliders().stiffness)

    def stuck_stiffness(self) -> Float[Array, " row"]:
        return self.added_stiffness()[None]

    def initial_states(self) -> States:
        return jnp.zeros_like(self.sliders().slip_displacement)

    def states_at_rest(self, displacement: Scalar) -> States:
        return self.moved_states(displacement, self.initial_states())

    def state_force(self, displacement: Scalar, velocity: Scalar, states: States) -> Scalar:
        """The force with the integrator's position errors removed."""
        lost = jnp.sum(self.sliders().stiffness * self.moved_states(displacement, states))
        return self.added_stiffness() * displacement - lost

    def state_rate(self, displacement: Scalar, velocity: Scalar, states: States) -> States:
        """The velocity q̇ while a slider slips, otherwise 0."""
        stretch, slip = displacement - states, self.sliders().slip_displacement
        dragged = jnp.where(velocity > 0, stretch >= slip, stretch <= -slip)
        return jnp.where(dragged, velocity, 0.0)

    def moved_states(self, displacement: Scalar, states: States) -> States:
        """Positions after a monotonic motion to `displacement`: exact, unlike an integrator's."""
        slip = self.sliders().slip_displacement
        return jnp.clip(states, displacement - slip, displacement + slip)

    def after_step(
        self, states: States, begin: tuple[Array, Array], end: tuple[Array, Array], time: Array
    ) -> States:
        """Positions after a step, including a turning point within it."""
        (x0, v0), (x1, v1) = begin, end
        reverses = v0 * v1 < 0
        until = time * v0 / jnp.where(reverses, v0 - v1, 1.0)
        turning = jnp.where(reverses, x0 + 0.5 * v0 * until, x0)
        return self.moved_states(x1, self.moved_states(turning, states))

    def settled_states(
        self, displacement: Samples, velocity: Samples
    ) -> Float[Array, "time state"]:
        return settled_positions(displacement, self.sliders().slip_displacement)

    def cycle_force(self, displacement: Samples, velocity: Samples) -> Samples:
        effect = self.for_cycle(displacement)
        stiffness, slip = effect.sliders()
        lost = corrected_positions(displacement, slip) @ stiffness
        return effect.added_stiffness() * displacement - lost

    def for_cycle(self, displacement: Samples) -> Self:
        """The effect with sliders that resolve a cycle; itself if they do not depend on it."""
        return self


class JenkinsSlider(AbstractSliders):
    """A spring k_t that slips at x_s: f = k_t (q − z) − k_t q with |q − z| ≤ x_s.

    `stiffness` k_t in 1/s², `slip_displacement` x_s in kg^1/2 m; k_t is part of the linear
    frequency. For q = Q cos Ωt and Q > x_s, with cos θ = 1 − 2x_s/Q,
    Δ(ω̃²) = (k_t/π)(θ − sin θ cos θ) − k_t and Δ(2ζ̃ω̃) = 4k_t x_s(Q − x_s)/(πΩQ²).
    """

    kind: ClassVar[str] = "jenkins_slider"
    description: ClassVar[str] = (
        "A joint that sticks and, beyond a certain displacement, slips completely: it then loses "
        "stiffness and dissipates energy."
    )
    shape: ClassVar[Shape] = _SLIP
    stiffness: Scalar = parameter(
        "1/s²", "stiffness while it sticks", rules=(NOT_NEGATIVE,), prior=NON_NEGATIVE
    )
    slip_displacement: Scalar = parameter(
        "kg^1/2 m",
        "displacement at slip",
        rules=(POSITIVE,),
        prior=Prior(1e-3, 1.2, lambda scales: scales.largest),
    )

    def sliders(self) -> Sliders:
        return Sliders(jnp.asarray(self.stiffness)[None], jnp.asarray(self.slip_displacement)[None])


class IwanMicroslip(AbstractSliders):
    """Microslip of a joint: backbone −c|x|^p sgn x and Masing's rule, by a continuum of sliders.

    Sliders with every slip displacement s and the stiffness density c p (p − 1) s^(p−2):
    f = −∫₀^R c p (p − 1) s^(p−2) z_s ds, where R is half the range of q over the cycle; sliders
    above R do not slip and, being part of the linear frequency, add nothing. By Gauss's rule
    with 48 points in w = (s/R)^(p−1). For q = Q cos Ωt, Δ(2ζ̃ω̃) = 4c(p − 1)Q^(p−1)/(π(p + 1)Ω),
    with an error of the rule below 1e-4 (p from 1.05 to 2.95), and Δ(ω̃²) ≈ −cQ^(p−1).

    `coefficient` c in (kg^1/2 m)^(1−p)/s², `exponent` p between 1 and 3 (p = 2: uniform density).
    Reference: Segalman, ASME J. Appl. Mech. 72 (2005), 752, doi:10.1115/1.1989354.
    """

    kind: ClassVar[str] = "iwan_microslip"
    description: ClassVar[str] = (
        "A bolted joint with microslip: the stiffness decreases and the damping increases with a "
        "power of the amplitude."
    )
    shape: ClassVar[Shape] = _SLIP
    coefficient: Scalar = parameter(
        "(kg^1/2 m)^(1-exponent)/s²",
        "stiffness lost by slip at unit amplitude",
        rules=(NOT_NEGATIVE,),
        prior=NON_NEGATIVE,
        exponent="exponent",
    )
    exponent: Scalar = parameter(
        "1",
        "power of the backbone's amplitude",
        rules=(BETWEEN_ONE_AND_THREE,),
        prior=Prior(1.02, 2.98),
        typical=1.5,
    )
    largest_slip: Scalar | None = None  # kg^1/2 m, of the sliders for time integration

    def scaled_for(self, displacement: Scalar, velocity: Scalar) -> Self:
        return self.with_thresholds(displacement)

    def with_thresholds(self, largest: Scalar) -> Self:
        """The element with sliders up to the slip displacement `largest` (kg^1/2 m).

        Valid for motions with |q| up to `largest`: slip beyond it is missing.
        """
        return dataclasses.replace(self, largest_slip=jnp.asarray(largest, dtype=jnp.float64))

    def added_stiffness(self) -> Scalar:
        """Zero: the force is only the loss by slip, as the total stuck stiffness is unbounded."""
        return jnp.zeros(())

    def sliders(self) -> Sliders:
        """Raises `ValueError` before `with_thresholds`."""
        if self.largest_slip is None:
            raise InputError(
                "iwan_microslip has no states yet: `scaled_for` or `with_thresholds` must set its "
                "largest displacement first."
            )
        return self._sliders_up_to(self.largest_slip)

    def _sliders_up_to(self, largest: Scalar) -> Sliders:
        p = self.exponent
        # At rest the derivative of largest^(p−1) is infinite, but nothing slips.
        at_rest = largest <= 0
        total = self.coefficient * p * jnp.where(at_rest, 1.0, largest) ** (p - 1)
        stiffness = jnp.where(at_rest, 0.0, total) * WEIGHT
        return Sliders(stiffness, largest * jnp.asarray(NODE) ** (1 / (p - 1)))

    def cycle_force(self, displacement: Samples, velocity: Samples) -> Samples:
        # Sliders of all displacements: their sum has no corners but where the motion turns.
        path = with_extremes(displacement)
        sliders = self._sliders_up_to(0.5 * (jnp.max(path) - jnp.min(path)))
        return _settled(path, sliders.slip_displacement) @ -sliders.stiffness


class CoulombFriction(AbstractHysteresis):
    """f = F_c sgn q̇ (dry friction); 2ζ̃ω̃ rises by 4F_c/(πΩQ).

    `force` F_c in kg^1/2 m/s². No internal variables, but a jump, smoothed with the cycle's rms
    velocity: F_c tanh(q̇/(s q̇_rms)) with s = `smoothing`, 0.05. Its first harmonic is then 5.1e-4
    below F_c·4/π for a sinusoidal motion, and the force at rest is zero. In time integration it is
    F_c tanh(q̇/v_s) with v_s = `smoothing_velocity` in kg^1/2 m/s, or sgn q̇ if v_s = 0.
    """

    kind: ClassVar[str] = "coulomb_friction"
    description: ClassVar[str] = (
        "Dry friction: a force of constant magnitude against the velocity, most important at "
        "small amplitudes."
    )
    shape: ClassVar[Shape] = Shape(
        Part.DAMPING, Symmetry.ODD, Argument.VELOCITY, power=-1, factor=4 / np.pi
    )
    force: Scalar = parameter(
        "kg^1/2 m/s²", "friction force", rules=(NOT_NEGATIVE,), prior=NON_NEGATIVE
    )
    smoothing_velocity: Scalar = eqx.field(default_factory=lambda: jax.device_put(np.zeros(())))
    smoothing: Scalar = eqx.field(default_factory=lambda: jax.device_put(np.asarray(SMOOTHING)))

    def cycle_force(self, displacement: Samples, velocity: Samples) -> Samples:
        mean_square = jnp.mean(velocity**2)
        moving = mean_square > 0
        width = self.smoothing * jnp.sqrt(jnp.where(moving, mean_square, 1.0))
        return jnp.where(moving, self.force * jnp.tanh(velocity / width), 0.0)

    def scaled_for(self, displacement: Scalar, velocity: Scalar) -> Self:
        width = self.smoothing * jnp.asarray(velocity, dtype=jnp.float64)
        return dataclasses.replace(self, smoothing_velocity=width)

    def initial_states(self) -> States:
        return jnp.zeros(0)

    def state_force(self, displacement: Scalar, velocity: Scalar, states: States) -> Scalar:
        width = self.smoothing_velocity
        smooth = jnp.tanh(velocity / jnp.where(width > 0, width, 1.0))
        return self.force * jnp.where(width > 0, smooth, jnp.sign(velocity))

    def state_rate(self, displacement: Scalar, velocity: Scalar, states: States) -> States:
        return jnp.zeros(0)

    def settled_states(
        self, displacement: Samples, velocity: Samples
    ) -> Float[Array, "time state"]:
        return jnp.zeros((displacement.shape[0], 0))
