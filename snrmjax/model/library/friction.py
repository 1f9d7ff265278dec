"""Friction: forces that depend on the way the motion took, and on its direction.

A slider with the stuck stiffness k_t and the slip displacement x_s is a spring k_t to a block
that rests on a friction surface. The block's position z is pushed along where the spring's
stretch q − z would exceed ±x_s (the "play" of q). The linear frequency is that of the stuck
structure, so what a slider adds is k_t (q − z) − k_t q = −k_t z: nothing before the first slip.

Reference: Iwan, ASME J. Appl. Mech. 33 (1966), 893, doi:10.1115/1.3625199.
"""

from abc import abstractmethod
from collections.abc import Mapping
from typing import ClassVar, NamedTuple, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from snrmjax.model.effect_base import AbstractHysteresis, Scalar
from snrmjax.numerics.rules import BETWEEN_ONE_AND_THREE, NOT_NEGATIVE, POSITIVE, Rule

SMOOTHING = 0.05  # width of the smoothed jump of Coulomb's force over the rms velocity
# In w = u^(p−1) on (0, 1), where the thresholds of an Iwan element are evenly dense.
_NODE, _WEIGHT = (0.5 * part for part in np.polynomial.legendre.leggauss(48))
_NODE = _NODE + 0.5


class Sliders(NamedTuple):
    """Sliders side by side."""

    stiffness: Float[Array, " slider"]  # k_t, 1/s²
    slip_displacement: Float[Array, " slider"]  # x_s, kg^1/2 m


def settled_positions(
    displacement: Float[Array, " time"], slip_displacement: Float[Array, " slider"]
) -> Float[Array, "time slider"]:
    """Positions of sliders over the steady cycle of a periodic motion, in kg^1/2 m.

    z ↦ clip(z, q − x_s, q + x_s) from sample to sample, from z = 0. Such maps are closed under
    composition, and that of a whole cycle changes nothing when it is applied twice: the second
    cycle is exactly the steady one. A slider that never slips stays where the first approach
    from rest to sample 0 left it.

    Every position is a sample of q plus or minus x_s, or 0. Which one is found without
    derivatives; the derivatives are then those of picking it: exact, and cheap for many tangents.
    """
    n = displacement.shape[0]
    q, slip = jax.lax.stop_gradient((displacement, slip_displacement))
    untouched = 2 * n

    def moved(
        before: tuple[Array, Array], sample: tuple[Array, Array]
    ) -> tuple[tuple[Array, Array], Array]:
        (position, source), (at, k) = before, sample
        dragged_up, dragged_down = position < at - slip, position > at + slip
        source = jnp.where(dragged_up, k, jnp.where(dragged_down, k + n, source))
        return (jnp.clip(position, at - slip, at + slip), source), source

    samples = (q, jnp.arange(n, dtype=jnp.int32))
    rest = (jnp.zeros_like(slip), jnp.full(slip.shape, untouched, dtype=jnp.int32))
    settled, _ = jax.lax.scan(moved, rest, samples)
    sources: Int[Array, "time slider"]
    _, sources = jax.lax.scan(moved, settled, samples)
    picked = displacement[jnp.where(sources == untouched, 0, sources % n)]
    position = picked + jnp.where(sources < n, -1.0, 1.0) * slip_displacement
    return jnp.where(sources == untouched, 0.0, position)


