"""Single periodic motions as differentiable functions of the model and the force."""

from typing import Literal, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float

from snrmjax.model.structures import Structure, simulated_structure
from snrmjax.numerics.blocks import mapped
from snrmjax.simulate.balance.harmonic_balance import HarmonicBalance, harmonic_balance
from snrmjax.simulate.balance.harmonics import velocity_phasors
from snrmjax.simulate.continuation.continuation import Linearised, Point
from snrmjax.simulate.continuation.events import mode_velocity, sensor_velocity
from snrmjax.simulate.continuation.response_curve import ResponseCurve

Condition = Literal["frequency", "velocity", "fold", "peak", "phase_resonance"]


class PeriodicMotion(eqx.Module):
    """A periodic motion; NaN where none was found."""

    frequency: Float[Array, ""]  # rad/s
    coefficients: Float[Array, "coefficient mode"]  # kg^1/2 m
    velocity: Complex[Array, "harmonic sensor"]  # m/s, h = 0…H
    converged: Bool[Array, ""]

    @property
    def amplitude(self) -> Float[Array, ""]:
        """|velocity fundamental| at the first sensor, in m/s."""
        return jnp.abs(self.velocity[..., 1, 0])


@eqx.filter_jit
def periodic_motion(
    model: Structure,
    force: Float[Array, ""] | float,
    start: tuple[Float[Array, "coefficient mode"], Float[Array, ""]],
    *,
    condition: Condition = "frequency",
    value: Float[Array, ""] | float | None = None,
    iterations: int = 30,
) -> PeriodicMotion:
    """The periodic motion near `start` that meets one condition, differentiable.

    Solves the harmonic balance together with Ω = `value` ("frequency"), |V₁| = `value` at the
    first sensor ("velocity"), dΩ/ds = 0 ("fold"), d|V₁|/ds = 0 ("peak") or Im V₁ = 0 of the mode
    of interest ("phase_resonance"), s being the arclength of the response curve, by Newton's
    method with exact derivatives. The result is a differentiable function of `model`, `force` and
    `value`, by the implicit function theorem: in forward and in reverse mode, and again; `start`
    (coefficients in kg^1/2 m and frequency in rad/s, such as `ResponseCurve.point`) only says
    which solution is meant.

    Arguments: `force` in N; `value` in rad/s or m/s.
    Returns a `PeriodicMotion` whose values are NaN where Newton's method did not converge: start
    nearer. Raises `ValueError` for an unknown condition and for a missing or needless `value`.

    >>> from snrmjax import forced_response
    >>> from snrmjax.model import flat_beam
    >>> beam = flat_beam()
    >>> curve = forced_response(beam, [2e-4], 480.0, 520.0, harmonic_order=1)[0]
    >>> start = curve.point(curve.at_events("peak")[0])
    >>> peak = lambda force: periodic_motion(beam, force, start, condition="peak").amplitude
    >>> bool(jax.grad(peak)(2e-4) > 0)
    True
    """
    if condition not in get_args(Condition):
        raise ValueError(f"`condition` must be one of {get_args(Condition)}, not {condition!r}.")
    if (value is None) == (condition in ("frequency", "velocity")):
        verb = "needs a" if value is None else "takes no"
        raise ValueError(f'`condition="{condition}"` {verb} `value`.')
    model = simulated_structure(model)
    coefficients, frequency = (jax.lax.stop_gradient(jnp.asarray(part)) for part in start)
    scale = jax.lax.stop_gradient(jnp.max(jnp.abs(coefficients)))
    order = (coefficients.shape[0] - 1) // 2
    balance = harmonic_balance(model, force, scale, harmonic_order=order)
    target = jnp.zeros(()) if value is None else jnp.asarray(value, dtype=jnp.float64)
    guess = jax.lax.stop_gradient(balance.point(coefficients, frequency))
    point, converged = _solved(balance, guess, condition, target, iterations)
    point = jnp.where(converged, point, jnp.nan)
    found = balance.coefficients(point)
    omega = point[-1] * balance.frequency_scale
    return PeriodicMotion(
        frequency=omega,
        coefficients=found,
        velocity=velocity_phasors(found, omega, model.modes.mode_shape),
        converged=converged,
    )


def response_at_velocities(
    model: Structure,
    curve: ResponseCurve,
    velocities: Float[np.ndarray, " value"],
) -> tuple[PeriodicMotion, np.ndarray]:
    """Every place where a response curve has a given velocity amplitude, differentiable.

    Arguments: `curve` of the model (at the numbers it has now), `velocities` |V₁| at the first
    sensor in m/s.
    Returns the motions, stacked in order along the curve, and for each the index of its velocity.
    Their frequencies are differentiable functions of the model: the whole curve at fixed
    amplitudes. Call it once; then `motions_at_velocities` with other models.
    """
    starts, passed, which = _crossings(curve, np.asarray(velocities, dtype=np.float64))
    coefficients, frequency = (jnp.asarray(part) for part in starts)
    values = jnp.asarray(passed)
    motions = motions_at_velocities(model, curve.force, (coefficients, frequency), values)
    return motions, which


