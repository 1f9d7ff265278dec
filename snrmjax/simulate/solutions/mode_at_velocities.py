"""The nonlinear normal mode at given amplitudes, as a differentiable function of the model."""

import dataclasses

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from snrmjax.model.effect_shape import conservative_effects
from snrmjax.model.modes import have_values
from snrmjax.model.structures import Structure, simulated_structure
from snrmjax.numerics.blocks import mapped, on_one_core
from snrmjax.numerics.compiled import compiled
from snrmjax.numerics.rules import InputError
from snrmjax.simulate.balance.given_numbers import positive
from snrmjax.simulate.balance.harmonic_balance import HarmonicBalance, harmonic_balance
from snrmjax.simulate.balance.harmonics import velocity_phasors, with_sines
from snrmjax.simulate.balance.not_found import nan_unless
from snrmjax.simulate.solutions.periodic_motion import PeriodicMotion, root_of

_ITERATIONS = 12  # of Newton's method, started from a prediction
_LATE = 0.5  # largest correction over step: beyond it another motion may have been reached
_LARGEST_SHIFT = 0.2  # largest relative change of the frequency in a step, likewise


@on_one_core
def normal_mode_at_velocities(
    model: Structure,
    velocities: float | Float[ArrayLike, " velocity"],
    *,
    harmonic_order: int = 9,
    steps: int = 8,
) -> PeriodicMotion:
    """The nonlinear normal mode of interest at given velocity amplitudes, differentiable.

    Solves m q̈ + k q + ∂V/∂q = 0 (damping, friction, and forces that depend on velocity, left out)
    with |V₁| = the velocity at the first sensor: the backbone, natural frequency over amplitude.
    The linear mode is continued through rising amplitudes, so that no start is needed. By the
    implicit function theorem the result is differentiable by `model` and `velocities`, in forward
    and reverse mode and repeatedly. Intended for the residuals of a fit, with `snrmjax.condense`
    of the dimensions of a structure.

    Arguments: `velocities` in m/s, in any order; `steps` between one amplitude and the next.
    Returns a `PeriodicMotion` with one motion per velocity; NaN, with NaN derivatives, where the
    mode did not converge and at all larger velocities. Raises `ValueError` for a velocity that is
    not positive, fewer than one step, and a first sensor that does not see the mode.
    Validity: at a turning point in amplitude (the tip of an internal resonance) it does not
    converge, or steps over a narrow tongue; `nonlinear_normal_mode` traces such curves.
    Reference: Kerschen et al., Mech. Syst. Signal Process. 23 (2009) 170,
    doi:10.1016/j.ymssp.2008.04.002.

    >>> from snrmjax.model import linear_modes, polynomial_potential, structure
    >>> modes = linear_modes([1.0], [0.01], [[1.0]], [1.0])
    >>> duffing = structure(modes, polynomial_potential({"1111": 0.25}, 1))
    >>> found = normal_mode_at_velocities(duffing, [1.0], harmonic_order=1)
    >>> (found.frequency**2 - 0.75 / found.frequency**2).round(9)  # Ω² = 1 + 3/4 (v/Ω)²
    Array([1.], dtype=float64)
    """
    wanted = jnp.atleast_1d(jnp.asarray(velocities, dtype=jnp.float64))
    positive("velocities", wanted)
    if steps < 1:
        raise InputError(f"`steps` must be at least 1, but is {steps}.")
    shape = model.modes.mode_shape[0, model.modes.mode_of_interest]
    if have_values(shape) and float(shape) == 0.0:
        raise InputError("the first sensor does not see the mode of interest.")
    return _at_velocities(model, wanted, harmonic_order, steps)