class AbstractSliders(AbstractHysteresis):
    """Friction by sliders side by side; the states are their positions in kg^1/2 m."""

    @abstractmethod
    def sliders(self) -> Sliders:
        """The sliders, for integration in time."""

    def initial_states(self) -> Float[Array, " state"]:
        """See `AbstractHysteresis.initial_states`."""
        return jnp.zeros_like(self.sliders().slip_displacement)

    def state_force(
        self, displacement: Scalar, velocity: Scalar, states: Float[Array, " state"]
    ) -> Scalar:
        """See `AbstractHysteresis.state_force`; positions that an integrator left are corrected."""
        return -jnp.sum(self.sliders().stiffness * self.moved_states(displacement, states))

    def state_rate(
        self, displacement: Scalar, velocity: Scalar, states: Float[Array, " state"]
    ) -> Float[Array, " state"]:
        """See `AbstractHysteresis.state_rate`: ż = q̇ while a slider is dragged, otherwise 0."""
        stretch, slip = displacement - states, self.sliders().slip_displacement
        dragged = jnp.where(velocity > 0, stretch >= slip, stretch <= -slip)
        return jnp.where(dragged, velocity, 0.0)

    def moved_states(
        self, displacement: Scalar, states: Float[Array, " state"]
    ) -> Float[Array, " state"]:
        """Positions after q went to `displacement` without turning: exact, unlike an integrator.

        An integrator of fixed steps does best to call this after each of them.
        """
        slip = self.sliders().slip_displacement
        return jnp.clip(states, displacement - slip, displacement + slip)

    def settled_states(
        self, displacement: Float[Array, " time"], velocity: Float[Array, " time"]
    ) -> Float[Array, "time state"]:
        """See `AbstractHysteresis.settled_states`."""
        return settled_positions(displacement, self.sliders().slip_displacement)


class JenkinsSlider(AbstractSliders):
    """A spring k_t that slips at x_s: f = k_t (q − z) − k_t q with |q − z| ≤ x_s.

    `stiffness` k_t in 1/s², `slip_displacement` x_s in kg^1/2 m; k_t is part of the linear
    frequency. For q = Q cos Ωt and Q > x_s, with cos θ = 1 − 2x_s/Q,
    Δ(ω̃²) = (k_t/π)(θ − sin θ cos θ) − k_t and Δ(2ζ̃ω̃) = 4k_t x_s(Q − x_s)/(πΩQ²).
    """

    kind: ClassVar[str] = "jenkins_slider"
    rules: ClassVar[Mapping[str, tuple[Rule, ...]]] = {
        "stiffness": (NOT_NEGATIVE,),
        "slip_displacement": (POSITIVE,),
    }
    stiffness: Scalar
    slip_displacement: Scalar

    def sliders(self) -> Sliders:
        """See `AbstractSliders.sliders`."""
        return Sliders(jnp.asarray(self.stiffness)[None], jnp.asarray(self.slip_displacement)[None])

    def cycle_force(
        self, displacement: Float[Array, " time"], velocity: Float[Array, " time"]
    ) -> Float[Array, " time"]:
        """See `AbstractForce.cycle_force`; the direction of time is the samples' own."""
        return self.settled_states(displacement, velocity) @ -self.sliders().stiffness


class IwanMicroslip(AbstractSliders):
    """Microslip of a joint: backbone −c|x|^p sgn x and Masing's rule, by many sliders.

    Sliders with every slip displacement s and the stiffness density c p (p − 1) s^(p−2):
    f = −∫₀^R c p (p − 1) s^(p−2) z_s ds, where R is half the range of q over the cycle; sliders
    above R do not slip and, being part of the linear frequency, add nothing. By Gauss's rule
    with 48 points in w = (s/R)^(p−1). For q = Q cos Ωt, Δ(2ζ̃ω̃) = 4c(p − 1)Q^(p−1)/(π(p + 1)Ω),
    from which the rule is off by less than 1e-4 (p from 1.05 to 2.95), and Δ(ω̃²) ≈ −cQ^(p−1).

    `coefficient` c in (kg^1/2 m)^(1−p)/s², `exponent` p between 1 and 3 (p = 2: evenly dense).
    Reference: Segalman, ASME J. Appl. Mech. 72 (2005), 752, doi:10.1115/1.1989354.
    """

    kind: ClassVar[str] = "iwan_microslip"
    rules: ClassVar[Mapping[str, tuple[Rule, ...]]] = {
        "coefficient": (NOT_NEGATIVE,),
        "exponent": (BETWEEN_ONE_AND_THREE,),
    }
    coefficient: Scalar
    exponent: Scalar
    largest_slip: Scalar | None = None  # kg^1/2 m, of the sliders for integration in time

    def scaled_for(self, displacement: Scalar, velocity: Scalar) -> Self:
        """See `AbstractHysteresis.scaled_for`."""
        return self.with_thresholds(displacement)

    def with_thresholds(self, largest: Scalar) -> Self:
        """The element with sliders up to the slip displacement `largest` (kg^1/2 m).

        They hold for motions with |q| up to `largest`: beyond it, slip is missing.
        """
        fields = (self.coefficient, self.exponent, jnp.asarray(largest, dtype=jnp.float64))
        return type(self)(*fields)

    def sliders(self) -> Sliders:
        """See `AbstractSliders.sliders`. Raises `ValueError` before `with_thresholds`."""
        if self.largest_slip is None:
            raise ValueError(
                "iwan_microslip has no states yet: `scaled_for` or `with_thresholds` must set the "
                "largest displacement first."
            )
        return self._sliders_up_to(self.largest_slip)

    def _sliders_up_to(self, largest: Scalar) -> Sliders:
        p = self.exponent
        # At rest the derivative of largest^(p−1) is infinite, but nothing slips.
        at_rest = largest <= 0
        total = self.coefficient * p * jnp.where(at_rest, 1.0, largest) ** (p - 1)
        stiffness = jnp.where(at_rest, 0.0, total) * _WEIGHT
        return Sliders(stiffness, largest * jnp.asarray(_NODE) ** (1 / (p - 1)))

    def cycle_force(
        self, displacement: Float[Array, " time"], velocity: Float[Array, " time"]
    ) -> Float[Array, " time"]:
        """See `AbstractForce.cycle_force`; what happened before the cycle leaves no trace."""
        half_range = 0.5 * (jnp.max(displacement) - jnp.min(displacement))
        sliders = self._sliders_up_to(half_range)
        return settled_positions(displacement, sliders.slip_displacement) @ -sliders.stiffness