def motions_at_velocities(
    model: Structure,
    force: Float[Array, ""] | float,
    starts: tuple[Float[Array, "motion coefficient mode"], Float[Array, " motion"]],
    velocities: Float[Array, " motion"],
) -> PeriodicMotion:
    """The motions near `starts` with given velocity amplitudes (m/s); see `periodic_motion`."""

    def one(coefficients: Array, frequency: Array, value: Array) -> PeriodicMotion:
        start = (coefficients, frequency)
        return periodic_motion(model, force, start, condition="velocity", value=value)

    return mapped(one, *(jnp.asarray(a) for a in (*starts, velocities)))


def _crossings(
    curve: ResponseCurve, velocities: np.ndarray
) -> tuple[tuple[np.ndarray, np.ndarray], np.ndarray, np.ndarray]:
    """Interpolated starts where |V₁| passes each value, in order along the curve."""
    height = np.abs(curve.velocity[:, 1, 0])
    above = height[:, None] > velocities
    where, which = np.nonzero(above[1:] != above[:-1])
    share = (velocities[which] - height[where]) / (height[where + 1] - height[where])
    x = curve.coefficients
    coefficients = x[where] + share[:, None, None] * (x[where + 1] - x[where])
    omega = curve.frequency[where]
    omega = omega + share * (curve.frequency[where + 1] - omega)
    return (coefficients, omega), velocities[which], which


def _solved(
    balance: HarmonicBalance, guess: Point, condition: Condition, target: Array, iterations: int
) -> tuple[Point, Array]:
    """The root of the balance and the condition, and whether it was found."""
    border = _tangent_near(balance.linearised, guess, _generic(guess.shape[0]))
    border = jax.lax.stop_gradient(border)

    def test(point: Point) -> Array:
        if condition == "frequency":
            return point[-1] - target / balance.frequency_scale
        if condition == "velocity":
            shape = balance.model.modes.mode_shape[0]
            top = jnp.max(jnp.abs(shape)) ** 2
            unit = balance.displacement_scale * balance.frequency_scale
            return sensor_velocity(balance, point) - (target / unit) ** 2 / top
        if condition == "phase_resonance":
            return mode_velocity(balance, point).imag
        tangent = _tangent_near(balance.linearised, point, border)
        if condition == "fold":
            return tangent[-1]
        return jax.jvp(lambda p: sensor_velocity(balance, p), (point,), (tangent,))[1]

    def equations(point: Point) -> Array:
        return jnp.append(balance.residual(point), test(point))

    def newton(_: object, start: Point) -> Point:
        def body(state: tuple) -> tuple:
            point, count, _, _ = state
            residual, jacobian = balance.linearised(point)
            value, slope = jax.value_and_grad(test)(point)
            matrix = jnp.concatenate([jacobian, slope[None]])
            step = jnp.linalg.solve(matrix, jnp.append(residual, value))
            size = jnp.max(jnp.abs(step))
            return point - step, count + 1, size, jnp.isfinite(size)

        def going(state: tuple) -> Array:
            _, count, size, finite = state
            return finite & (count < iterations) & (size > 1e-12)

        state = (start, jnp.array(0), jnp.array(jnp.inf), jnp.array(True))
        point, _, size, finite = jax.lax.while_loop(going, body, state)
        return jnp.where(finite & (size < 1e-8), point, jnp.nan)

    def tangent_solve(linear: object, right: Array) -> Array:
        matrix = jax.jacfwd(linear)(right)  # type: ignore[arg-type]
        return jnp.linalg.solve(matrix, right)

    point = jax.lax.custom_root(equations, guess, newton, tangent_solve)
    return point, jnp.all(jnp.isfinite(jax.lax.stop_gradient(point)))


def _tangent_near(linearised: Linearised, point: Point, border: Point) -> Point:
    """The curve's tangent, of unit length along `border`."""
    jacobian = linearised(point)[1]
    right = jnp.zeros(point.shape[0]).at[-1].set(1.0)
    tangent = jnp.linalg.solve(jnp.concatenate([jacobian, border[None]]), right)
    return tangent / jnp.sqrt(tangent @ tangent)


def _generic(size: int) -> Point:
    """A direction that no tangent is across, but by chance."""
    return jnp.asarray(np.random.default_rng(size).normal(size=size) / np.sqrt(size))
