"""Bouc–Wen hysteresis and contact with variable normal force, at points: N and m."""

from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from snrmjax.model.effect_base import (
    AbstractHysteresis,
    InfluenceVector,
    Samples,
    Scalar,
    StateAt,
    States,
    checked_influence_vector,
)
from snrmjax.model.effect_metadata import Argument, Part, Shape, Symmetry, parameter
from snrmjax.numerics.rules import AT_LEAST_ONE, FRACTION, NOT_NEGATIVE, POSITIVE, InputError

_PARTS = 4  # integration steps from one sample to the next
_MOST_CYCLES = 12  # Newton iterations for a periodic force


class BoucWen(AbstractHysteresis):
    """ḟ = k ẋ (1 − |f/F|ⁿ (b sgn(ẋf) + 1 − b)): Bouc–Wen hysteresis.

    `stiffness` k for small motion, saturation force `slip_force` F, `exponent` n (1: exponential
    approach; the larger, the sharper the knee, a Jenkins slider of limit F for n → ∞) and
    `unloading` b: with 0.5 unloading starts with the stiffness k, with a larger value it is
    steeper. In the usual symbols ż = Aẋ − β|ẋ||z|ⁿ⁻¹z − γẋ|z|ⁿ, with f = k z, A = 1:
    β = b/z_yⁿ, γ = (1 − b)/z_yⁿ, z_y = F/k. A parallel spring belongs to the structure.
    On the mode of interest k is part of the linear frequency, as for a slider.

    The steady cycle is the periodic solution of the law along the path of the samples and their
    turning points, which are located by a parabola through three samples.
    Reference: Wen, ASCE J. Eng. Mech. Div. 102 (1976) 249, doi:10.1061/JMCEA3.0002106.
    """

    kind: ClassVar[str] = "bouc_wen"
    description: ClassVar[str] = "Hysteresis with a smooth transition from stick to slip."
    shape: ClassVar[Shape] = Shape(Part.STIFFNESS_AND_DAMPING, Symmetry.ODD, Argument.HISTORY)
    stiffness: Scalar = parameter("1/s²", "stiffness for small motion", rules=(NOT_NEGATIVE,))
    slip_force: Scalar = parameter("kg^1/2 m/s²", "largest force", rules=(POSITIVE,))
    exponent: Scalar = parameter("1", "sharpness of the knee", rules=(AT_LEAST_ONE,))
    unloading: Scalar = parameter(
        "1",
        "fraction of the stiffness loss that changes sign with the velocity",
        rules=(FRACTION,),
        typical=0.5,
    )

    def stuck_stiffness(self) -> Float[Array, " attachment"]:
        return jnp.asarray(self.stiffness)[None]

    def initial_states(self) -> States:
        return jnp.zeros(1)

    def states_at_rest(self, displacement: StateAt) -> States:
        return jnp.clip(self.stiffness * displacement, -self.slip_force, self.slip_force)[None]

    def state_force(self, displacement: Scalar, velocity: Scalar, states: States) -> Scalar:
        return self._element_force(displacement, states[0])

    def state_rate(self, displacement: Scalar, velocity: Scalar, states: States) -> States:
        return (velocity * self._tangent(states[0], jnp.sign(velocity)))[None]

    def settled_states(
        self, displacement: Samples, velocity: Samples
    ) -> Float[Array, "time state"]:
        return self._settled(displacement)[:, None]

    def cycle_force(self, displacement: Samples, velocity: Samples) -> Samples:
        return self._element_force(displacement, self._settled(displacement))

    def _element_force(self, displacement: Array, force: Array) -> Array:
        return force - (self.stiffness * displacement if self.at is None else 0.0)

    def _tangent(self, force: Array, direction: Array) -> Array:
        """df/dx for increasing (1) or decreasing (−1) x."""
        fraction = jnp.abs(force) / self.slip_force
        # A finite derivative with respect to the exponent at zero force too.
        power = jnp.where(
            fraction > 0, jnp.where(fraction > 0, fraction, 1.0) ** self.exponent, 0.0
        )
        sign = direction * jnp.sign(force)
        return self.stiffness * (1 - power * (self.unloading * sign + 1 - self.unloading))

    def _moved(self, force: Array, length: Array) -> Array:
        """The force after a monotonic change of x by `length`, by one Runge–Kutta step."""
        direction = jnp.sign(length)
        a = self._tangent(force, direction)
        b = self._tangent(force + 0.5 * length * a, direction)
        c = self._tangent(force + 0.5 * length * b, direction)
        d = self._tangent(force + length * c, direction)
        moved = force + length * (a + 2 * b + 2 * c + d) / 6
        return jnp.clip(moved, -self.slip_force, self.slip_force)

    def _settled(self, x: Samples) -> Samples:
        """The force at the samples of the steady cycle, by Newton's method on its initial value."""
        path = _path(x)

        def integrated(
            law: BoucWen, path: Array, begin: Array
        ) -> tuple[Array, Array, Array, Array]:
            """Force at the end and at the samples, and their derivatives by `begin`."""

            def along(begin: Array) -> tuple[Array, Array]:
                return jax.lax.scan(lambda f, increment: (law._moved(f, increment), f), begin, path)

            (end, force), (slope, slopes) = jax.jvp(along, (begin,), (jnp.ones_like(begin),))
            return end, force[:: _PARTS + 1], slope, slopes[:: _PARTS + 1]

        fixed, fixed_path = jax.lax.stop_gradient((self, path))

        def unconverged(state: tuple[Array, Array, Array]) -> Array:
            _, residual, count = state
            return (count < _MOST_CYCLES) & (jnp.abs(residual) > 1e-13 * fixed.slip_force)

        def newton(state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
            begin, _, count = state
            end, _, slope, _ = integrated(fixed, fixed_path, begin)
            # Almost without slip every initial force belongs to a steady cycle.
            residual = (end - begin) / jnp.maximum(1 - slope, 1e-9)
            return begin + residual, jnp.where(slope < 1 - 1e-9, residual, 0.0), count + 1

        first = jax.lax.stop_gradient(self.states_at_rest(x[0])[0])
        start = (first, jnp.inf + 0 * first, jnp.array(0))
        begin, _, _ = jax.lax.while_loop(unconverged, newton, start)
        end, force, *slopes = integrated(self, path, begin)
        slope, follows = jax.lax.stop_gradient(slopes)
        # Implicit differentiation: the initial force depends on all inputs, and all samples on it.
        return force + follows * (end - begin) / jnp.maximum(1 - slope, 1e-9)


def _path(x: Samples) -> Float[Array, " increment"]:
    """Increments from every sample to the next, split at a turning point between them."""
    ahead, behind = jnp.roll(x, -1), jnp.roll(x, 1)
    curvature = 2 * x - ahead - behind
    extreme = (ahead - x) * (x - behind) < 0
    safe = jnp.where(extreme, curvature, 1.0)
    lead = jnp.where(extreme, 0.5 * (ahead - behind) / safe, 0.0)  # in samples, from this one
    beyond = jnp.where(extreme, (ahead - behind) ** 2 / (8 * safe), 0.0)
    after_sample, before_next = extreme & (lead >= 0), jnp.roll(extreme & (lead < 0), -1)
    top = jnp.where(
        after_sample, x + beyond, jnp.where(before_next, ahead + jnp.roll(beyond, -1), ahead)
    )
    before = jnp.repeat((top - x)[:, None] / _PARTS, _PARTS, axis=1)
    return jnp.concatenate([before, (ahead - top)[:, None]], axis=1).reshape(-1)


class FrictionContact(AbstractHysteresis):
    """A friction contact with tangential spring k_t and normal spring k_n: slip at μN, separation.

    N = max(N₀ + k_n x_n, 0) with the compression x_n at `normal_at`; in tangential direction, at
    `at`, f = k_t (x − z) with |f| ≤ μN. The normal force on the structure is N − N₀: the `preload`
    N₀ is in equilibrium at rest. Without a preload a `static_preload` may close the contact. The
    stability of motions with it is not computed.
    `stiffness` k_t, `normal_stiffness` k_n, `friction` μ, `preload` N₀.

    From sample to sample f ↦ clip(f + k_t Δx, ±μN), Δx counted from the closing of the contact;
    such maps are closed under composition, so that the second cycle is the steady one.
    Reference: Yang, Chu & Menq, J. Sound Vib. 210 (1998) 461, doi:10.1006/jsvi.1997.1305.
    """

    kind: ClassVar[str] = "friction_contact"
    description: ClassVar[str] = "Dry friction with variable normal force and separation."
    shape: ClassVar[Shape] = Shape(Part.STIFFNESS_AND_DAMPING, Symmetry.NEITHER, Argument.HISTORY)
    constant_in_steps: ClassVar[bool] = True
    stiffness: Scalar = parameter("1/s²", "tangential stiffness", rules=(POSITIVE,))
    normal_stiffness: Scalar = parameter("1/s²", "normal stiffness", rules=(NOT_NEGATIVE,))
    friction: Scalar = parameter("1", "coefficient of friction", rules=(NOT_NEGATIVE,))
    preload: Scalar = parameter("kg^1/2 m/s²", "normal force at rest", rules=(NOT_NEGATIVE,))
    normal_at: InfluenceVector | None = eqx.field(
        default=None, static=True, kw_only=True, converter=checked_influence_vector
    )

    def __check_init__(self) -> None:
        if self.at is None or self.normal_at is None:
            raise InputError(
                "friction_contact needs two attachments: `at` (or `between`) along the surface and "
                "`normal_at` across it."
            )

    @property
    def influence_vectors(self) -> tuple[InfluenceVector | None, ...]:
        return self.at, self.normal_at

    def stuck_stiffness(self) -> Float[Array, " attachment"]:
        return jnp.stack([jnp.asarray(self.stiffness), jnp.asarray(self.normal_stiffness)])

    def normal_force(self, compression: Array) -> Array:
        """The normal force N."""
        return jnp.maximum(self.preload + self.normal_stiffness * compression, 0.0)

    def initial_states(self) -> States:
        """The slider's position."""
        return jnp.zeros(1)

    def states_at_rest(self, displacement: StateAt) -> States:
        return self._slider(displacement, self.initial_states())

    def _slider(self, displacement: Float[Array, " attachment"], states: States) -> States:
        reach = self.friction * self.normal_force(displacement[1]) / self.stiffness
        return jnp.clip(states, displacement[0] - reach, displacement[0] + reach)

    def state_force(self, displacement: StateAt, velocity: StateAt, states: States) -> StateAt:
        stretch = displacement[0] - self._slider(displacement, states)[0]
        return jnp.stack(
            [self.stiffness * stretch, self.normal_force(displacement[1]) - self.preload]
        )

    def state_rate(self, displacement: StateAt, velocity: StateAt, states: States) -> States:
        """Zero within a step: see `after_step`."""
        return jnp.zeros_like(states)

    def after_step(self, states: States, begin: tuple, end: tuple, time: Array) -> States:
        """The slider's position, via the turning points of its bounds within the step."""
        (x0, v0), (x1, v1) = begin, end
        for sign in (1.0, -1.0):
            fraction = sign * self.friction * self.normal_stiffness / self.stiffness
            rates = []
            for x, v in ((x0, v0), (x1, v1)):
                closed = self.normal_force(x[1]) > 0
                rates.append(v[0] + jnp.where(closed, fraction * v[1], 0.0))
            reverses = rates[0] * rates[1] < 0
            until = time * rates[0] / jnp.where(reverses, rates[0] - rates[1], 1.0)
            x_turn = x0 + (v0 + 0.5 * (v1 - v0) * until / time) * until
            states = jnp.where(reverses, self._slider(x_turn, states), states)
        return self._slider(x1, states)

    def settled_states(
        self,
        displacement: Float[Array, "time attachment"],
        velocity: Float[Array, "time attachment"],
    ) -> Float[Array, "time state"]:
        along = self.cycle_force(displacement, velocity)[:, 0]
        return (displacement[:, 0] - along / self.stiffness)[:, None]

    def cycle_force(
        self,
        displacement: Float[Array, "time attachment"],
        velocity: Float[Array, "time attachment"],
    ) -> Float[Array, "time attachment"]:
        normal = self.normal_force(displacement[:, 1])
        x, limit = displacement[:, 0], self.friction * normal
        # If it closes between two samples, the spring is loaded from the closing on.
        signed = self.preload + self.normal_stiffness * displacement[:, 1]
        before = jnp.roll(signed, 1)
        closes = (before < 0) & (signed > 0)
        loads = jnp.where(closes, signed / jnp.where(closes, signed - before, 1.0), 1.0)

        def moved(force: Array, sample: tuple[Array, Array]) -> tuple[Array, Array]:
            increment, bound = sample
            force = jnp.clip(force + self.stiffness * increment, -bound, bound)
            return force, force

        samples = (loads * (x - jnp.roll(x, 1)), limit)
        start = jnp.clip(self.stiffness * x[-1], -limit[-1], limit[-1])
        settled, _ = jax.lax.scan(moved, start, samples)
        _, along = jax.lax.scan(moved, settled, samples)
        return jnp.stack([along, normal - self.preload], axis=1)