class CoulombFriction(AbstractHysteresis):
    """f = F_c sgn q̇ (dry friction); 2ζ̃ω̃ rises by 4F_c/(πΩQ).

    `force` F_c in kg^1/2 m/s². No memory, but a jump, which is smoothed with the cycle's own
    velocity: F_c tanh(q̇/(0.05 q̇_rms)). Its first harmonic is then 5.1e-4 below F_c·4/π for a
    sinusoidal motion, and a motion at rest meets no force. In time it is F_c tanh(q̇/v_s) with
    v_s = `smoothing_velocity` in kg^1/2 m/s, or sgn q̇ where v_s = 0.
    """

    kind: ClassVar[str] = "coulomb_friction"
    rules: ClassVar[Mapping[str, tuple[Rule, ...]]] = {"force": (NOT_NEGATIVE,)}
    force: Scalar
    smoothing_velocity: Scalar = eqx.field(default_factory=lambda: jnp.zeros(()))

    def cycle_force(
        self, displacement: Float[Array, " time"], velocity: Float[Array, " time"]
    ) -> Float[Array, " time"]:
        """See `AbstractForce.cycle_force`."""
        mean_square = jnp.mean(velocity**2)
        moving = mean_square > 0
        width = SMOOTHING * jnp.sqrt(jnp.where(moving, mean_square, 1.0))
        return jnp.where(moving, self.force * jnp.tanh(velocity / width), 0.0)

    def scaled_for(self, displacement: Scalar, velocity: Scalar) -> Self:
        """See `AbstractHysteresis.scaled_for`."""
        return type(self)(self.force, SMOOTHING * jnp.asarray(velocity, dtype=jnp.float64))

    def initial_states(self) -> Float[Array, " state"]:
        """See `AbstractHysteresis.initial_states`: there are none."""
        return jnp.zeros(0)

    def state_force(
        self, displacement: Scalar, velocity: Scalar, states: Float[Array, " state"]
    ) -> Scalar:
        """See `AbstractHysteresis.state_force`."""
        width = self.smoothing_velocity
        smooth = jnp.tanh(velocity / jnp.where(width > 0, width, 1.0))
        return self.force * jnp.where(width > 0, smooth, jnp.sign(velocity))

    def state_rate(
        self, displacement: Scalar, velocity: Scalar, states: Float[Array, " state"]
    ) -> Float[Array, " state"]:
        """See `AbstractHysteresis.state_rate`: there are none."""
        return jnp.zeros(0)

    def settled_states(
        self, displacement: Float[Array, " time"], velocity: Float[Array, " time"]
    ) -> Float[Array, "time state"]:
        """See `AbstractHysteresis.settled_states`: there are none."""
        return jnp.zeros((displacement.shape[0], 0))
