"""Friction with more than sliders on one displacement, for points of a structure: N and m."""

from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from snrmjax.model.effect_base import (
    AbstractHysteresis,
    Row,
    Samples,
    Scalar,
    StateAt,
    States,
    checked_row,
)
from snrmjax.model.effect_metadata import Argument, Part, Shape, Symmetry, parameter
from snrmjax.numerics.rules import AT_LEAST_ONE, FRACTION, NOT_NEGATIVE, POSITIVE

_PARTS = 4  # steps of the law on the way from one sample to the next
_MOST_CYCLES = 12  # until the force at the begin of a cycle is the one at its end


class BoucWen(AbstractHysteresis):
    """ḟ = k ẋ (1 − |f/F|ⁿ (b sgn(ẋf) + 1 − b)): hysteresis that rounds its corners.

    `stiffness` k of a small motion, `slip_force` F towards which the force saturates, `exponent` n
    (1: exponential approach; the larger, the sharper the knee, a slider of limit F in the end) and
    `unloading` b: with 0.5 the force falls with the stiffness k where the motion turns, with more
    of it steeper. In the usual letters ż = Aẋ − β|ẋ||z|ⁿ⁻¹z − γẋ|z|ⁿ, with f = k z, A = 1:
    β = b/z_yⁿ, γ = (1 − b)/z_yⁿ, z_y = F/k. A spring beside it belongs to the structure.
    On the mode of interest k is part of the linear frequency, as of a slider.

    The steady cycle is the fixed point of the law over one period, along the path of the samples
    with their turning points, which a parabola through three samples gives.
    Reference: Wen, ASCE J. Eng. Mech. Div. 102 (1976) 249, doi:10.1061/JMCEA3.0002106.
    """

    kind: ClassVar[str] = "bouc_wen"
    description: ClassVar[str] = "Hysteresis with a smooth passage from sticking to slipping."
    shape: ClassVar[Shape] = Shape(Part.STIFFNESS_AND_DAMPING, Symmetry.ODD, Argument.HISTORY)
    stiffness: Scalar = parameter("1/s²", "stiffness of a small motion", rules=(NOT_NEGATIVE,))
    slip_force: Scalar = parameter("kg^1/2 m/s²", "largest force", rules=(POSITIVE,))
    exponent: Scalar = parameter("1", "sharpness of the knee", rules=(AT_LEAST_ONE,))
    unloading: Scalar = parameter(
        "1", "share of the loss that changes sign with the motion", rules=(FRACTION,), typical=0.5
    )

    def stuck_stiffness(self) -> Float[Array, " row"]:
        return jnp.asarray(self.stiffness)[None]

    def initial_states(self) -> States:
        return jnp.zeros(1)

    def states_at_rest(self, displacement: StateAt) -> States:
        return jnp.clip(self.stiffness * displacement, -self.slip_force, self.slip_force)[None]

    def state_force(self, displacement: Scalar, velocity: Scalar, states: States) -> Scalar:
        return self._whole(displacement, states[0])

    def state_rate(self, displacement: Scalar, velocity: Scalar, states: States) -> States:
        return (velocity * self._slope(states[0], jnp.sign(velocity)))[None]

    def settled_states(
        self, displacement: Samples, velocity: Samples
    ) -> Float[Array, "time state"]:
        return self._settled(displacement)[:, None]

    def cycle_force(self, displacement: Samples, velocity: Samples) -> Samples:
        return self._whole(displacement, self._settled(displacement))

    def _whole(self, displacement: Array, force: Array) -> Array:
        return force - (self.stiffness * displacement if self.at is None else 0.0)

    def _slope(self, force: Array, direction: Array) -> Array:
        """df/dx where x goes up (1) or down (−1)."""
        fraction = jnp.abs(force) / self.slip_force
        # The derivative by the exponent holds at zero force too.
        power = jnp.where(
            fraction > 0, jnp.where(fraction > 0, fraction, 1.0) ** self.exponent, 0.0
        )
        side = direction * jnp.sign(force)
        return self.stiffness * (1 - power * (self.unloading * side + 1 - self.unloading))

    def _moved(self, force: Array, length: Array) -> Array:
        """The force after x went by `length` without turning, by Runge and Kutta's method."""
        direction = jnp.sign(length)
        a = self._slope(force, direction)
        b = self._slope(force + 0.5 * length * a, direction)
        c = self._slope(force + 0.5 * length * b, direction)
        d = self._slope(force + length * c, direction)
        moved = force + length * (a + 2 * b + 2 * c + d) / 6
        return jnp.clip(moved, -self.slip_force, self.slip_force)

    def _settled(self, x: Samples) -> Samples:
        """The force at the samples of the steady cycle."""
        ways = _ways(x)

        def pushed(law: BoucWen, ways: Array, begin: Array) -> tuple[Array, Array, Array, Array]:
            """Force at the end and at the samples, and their derivatives by that at the begin."""

            def along(begin: Array) -> tuple[Array, Array]:
                return jax.lax.scan(lambda f, way: (law._moved(f, way), f), begin, ways)

            (end, force), (slope, slopes) = jax.jvp(along, (begin,), (jnp.ones_like(begin),))
            return end, force[:: _PARTS + 1], slope, slopes[:: _PARTS + 1]

        fixed, way = jax.lax.stop_gradient((self, ways))

        def going(state: tuple[Array, Array, Array]) -> Array:
            _, miss, count = state
            return (count < _MOST_CYCLES) & (jnp.abs(miss) > 1e-13 * fixed.slip_force)

        def newton(state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
            begin, _, count = state
            end, _, slope, _ = pushed(fixed, way, begin)
            # In a motion that hardly slips every force is that of some steady cycle.
            miss = (end - begin) / jnp.maximum(1 - slope, 1e-9)
            return begin + miss, jnp.where(slope < 1 - 1e-9, miss, 0.0), count + 1

        first = jax.lax.stop_gradient(self.states_at_rest(x[0])[0])
        start = (first, jnp.inf + 0 * first, jnp.array(0))
        begin, _, _ = jax.lax.while_loop(going, newton, start)
        end, force, *slopes = pushed(self, ways, begin)
        slope, follows = jax.lax.stop_gradient(slopes)
        # The begin moves with what the cycle depends on, and all samples with it.
        return force + follows * (end - begin) / jnp.maximum(1 - slope, 1e-9)


def _ways(x: Samples) -> Float[Array, " way"]:
    """From every sample to the next, in parts up to a turning point between them and on from it."""
    ahead, behind = jnp.roll(x, -1), jnp.roll(x, 1)
    bend = 2 * x - ahead - behind
    extreme = (ahead - x) * (x - behind) < 0
    safe = jnp.where(extreme, bend, 1.0)
    lead = jnp.where(extreme, 0.5 * (ahead - behind) / safe, 0.0)  # in samples, from this one
    beyond = jnp.where(extreme, (ahead - behind) ** 2 / (8 * safe), 0.0)
    here, there = extreme & (lead >= 0), jnp.roll(extreme & (lead < 0), -1)
    top = jnp.where(here, x + beyond, jnp.where(there, ahead + jnp.roll(beyond, -1), ahead))
    before = jnp.repeat((top - x)[:, None] / _PARTS, _PARTS, axis=1)
    return jnp.concatenate([before, (ahead - top)[:, None]], axis=1).reshape(-1)


class FrictionContact(AbstractHysteresis):
    """A spring k_t against a surface that k_n presses: it slips at μN and may come off.

    N = max(N₀ + k_n x_n, 0) with the compression x_n, at `normal_at`; along the surface, at `at`,
    f = k_t (x − z) with |f| ≤ μN. Across it the force is N − N₀: the `preload` N₀ is in balance
    at rest. Without a preload a `static_load` may press the contact. Whether a motion with it is
    stable is not computed.
    `stiffness` k_t, `normal_stiffness` k_n, `friction` μ, `preload` N₀.

    From sample to sample f ↦ clip(f + k_t Δx, ±μN), Δx from where the contact closes; such maps are
    closed under composition, so that the second cycle is the steady one.
    Reference: Yang, Chu & Menq, J. Sound Vib. 210 (1998) 461, doi:10.1006/jsvi.1997.1305.
    """

    kind: ClassVar[str] = "friction_contact"
    description: ClassVar[str] = "Dry friction whose normal force moves, with separation."
    shape: ClassVar[Shape] = Shape(Part.STIFFNESS_AND_DAMPING, Symmetry.NEITHER, Argument.HISTORY)
    held_in_steps: ClassVar[bool] = True
    stiffness: Scalar = parameter("1/s²", "tangential stiffness", rules=(POSITIVE,))
    normal_stiffness: Scalar = parameter("1/s²", "normal stiffness", rules=(NOT_NEGATIVE,))
    friction: Scalar = parameter("1", "coefficient of friction", rules=(NOT_NEGATIVE,))
    preload: Scalar = parameter("kg^1/2 m/s²", "normal force at rest", rules=(NOT_NEGATIVE,))
    normal_at: Row | None = eqx.field(
        default=None, static=True, kw_only=True, converter=checked_row
    )

    def __check_init__(self) -> None:
        if self.at is None or self.normal_at is None:
            raise ValueError(
                "friction_contact needs two places: `at` (or `between`) along the surface and "
                "`normal_at` across it."
            )

    @property
    def rows(self) -> tuple[Row | None, ...]:
        return self.at, self.normal_at

    def stuck_stiffness(self) -> Float[Array, " row"]:
        return jnp.stack([jnp.asarray(self.stiffness), jnp.asarray(self.normal_stiffness)])

    def pressure(self, compression: Array) -> Array:
        """The normal force N."""
        return jnp.maximum(self.preload + self.normal_stiffness * compression, 0.0)

    def initial_states(self) -> States:
        """The slider's position."""
        return jnp.zeros(1)

    def states_at_rest(self, displacement: StateAt) -> States:
        return self._held(displacement, self.initial_states())

    def _held(self, displacement: Float[Array, " row"], states: States) -> States:
        reach = self.friction * self.pressure(displacement[1]) / self.stiffness
        return jnp.clip(states, displacement[0] - reach, displacement[0] + reach)

    def state_force(self, displacement: StateAt, velocity: StateAt, states: States) -> StateAt:
        stretch = displacement[0] - self._held(displacement, states)[0]
        return jnp.stack([self.stiffness * stretch, self.pressure(displacement[1]) - self.preload])

    def state_rate(self, displacement: StateAt, velocity: StateAt, states: States) -> States:
        """None within a step: see `after_step`."""
        return jnp.zeros_like(states)

    def after_step(self, states: States, begin: tuple, end: tuple, time: Array) -> States:
        """The slider, pushed to where its bounds turn within the step and then to its end."""
        (x0, v0), (x1, v1) = begin, end
        for side in (1.0, -1.0):
            fraction = side * self.friction * self.normal_stiffness / self.stiffness
            rates = []
            for x, v in ((x0, v0), (x1, v1)):
                closed = self.pressure(x[1]) > 0
                rates.append(v[0] + jnp.where(closed, fraction * v[1], 0.0))
            turns = rates[0] * rates[1] < 0
            until = time * rates[0] / jnp.where(turns, rates[0] - rates[1], 1.0)
            there = x0 + (v0 + 0.5 * (v1 - v0) * until / time) * until
            states = jnp.where(turns, self._held(there, states), states)
        return self._held(x1, states)

    def settled_states(
        self, displacement: Float[Array, "time row"], velocity: Float[Array, "time row"]
    ) -> Float[Array, "time state"]:
        along = self.cycle_force(displacement, velocity)[:, 0]
        return (displacement[:, 0] - along / self.stiffness)[:, None]

    def cycle_force(
        self, displacement: Float[Array, "time row"], velocity: Float[Array, "time row"]
    ) -> Float[Array, "time row"]:
        normal = self.pressure(displacement[:, 1])
        x, limit = displacement[:, 0], self.friction * normal
        # Where it closes between two samples, the spring is loaded from there.
        signed = self.preload + self.normal_stiffness * displacement[:, 1]
        before = jnp.roll(signed, 1)
        closes = (before < 0) & (signed > 0)
        loads = jnp.where(closes, signed / jnp.where(closes, signed - before, 1.0), 1.0)

        def moved(force: Array, sample: tuple[Array, Array]) -> tuple[Array, Array]:
            way, most = sample
            force = jnp.clip(force + self.stiffness * way, -most, most)
            return force, force

        samples = (loads * (x - jnp.roll(x, 1)), limit)
        start = jnp.clip(self.stiffness * x[-1], -limit[-1], limit[-1])
        settled, _ = jax.lax.scan(moved, start, samples)
        _, along = jax.lax.scan(moved, settled, samples)
        return jnp.stack([along, normal - self.preload], axis=1)