@compiled
def _at_velocities(
    model: Structure, velocities: Float[Array, " velocity"], harmonic_order: int, steps: int
) -> PeriodicMotion:
    model = simulated_structure(model)
    model = dataclasses.replace(model, effects=conservative_effects(model.effects))
    modes, j = model.modes, model.modes.mode_of_interest
    unit = jnp.abs(modes.natural_frequency[j] * modes.mode_shape[0, j])
    amplitudes = jax.lax.stop_gradient(velocities / unit)
    balance = harmonic_balance(
        model, 0.0, jnp.max(amplitudes), harmonic_order=harmonic_order, cosine_only=True
    )
    order = jnp.argsort(velocities)
    guesses, converged = _continued(*jax.lax.stop_gradient((balance, velocities[order])), steps)

    def motion_at(guess: Array, known: Array, velocity: Array, amplitude: Array) -> PeriodicMotion:
        # Scaled by its own amplitude a small motion is as accurate as a large one.
        scaled = dataclasses.replace(balance, displacement_scale=amplitude)
        guess = guess.at[:-1].multiply(balance.displacement_scale / amplitude)
        start = jnp.where(known, guess, jnp.nan)
        point, converged = root_of(scaled, _velocity_test, velocity, start, _ITERATIONS)
        cosines, omega = scaled.coefficients(point), point[-1] * balance.frequency_scale
        whole = with_sines(cosines[None])[0]
        phasors = velocity_phasors(whole, omega, modes.mode_shape)
        given = model, velocity
        return PeriodicMotion(*nan_unless(converged, (omega, whole, phasors), given), converged)

    motions = mapped(motion_at, guesses, converged, velocities[order], amplitudes[order])
    back = jnp.argsort(order)
    return jax.tree.map(lambda part: part[back], motions)


def _velocity_test(balance: HarmonicBalance, velocity: Array, point: Array) -> Array:
    """Zero at the prescribed velocity of the first sensor, with the sign of the linear mode."""
    model = balance.model
    shape, j = model.modes.mode_shape[0], model.modes.mode_of_interest
    cosine = point[:-1].reshape(balance.n_coefficients, -1)[1]
    unit = balance.displacement_scale * balance.frequency_scale * jnp.abs(shape[j])
    return point[-1] * (cosine @ shape) * jnp.sign(shape[j]) / jnp.abs(shape[j]) - (velocity / unit)


def _continued(
    balance: HarmonicBalance, velocities: Float[Array, " velocity"], steps: int
) -> tuple[Float[Array, "velocity unknown"], Array]:
    """Points of the mode at rising velocities, and which of them converged."""
    model = balance.model
    n, j = model.n_modes, model.modes.mode_of_interest
    shape = jnp.abs(model.modes.mode_shape[0, j])
    before = jnp.concatenate([jnp.zeros(1), velocities[:-1]])
    fraction = jnp.arange(1, steps + 1) / steps
    levels = (before[:, None] + (velocities - before)[:, None] * fraction).reshape(-1)
    rest = jnp.zeros(balance.size + 1).at[-1].set(1.0)
    unit = balance.displacement_scale * balance.frequency_scale * shape
    slope = jnp.zeros(balance.size + 1).at[n + j].set(1 / unit)

    def step(carry: tuple, level: Array) -> tuple[tuple, tuple]:
        point, slope, last, good = carry
        ahead = point + slope * (level - last)
        new, converged = root_of(balance, _velocity_test, level, ahead, _ITERATIONS)
        far, off = (jnp.max(jnp.abs((new - p)[:-1])) for p in (point, ahead))
        near = (off <= _LATE * far) & (jnp.abs(new[-1] - ahead[-1]) <= _LARGEST_SHIFT * ahead[-1])
        # Equal velocities have equal motions.
        moved = level > last
        good = good & converged & (near | ~moved)
        slope = jnp.where(moved, (new - point) / jnp.where(moved, level - last, 1.0), slope)
        return (new, slope, level, good), (new, good)

    start = rest, slope, jnp.zeros(()), jnp.array(True)
    _, (points, good) = jax.lax.scan(step, start, levels)
    return points[steps - 1 :: steps], good[steps - 1 :: steps]
