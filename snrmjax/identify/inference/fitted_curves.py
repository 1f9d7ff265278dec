"""Both curves of a joint fit at amplitudes on the backbone, with bands."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from snrmjax.identify.curves.family_base import AbstractCurve
from snrmjax.identify.joint.force_balance import Unknowns
from snrmjax.identify.joint.free_unknowns import Unravel
from snrmjax.identify.joint.joint_fit import JointFit
from snrmjax.identify.pointwise.backbone import Backbone, BackboneValues
from snrmjax.identify.pointwise.curve_fit import PchipCurve
from snrmjax.identify.pointwise.prediction import LARGEST_AMPLITUDE_RATIO
from snrmjax.numerics.blocks import by_blocks
from snrmjax.numerics.compiled import compiled

_BLOCK = 256  # amplitudes that one program works on
_ITERATIONS = 12
_KNOTS = 120  # of the curves for what takes a `Backbone`
_DOUBLINGS = 6  # of the displacement, to reach a velocity


def fitted_values(
    fit: JointFit,
    velocity: Float[np.ndarray, " point"] | None = None,
    *,
    displacement: Float[np.ndarray, " point"] | None = None,
    of_a_new_level: bool = False,
) -> BackboneValues:
    """ω̃ and ζ̃ at amplitudes on the backbone, with 1σ at that amplitude.

    Arguments: either `velocity` in m/s or `displacement` in m, zero allowed. With `of_a_new_level`
    the bands are those of the next test: they include by how much one level differs from another.
    Raises `ValueError` for a velocity that the backbone has at several displacements, as it can
    have where it softens: give displacements there.
    """
    if (velocity is None) == (displacement is None):
        raise ValueError("give either `velocity` or `displacement`.")
    if velocity is not None:
        at = np.asarray(velocity, dtype=np.float64)
        values, slopes = values_with_slopes(fit, at)
    else:
        given = np.asarray(displacement, np.float64)
        values, slopes, at = values_at_displacement(fit, given)
    covariance = np.einsum("ocp,pq,odq->ocd", slopes, fit.covariance, slopes)
    squared, damping = values.T
    if of_a_new_level:
        stiffness, dissipation = np.asarray(fit.prior.level)[2:]
        covariance[:, 0, 0] += (squared * stiffness) ** 2
        covariance[:, 1, 1] += (damping * dissipation) ** 2
    omega, zeta = np.sqrt(squared), damping / (2 * np.sqrt(squared))
    # ζ̃ = δ/(2√s): dζ̃ = dδ/(2ω̃) − ζ̃ ds/(2s).
    slope = np.stack([-zeta / (2 * squared), 1 / (2 * omega)], axis=1)
    zeta_std = np.sqrt(np.einsum("oc,ocd,od->o", slope, covariance, slope))
    return BackboneValues(
        velocity=jnp.asarray(at),
        natural_frequency=jnp.asarray(omega),
        natural_frequency_std=jnp.asarray(np.sqrt(covariance[:, 0, 0]) / (2 * omega)),
        damping_ratio=jnp.asarray(zeta),
        damping_ratio_std=jnp.asarray(zeta_std),
        modal_damping=jnp.asarray(damping),
        modal_damping_std=jnp.asarray(np.sqrt(covariance[:, 1, 1])),
    )


def values_to_the_largest(fit: JointFit, n_points: int) -> BackboneValues:
    """`fitted_values` from rest to the largest measured amplitude.

    In equal steps of velocity, or of displacement where the backbone turns back in velocity.
    """
    displacement, velocity = fit.largest
    steps = np.linspace(0.0, 1.0, n_points)
    if _near(fit, velocity).turns_back_at is None:
        return fitted_values(fit, velocity * steps)
    return fitted_values(fit, displacement=displacement * steps)


def as_backbone(
    fit: JointFit, *, largest_amplitude_ratio: float = LARGEST_AMPLITUDE_RATIO
) -> Backbone:
    """The fitted curves against displacement, through many knots: for what takes a `Backbone`.

    Damping that belongs to the velocity is taken where it lies on the backbone. The knots reach up
    to `largest_amplitude_ratio` times the largest measured amplitude.
    """
    displacement = largest_amplitude_ratio * fit.largest[0] * np.linspace(0.0, 1.0, _KNOTS)
    sampled = values_at_displacement(fit, displacement)
    # A polynomial may fall below zero beyond the data: there is no motion there.
    sound = np.append(sampled[0][:, 0] > 0, False).argmin()
    if sound < _KNOTS:
        displacement = displacement[sound - 1] * np.linspace(0.0, 1.0, _KNOTS)
        sampled = values_at_displacement(fit, displacement)
    values, slopes = (np.asarray(part) for part in sampled[:2])
    covariance = [slopes[:, k] @ fit.covariance @ slopes[:, k].T for k in range(2)]
    measured = np.asarray(fit.motion().displacement)
    # Dry friction has no finite damping at rest: there the next knot's value stands.
    damping = values[:, 1].copy()
    damping[0] = damping[0] if np.isfinite(damping[0]) else damping[1]
    return Backbone(
        squared_frequency=PchipCurve(jnp.asarray(displacement), jnp.asarray(values[:, 0])),
        modal_damping=PchipCurve(jnp.asarray(displacement), jnp.asarray(damping)),
        squared_frequency_covariance=jnp.asarray(covariance[0]),
        modal_damping_covariance=jnp.asarray(np.nan_to_num(covariance[1])),
        modal_constant=fit.problem.constant_of(fit.unknowns),
        smallest=jnp.asarray(measured.min()),
        largest=jnp.asarray(fit.largest[0]),
        argument="displacement",
        sensor=fit.modes.sensors[fit.data.sensor],
    )


def curve_values(
    unknowns: Unknowns, velocity: Float[Array, " point"], near: Float[Array, " point"]
) -> Float[Array, "point 2"]:
    """ω̃² and 2ζ̃ω̃ at velocities on the backbone, `near` displacements; differentiable."""
    squared, damping = unknowns.squared_frequency, unknowns.modal_damping

    def excess(squared: AbstractCurve, x: Array) -> Array:
        return x * jnp.sqrt(squared(squared.amplitude(x, velocity))) - velocity

    x = _solved(excess, squared, near)
    return jnp.stack(
        [squared(squared.amplitude(x, velocity)), damping(damping.amplitude(x, velocity))], axis=1
    )


def _speed(squared: AbstractCurve, displacement: Float[Array, " point"]) -> Float[Array, " point"]:
    """Velocity amplitude of the backbone; its derivative is that of the equation's solution."""

    def excess(squared: AbstractCurve, v: Array) -> Array:
        return v - displacement * jnp.sqrt(squared(squared.amplitude(displacement, v)))

    start = displacement * jnp.sqrt(squared(jnp.zeros_like(displacement)))
    return _solved(excess, squared, start)


