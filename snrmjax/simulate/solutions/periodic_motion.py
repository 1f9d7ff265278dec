"""Single periodic motions as differentiable functions of the model and the force."""

from collections.abc import Callable
from typing import ClassVar, Literal, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Complex, Float

from snrmjax.model.structures import Structure, simulated_structure
from snrmjax.numerics.blocks import on_one_core
from snrmjax.numerics.compiled import compiled
from snrmjax.numerics.newton import ROUNDING, Point, newton
from snrmjax.numerics.result import AbstractResult, Variable
from snrmjax.numerics.rules import InputError
from snrmjax.numerics.units import HERTZ
from snrmjax.simulate.balance.harmonic_balance import HarmonicBalance, harmonic_balance
from snrmjax.simulate.balance.harmonics import velocity_phasors
from snrmjax.simulate.balance.labelled import batch_variables
from snrmjax.simulate.balance.not_found import nan_unless
from snrmjax.simulate.continuation.event_equations import event_condition
from snrmjax.simulate.continuation.events import height

Condition = Literal["frequency", "velocity", "fold", "peak", "phase_resonance"]


class PeriodicMotion(AbstractResult):
    """A periodic motion, or a batch of them; NaN if not converged."""

    coordinates: ClassVar[tuple[str, ...]] = ("frequency_hz",)

    frequency: Float[Array, "*batch"]  # rad/s
    coefficients: Float[Array, "*batch coefficient mode"]  # kg^1/2 m
    velocity: Complex[Array, "*batch harmonic sensor"]  # m/s, h = 0…H
    converged: Bool[Array, "*batch"]

    @property
    def amplitude(self) -> Float[Array, "*batch"]:
        """|velocity fundamental| at the first sensor, in m/s."""
        # The derivative of |NaN| would be NaN for all motions that share its parameters.
        fundamental = self.velocity[..., 1, 0]
        phasor = jnp.where(self.converged, fundamental, 1.0)
        return jnp.where(self.converged, jnp.abs(phasor), fundamental.real)

    def variables(self) -> dict[str, Variable]:
        """Frequency and velocities of every motion."""
        hertz = np.asarray(self.frequency) / HERTZ
        return batch_variables(
            self.velocity,
            frequency_hz=(hertz, "Hz", "frequency"),
            converged=(self.converged, "1", "whether the solution converged"),
        )


