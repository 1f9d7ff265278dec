"""Prescribed motion: the fundamental at one sensor is given and the force is solved for.

At a given frequency a force may have several motions or, beyond a fold, none; a motion has one
force. So a measured motion is inserted into the harmonic balance, which is solved for the force.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float, Int

from snrmjax.model.structures import Structure, simulated_structure
from snrmjax.numerics.newton import newton
from snrmjax.simulate.balance.harmonic_balance import HarmonicBalance, harmonic_balance
from snrmjax.simulate.balance.harmonics import displacement_phasors, velocity_phasors

# Amplitude continuation, in fractions of the measured velocity: start, first and least step.
_SMALL, _FIRST, _SHORTEST = 1e-3, 0.15, 2e-3
_SECANTS = 20  # most quasi-Newton steps with one updated Jacobian
_CLOSE = 1e-5  # relative quasi-Newton step at which the error is far below any noise


class Secants(NamedTuple):
    """A point and the steps that led to it, which define Broyden's updates of the Jacobian.

    Reference: C. T. Kelley, Iterative Methods for Linear and Nonlinear Equations (1995), section
    7.3, doi:10.1137/1.9781611970944.
    """

    point: Float[Array, " unknown"]
    moves: Float[Array, "step unknown"]
    taken: Int[Array, ""]

    def updated(self, move: Float[Array, " unknown"]) -> Float[Array, " unknown"]:
        """A step by the initial inverse Jacobian, corrected by the updates of all steps but one."""

        def update(k: Array, move: Array) -> Array:
            now, further = self.moves[k], self.moves[k + 1]
            return move + (now @ move) / (now @ now) * further

        return jax.lax.fori_loop(0, self.taken - 1, update, move)


def start_of(point: Float[Array, " unknown"]) -> Secants:
    """A starting point, without updates."""
    zero = batched_zero(point)
    return Secants(point, zero + jnp.zeros((_SECANTS, point.shape[0])), zero.astype(int))


def batched_zero(point: Float[Array, " unknown"]) -> Float[Array, ""]:
    """Zero, batched like the point.

    With a fully batched initial state a `vmap` of a loop is traced once; otherwise JAX traces it
    repeatedly to find out what is batched.
    """
    return jnp.where(point[0] == 0, 0.0, 0.0)


def newton_solved(
    problem: Any, start: Float[Array, " unknown"]
) -> tuple[Float[Array, " unknown"], Float[Array, "unknown unknown"]]:
    """The solution of a problem's `equations` near `start`, and the Jacobian of its last step.

    By Newton's method with the problem's `linearised`; NaN if it did not converge. The last step is
    differentiable and carries the derivatives, by the implicit function theorem.
    """
    fixed, begin = jax.lax.stop_gradient((problem, start))
    root = newton(fixed.linearised, begin)
    point, good = root.one_more(problem.equations(root.point))
    return jnp.where(good, point, jnp.nan), root.jacobian


class PrescribedMotion(eqx.Module):
    """The equations of one state: its balance, and its fundamental equal to the measured one.

    A point holds the balance's scaled displacements and the cosine and sine parts of the force,
    over `force`; phases are relative to the measured force.
    """

    balance: HarmonicBalance  # without a force
    model: Structure
    frequency: Float[Array, ""]  # rad/s
    force: Float[Array, ""]  # N, measured
    velocity: Complex[Array, ""]  # m/s, of the reference sensor
    sensor: int = eqx.field(static=True)

    def equations(self, point: Float[Array, " unknown"]) -> Float[Array, " unknown"]:
        """Residuals of the balance and of the fundamental."""
        residual = self.balance.residual(self._balance_point(point))
        return jnp.concatenate([residual - self._load(point[-2:]), self._miss(point)])

    def linearised(self, point: Float[Array, " unknown"]) -> tuple[Array, Array]:
        """The equations and their exact Jacobian."""
        residual, jacobian = self.balance.linearised(self._balance_point(point))
        left = jnp.concatenate([residual - self._load(point[-2:]), self._miss(point)])
        wide = jnp.concatenate([jacobian[:, :-1], -jax.jacfwd(self._load)(point[-2:])], axis=1)
        return left, jnp.concatenate([wide, jax.jacrev(self._miss)(point)])

    def recorded(self, point: Float[Array, " unknown"]) -> tuple[Array, Array]:
        """Complex force (N) and velocity (harmonic, sensor) as the instruments record them."""
        modes = simulated_structure(self.model).modes
        coefficients = self.balance.coefficients(self._balance_point(point))
        velocity = velocity_phasors(coefficients, self.frequency, modes.mode_shape)
        force = self.force * (point[-2] - 1j * point[-1])
        # Phases relative to the actual force, as the instruments record them.
        order = jnp.arange(velocity.shape[0])[:, None]
        phase = force / jnp.abs(force)
        velocity = velocity * phase.conj() ** order
        if modes.rigid_body_shape.shape[1]:
            spectrum = self.model.load_orders()[1 : velocity.shape[0]]
            fraction = spectrum / np.arange(1, 1 + spectrum.shape[0])
            fraction = jnp.pad(fraction, (1, velocity.shape[0] - 1 - spectrum.shape[0]))
            per_force = modes.rigid_body_shape @ modes.rigid_body_participation
            rigid = -1j * jnp.abs(force) / self.frequency * fraction[:, None] * per_force
            velocity = velocity + rigid
        amplitude, seen = jnp.abs(force)[None], velocity[None]
        modal = displacement_phasors(coefficients)[1, modes.mode_of_interest]
        for effect in self.model.measurement_effects:
            amplitude, seen = effect.recorded(
                self.frequency[None], amplitude, seen, jnp.abs(modal)[None]
            )
        return amplitude[0] * phase, seen[0] * phase**order

    def solved(self, start: Float[Array, " unknown"]) -> Float[Array, " unknown"]:
        """The solution near `start` by Newton's method, NaN if it did not converge.

        The last step is differentiable and carries the derivatives.
        """
        return newton_solved(self, start)[0]

    def solved_by_secants(
        self,
        inverse: Float[Array, "unknown unknown"],
        near: Secants,
        close: Float[Array, ""],
        fraction: Float[Array, ""],
    ) -> Secants:
        """The solution near a point, from an inverse Jacobian and its updates there.

        Broyden's method: no step needs another Jacobian. It ends with a step below `close` or below
        `fraction` of the first one, and has converged below 1e-5; else its point is NaN.
        """
        number = jnp.arange(_SECANTS)

        def step(state: tuple[Secants, Array, Array]) -> tuple[Secants, Array, Array]:
            now, _, enough = state
            move = now.updated(near.updated(-(inverse @ self.equations(now.point))))
            last = now.moves[jnp.maximum(now.taken - 1, 0)]
            back = last - move
            projection, norm = last @ back, jnp.linalg.norm(last)
            # No update from a step that is dominated by rounding.
            sure = jnp.abs(projection) > 1e-3 * norm * jnp.linalg.norm(back)
            move = move * jnp.where(sure, norm**2 / jnp.where(sure, projection, 1.0), 1.0)
            moves = jnp.where((number == now.taken)[:, None], move, now.moves)
            far = jnp.max(jnp.abs(move))
            enough = jnp.where(now.taken == 0, jnp.clip(fraction * far, close, _CLOSE), enough)
            return Secants(now.point + move, moves, now.taken + 1), far, enough

        def going(state: tuple[Secants, Array, Array]) -> Array:
            now, far, enough = state
            return (now.taken < 1) | ((now.taken < _SECANTS) & (far > enough))  # false for NaN

        zero = batched_zero(near.point)
        first = (start_of(near.point), zero, zero)
        end, far, _ = jax.lax.while_loop(going, step, first)
        return end._replace(point=jnp.where(far <= _CLOSE, end.point, jnp.nan))

    def grown(self) -> Float[Array, " unknown"]:
        """The solution continued from small amplitude, as a start for `solved`; else NaN.

        Steps are halved where Newton's method fails.
        """
        return self.grown_with_jacobian()[0]

    def grown_with_jacobian(self) -> tuple[Array, Array]:
        """The solution of `grown`, and the equations' Jacobian at the last converged one."""
        fixed = jax.lax.stop_gradient(self)
        first = jnp.zeros(self.balance.size + 2).at[-2].set(_SMALL)

        def larger(state: tuple) -> tuple:
            before, fraction, step = state
            aim = jnp.minimum(fraction + step, 1.0)
            smaller = eqx.tree_at(lambda h: h.velocity, fixed, fixed.velocity * aim)
            after = newton_solved(smaller, before[0] * (aim / fraction))
            good = jnp.all(jnp.isfinite(after[0]))
            now, fraction = jax.tree.map(
                lambda a, b: jnp.where(good, a, b), (after, aim), (before, fraction)
            )
            return now, fraction, jnp.where(good, 1.5 * step, 0.5 * step)

        def going(state: tuple) -> Array:
            _, fraction, step = state
            return (fraction < 1.0) & (step > _SHORTEST)

        small = ((first, jnp.eye(first.shape[0])), jnp.array(_SMALL), jnp.array(_FIRST))
        (point, jacobian), fraction, _ = jax.lax.while_loop(going, larger, small)
        return jnp.where(fraction >= 1.0, point, jnp.nan), jacobian

    def _balance_point(self, point: Array) -> Array:
        return jnp.append(point[:-2], self.frequency / self.balance.frequency_scale)

    def _load(self, parts: Float[Array, " part"]) -> Float[Array, " equation"]:
        """Scaled load of a force with these cosine and sine parts.

        A phase of the fundamental is h times as large for harmonic h.
        """
        rows = self.balance.load().reshape(self.balance.n_coefficients, -1)
        one = rows[1::2] - 1j * rows[2::2]  # of one newton with phase zero
        phasor = self.force * (parts[0] - 1j * parts[1])
        nonzero = jnp.where(phasor != 0, phasor, 1.0)
        rotated = phasor * jnp.exp(
            1j * jnp.angle(nonzero) * jnp.arange(self.balance.harmonic_order)
        )
        each = rotated[:, None] * one
        oscillating = jnp.stack([each.real, -each.imag], axis=1).reshape(-1)
        return jnp.concatenate([jnp.abs(nonzero) * rows[0], oscillating])

    def _miss(self, point: Array) -> Float[Array, " part"]:
        velocity = self.recorded(point)[1][1, self.sensor]
        scale = jax.lax.stop_gradient(jnp.abs(self.velocity))
        miss = (velocity - self.velocity) / scale
        return jnp.stack([miss.real, miss.imag])


def prescribed_motion(
    model: Structure,
    frequency: Float[Array, ""],
    force: Float[Array, ""],
    velocity: Complex[Array, ""],
    *,
    sensor: int,
    harmonic_order: int,
    scale: Float[Array, ""],
) -> PrescribedMotion:
    """The equations of a motion with a given fundamental at one sensor.

    Arguments: `frequency` in rad/s; `force` in N, a scale; `velocity` as recorded, in m/s; `scale`
    a typical velocity in m/s, which fixes the units of a point when `velocity` changes.
    """
    shape = model.modes.mode_shape[sensor, model.modes.mode_of_interest]
    displacement = jax.lax.stop_gradient(jnp.abs(scale / (frequency * shape)))
    simulated = simulated_structure(model)
    balance = harmonic_balance(simulated, 0.0, displacement, harmonic_order=harmonic_order)
    return PrescribedMotion(balance, model, frequency, force, velocity, sensor)