def _solved(
    excess: Callable[[AbstractCurve, Array], Array], curve: AbstractCurve, start: Array
) -> Array:
    """Newton's method for every point by itself; the derivative is the solution's.

    Newton's steps are taken of a curve without derivatives: nothing is pushed through the loop.
    """
    still, start = jax.lax.stop_gradient((curve, start))

    def values(x: Array) -> tuple[Array, Array]:
        return jax.jvp(lambda x: excess(still, x), (x,), (jnp.ones_like(x),))

    def step(_: int, state: tuple[Array, Array]) -> tuple[Array, Array]:
        value, slope = values(state[0])
        return state[0] - value / slope, slope

    found, slope = jax.lax.fori_loop(0, _ITERATIONS, step, (start, jnp.ones_like(start)))
    return found - excess(curve, found) / slope


def values_with_slopes(
    fit: JointFit, velocity: Float[np.ndarray, " point"]
) -> tuple[Float[np.ndarray, "point curve"], Float[np.ndarray, "point curve unknown"]]:
    """ω̃² and 2ζ̃ω̃ at velocities, and their derivatives by the free unknowns at that velocity.

    Raises `ValueError` where the backbone has a velocity at several displacements.
    """
    vector, unravel, own = fit.packed()
    near = displacement_near(fit, velocity)
    found = by_blocks(lambda v, x: _at_velocity(vector, unravel, v, x), _BLOCK, velocity, near)
    return found[0], found[1][:, :, own]