@on_one_core
def periodic_motion(
    model: Structure,
    force: float | Float[ArrayLike, ""],
    start: tuple[Float[ArrayLike, "coefficient mode"], float | Float[ArrayLike, ""]],
    *,
    condition: Condition = "frequency",
    value: float | Float[ArrayLike, ""] | None = None,
    iterations: int = 30,
) -> PeriodicMotion:
    """The periodic motion near `start` that satisfies one condition, differentiable.

    Solves the harmonic balance together with Ω = `value` ("frequency"), |V₁| = `value` at the
    first sensor ("velocity"), dΩ/ds = 0 ("fold"), d|V₁|/ds = 0 ("peak") or Im V₁ = 0 of the mode
    of interest ("phase_resonance"), s being the arclength of the response curve, by Newton's
    method with exact derivatives. The result is a differentiable function of every number of
    `model`, of `force` and of `value`, by the implicit function theorem: in forward and in reverse
    mode, and of second order (a Hessian times a vector is `jax.jvp` of `jax.grad`; that of a "peak"
    or a "fold" of a structure with contacts compiles for a minute or two, once). `start`
    (coefficients in kg^1/2 m and frequency in rad/s, such as `ResponseCurve.point`) only selects
    the solution: derivatives by it are zero.

    Arguments: `force` in N; `value` in rad/s or m/s.
    Returns a `PeriodicMotion`, also under `jax.jit` and `jax.vmap` (models with the same modes,
    monomials and effects; all take as many iterations as the slowest). If Newton's method did not
    converge its values and their derivatives are NaN: start nearer, or use `TrackedMotion`.
    With sliders and contacts the slope of the response changes fast where the motion begins to
    slip or to touch: if "peak" or "fold" does not converge there, take "phase_resonance",
    "frequency" or "velocity".
    Members of a batch that a result leaves out add nothing to its derivatives; mask them before
    further computation, by `jnp.where(motion.converged, motion.frequency, 1.0)`. From a distant
    start Newton's method may converge to another motion: in an optimisation use `TrackedMotion`.
    Raises `ValueError` for an unknown condition and for a missing or superfluous `value`.

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
        raise InputError(f"`condition` must be one of {get_args(Condition)}, not {condition!r}.")
    if (value is None) == (condition in ("frequency", "velocity")):
        verb = "needs a" if value is None else "takes no"
        raise InputError(f'`condition="{condition}"` {verb} `value`.')
    target = None if value is None else jnp.asarray(value, dtype=jnp.float64)
    near = tuple(jnp.asarray(part, dtype=jnp.float64) for part in start)
    load = jnp.asarray(force, dtype=jnp.float64)
    return motion_near(model, load, near, condition, target, iterations)


@compiled
def motion_near(
    model: Structure,
    force: Float[Array, ""],
    start: tuple[Array, ...],
    condition: Condition,
    value: Float[Array, ""] | None,
    iterations: int,
) -> PeriodicMotion:
    """`periodic_motion` for arrays, without its checks."""
    given = model, force, value
    model = simulated_structure(model)
    coefficients, frequency = (jax.lax.stop_gradient(part) for part in start)
    largest = jnp.max(jnp.abs(coefficients))
    target = jnp.zeros(()) if value is None else value
    # Non-finite input is replaced by harmless numbers and counts as not converged: in derivatives
    # `where` does not mask a NaN that was computed.
    usable = jnp.isfinite(force) & jnp.isfinite(target) & jnp.isfinite(largest) & (largest > 0)
    force, target, scale = (jnp.where(usable, part, 1.0) for part in (force, target, largest))
    order = (coefficients.shape[0] - 1) // 2
    balance = harmonic_balance(model, force, scale, harmonic_order=order)
    guess = jnp.where(usable, balance.point(coefficients, frequency), jnp.nan)
    guess = jax.lax.stop_gradient(guess)
    point, converged = _solved(balance, guess, condition, target, iterations)
    solution = balance.coefficients(point)
    omega = point[-1] * balance.frequency_scale
    velocity = velocity_phasors(solution, omega, model.modes.mode_shape)
    # Masked last: a NaN inside would make the derivatives of a whole batch NaN.
    return PeriodicMotion(*nan_unless(converged, (omega, solution, velocity), given), converged)


def _solved(
    balance: HarmonicBalance, guess: Point, condition: Condition, target: Array, iterations: int
) -> tuple[Point, Array]:
    """The root of the balance and the condition, and whether it converged: see `root_of`."""

    def test(balance: HarmonicBalance, target: Array, point: Point) -> Array:
        return _test(balance, condition, target, point)

    return root_of(balance, test, target, guess, iterations)


def root_of(
    balance: HarmonicBalance,
    test: Callable[[HarmonicBalance, Array, Point], Array],
    target: Array,
    guess: Point,
    iterations: int,
) -> tuple[Point, Array]:
    """The root of the balance and of `test(balance, target, point)`, and whether it converged.

    Differentiable by `balance` and `target`. If it did not converge the point is the guess with
    zero derivatives: pass results computed from it through `nan_unless`.
    """
    harmless = jnp.where(jnp.isfinite(guess), guess, 1.0)
    fixed, aim = jax.lax.stop_gradient((balance, target))

    def linearised(point: Point) -> tuple[Array, Array]:
        residual, jacobian = fixed.linearised(point)
        value, slope = jax.value_and_grad(lambda p: test(fixed, aim, p))(point)
        return jnp.append(residual, value), jnp.concatenate([jacobian, slope[None]])

    point, converged = newton(linearised, guess, most=iterations).one_more(within=ROUNDING)
    root = jax.lax.stop_gradient(jnp.where(converged, point, harmless))

    def equations(point: Point) -> Array:
        residual = jnp.append(balance.residual(point), test(balance, target, point))
        return jnp.where(converged, residual, point - harmless)

    def tangent_solve(linear: Callable[[Array], Array], right: Array) -> Array:
        return jnp.linalg.solve(jax.jacfwd(linear)(right), right)

    # The root is known: this attaches the derivatives of the implicit function theorem.
    return jax.lax.custom_root(equations, root, lambda _, known: known, tangent_solve), converged


def _test(balance: HarmonicBalance, condition: Condition, target: Array, point: Point) -> Array:
    """The residual of the condition."""
    if condition == "frequency":
        return point[-1] - target / balance.frequency_scale
    if condition == "velocity":
        top = jnp.max(jnp.abs(balance.model.modes.mode_shape[0])) ** 2
        unit = balance.displacement_scale * balance.frequency_scale
        return height(balance, point) - (target / unit) ** 2 / top
    return event_condition(condition, balance, point)