def values_at_displacement(
    fit: JointFit, displacement: Float[np.ndarray, " point"]
) -> tuple[
    Float[np.ndarray, "point curve"],
    Float[np.ndarray, "point curve unknown"],
    Float[np.ndarray, " point"],
]:
    """ω̃² and 2ζ̃ω̃, their derivatives by the free unknowns, and the velocity, at displacements."""
    vector, unravel, own = fit.packed()
    found = by_blocks(lambda x: _at_displacement(vector, unravel, x), _BLOCK, displacement)
    return found[0], found[1][:, :, own], found[2]


def displacement_near(
    fit: JointFit, velocity: Float[np.ndarray, " point"]
) -> Float[np.ndarray, " point"]:
    """Displacement of the backbone at velocities, to one part in a few hundred.

    Raises `ValueError` where there are several, or none.
    """
    found = _near(fit, float(np.max(velocity)))
    if found.turns_back_at is not None:
        raise ValueError(
            f"the backbone turns back at {found.turns_back_at:.4g} m/s: there velocities belong to "
            "several displacements; ask for values at displacements."
        )
    if np.max(velocity) > found.speed[-1]:
        raise ValueError(f"the backbone does not reach {np.max(velocity):.4g} m/s.")
    return np.interp(velocity, found.speed, found.displacement)


class _Reached(NamedTuple):
    displacement: np.ndarray
    speed: np.ndarray
    turns_back_at: float | None  # m/s, below the velocity that was asked for

    @property
    def once(self) -> float:
        """The velocity, below which the backbone has each exactly once."""
        if self.turns_back_at is None:
            return float(self.speed[-1])
        return float(np.min(self.speed[np.argmax(self.speed == self.turns_back_at) :]))


def _near(fit: JointFit, velocity: float) -> _Reached:
    """The backbone from rest to beyond the measured displacements and a velocity."""
    vector, unravel, _ = fit.packed()
    reach = fit.largest[0]
    for _ in range(_DOUBLINGS):
        x = np.linspace(0.0, reach, _BLOCK)
        speed = np.asarray(_at_displacement(vector, unravel, x)[2])
        turns = np.flatnonzero(~(np.diff(speed) > 0))
        if turns.size and np.min(speed[turns[0] :]) < velocity:
            return _Reached(x, speed, float(speed[turns[0]]))
        if turns.size or speed[-1] >= velocity:
            break
        reach *= 2
    end = turns[0] + 1 if turns.size else len(x)
    return _Reached(x[:end], speed[:end], None)


@compiled
def _at_velocity(
    vector: Array, unravel: Unravel, velocity: Array, near: Array
) -> tuple[Array, Array]:
    def of(vector: Array) -> tuple[Array, Array]:
        values = curve_values(unravel(vector), velocity, near)
        return values, values

    slopes, values = jax.jacfwd(of, has_aux=True)(vector)
    return values, slopes


@compiled
def _at_displacement(vector: Array, unravel: Unravel, x: Array) -> tuple[Array, Array, Array]:
    def of(vector: Array) -> tuple[Array, tuple[Array, Array]]:
        squared, damping = unravel(vector).squared_frequency, unravel(vector).modal_damping
        speed = _speed(squared, x)
        pair = [curve(curve.amplitude(x, speed)) for curve in (squared, damping)]
        values = jnp.stack(pair, axis=1)
        return values, (values, speed)

    slopes, (values, speed) = jax.jacfwd(of, has_aux=True)(vector)
    return values, slopes, speed
