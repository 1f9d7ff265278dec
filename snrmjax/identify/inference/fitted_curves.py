"""Both curves of a joint fit at amplitudes on the backbone, with bands."""

from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from snrmjax.identify.curves.family_base import AbstractFamily, Argument
from snrmjax.identify.curves.splines import SmoothingSpline, Spline
from snrmjax.identify.joint.joint_fit import JointFit
from snrmjax.identify.pointwise.backbone import Backbone, BackboneValues, banded_values
from snrmjax.numerics.compiled import on_numbers

_SCAN = 256  # displacements of the backbone, on which a velocity is looked for
_ITERATIONS = 12
_KNOTS = 120  # of curves of families by name, for what takes a `Backbone`
_DOUBLINGS = 6  # of the displacement, to reach a velocity


@on_numbers("Differentiate `sj.identify.refit`.")
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
    Not differentiable: differentiate `snrmjax.identify.refit`.
    """
    if (velocity is None) == (displacement is None):
        raise ValueError("give either `velocity` or `displacement`.")
    if velocity is not None:
        curves = values_at_velocity(fit, np.asarray(velocity, np.float64))
    else:
        curves = values_at_displacement(fit, np.asarray(displacement, np.float64))
    covariance = np.einsum("ocp,pq,odq->ocd", curves.slopes, fit.covariance, curves.slopes)
    squared, damping = curves.values.T
    if of_a_new_level:
        stiffness, dissipation = np.asarray(fit.prior.new_level)[2:]
        covariance[:, 0, 0] += (squared * stiffness) ** 2
        covariance[:, 1, 1] += (damping * dissipation) ** 2
    return banded_values(curves.velocity, squared, damping, covariance)


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
    fit: JointFit, *, argument: Argument = "displacement", reach: float = 1.0
) -> Backbone:
    """The fitted curves as what responses are predicted from.

    The smooth curves are the fit's own, at its own knots. Families by name are drawn through many
    knots, up to `reach` times the largest measured displacement; damping that belongs to the
    velocity is then taken where it lies on the backbone. Against velocity the knots are where the
    backbone has them.
    """
    are_own = argument == "displacement" and _are_smooth(fit)
    squared, damping, covariance = _own_curves(fit) if are_own else _redrawn(fit, argument, reach)
    motion = fit.motion()
    measured = np.abs(motion.velocity) if argument == "velocity" else motion.displacement
    return Backbone(
        squared_frequency=squared,
        modal_damping=damping,
        covariance=jax.device_put(covariance),
        modal_constant=fit.problem.constant_of(fit.unknowns),
        smallest=jax.device_put(np.min(measured)),
        largest=jax.device_put(fit.largest[argument == "velocity"]),
        argument=argument,
        sensor=fit.modes.sensors[fit.data.sensor],
    )


def _are_smooth(fit: JointFit) -> bool:
    """Whether both curves are smooth ones of the displacement, through the same knots."""
    pair = fit.unknowns.squared_frequency, fit.unknowns.modal_damping
    return all(
        isinstance(curve, SmoothingSpline) and curve.argument == "displacement" for curve in pair
    )


def _own_curves(fit: JointFit) -> tuple[AbstractFamily, AbstractFamily, np.ndarray]:
    squared, damping = fit.unknowns.squared_frequency, fit.unknowns.modal_damping
    n = squared.parameters.shape[0] + damping.parameters.shape[0]
    return squared, damping, fit.covariance[:n, :n]


def _redrawn(
    fit: JointFit, argument: Argument, reach: float
) -> tuple[AbstractFamily, AbstractFamily, np.ndarray]:
    """Splines through values of both curves, and the covariance of these values."""
    squared = fit.unknowns.squared_frequency
    displacement = reach * fit.largest[0] * np.linspace(0.0, 1.0, _KNOTS)
    if isinstance(squared, Spline) and _are_smooth(fit):
        displacement = float(squared.scale) * np.sqrt(np.asarray(squared.knots))
    with np.errstate(invalid="ignore"):
        positive = values_at_displacement(fit, displacement).values[:, 0] > 0
    # A polynomial may fall below zero beyond the data: there is no motion there.
    displacement = displacement[: np.append(positive, False).argmin()]
    curves = values_at_displacement(fit, displacement)
    if argument == "velocity":
        curves = values_at_velocity(fit, curves.velocity)
    at, values = getattr(curves, argument), curves.values
    # Dry friction has no finite damping at rest: there the next knot's value stands.
    values[0] = np.where(np.isfinite(values[0]), values[0], values[1])
    pair = (
        Spline.through((at / at[-1]) ** 2, values[:, k], jax.device_put(at[-1]), argument)
        for k in range(2)
    )
    rows = np.concatenate([curves.slopes[:, 0], curves.slopes[:, 1]])
    return *pair, rows @ fit.covariance @ rows.T


class OnBackbone(NamedTuple):
    """Both curves, ω̃² and 2ζ̃ω̃, at points on the backbone, where Ω = ω̃."""

    values: Float[np.ndarray, "point curve"]
    slopes: Float[np.ndarray, "point curve unknown"]  # by the free unknowns
    displacement: Float[np.ndarray, " point"]
    velocity: Float[np.ndarray, " point"]


def values_at_velocity(fit: JointFit, velocity: Float[np.ndarray, " point"]) -> OnBackbone:
    """Both curves, with their derivatives by the free unknowns at those velocities.

    Raises `ValueError` where the backbone has a velocity at several displacements, or at none.
    """
    reached = _near(fit, float(np.max(velocity)))
    if reached.turns_back_at is not None:
        raise ValueError(
            f"the backbone turns back at {reached.turns_back_at:.4g} m/s: there velocities belong "
            "to several displacements; ask for values at displacements."
        )
    if np.max(velocity) > reached.speed[-1]:
        raise ValueError(f"the backbone does not reach {np.max(velocity):.4g} m/s.")
    near = np.interp(velocity, reached.speed, reached.displacement)
    return _on_backbone(fit, velocity, near)


def values_at_displacement(fit: JointFit, displacement: Float[np.ndarray, " point"]) -> OnBackbone:
    """Both curves, with their derivatives by the free unknowns at those displacements."""
    return _on_backbone(fit, displacement, None)


def _on_backbone(
    fit: JointFit, at: Float[np.ndarray, " point"], near: Float[np.ndarray, " point"] | None
) -> OnBackbone:
    """ω̃² and 2ζ̃ω̃ and their derivatives, by the host.

    Arguments: `at` displacements, at which derivatives are taken, or, where displacements `near`
    them are given, velocities. Where a curve is a function of the other amplitude this is the one
    that belongs to it, and moves with the curves' parameters.
    """
    unknowns = fit.unknowns
    curves = unknowns.squared_frequency, unknowns.modal_damping
    n = curves[0].parameters.shape[0]
    of_velocity = [curve.argument == "velocity" for curve in curves]
    given_velocity = near is not None
    at = np.asarray(at, dtype=float)
    if of_velocity[0] == given_velocity:
        squared, by_own, _ = curves[0].linearised(at)
        root = np.sqrt(squared)
        other = at / root if given_velocity else at * root
        # x = v/√s or v = x√s.
        moves = (-0.5 if given_velocity else 0.5) * (other / squared)[:, None] * by_own
    else:
        other = at * np.sqrt(curves[0].linearised(0 * at)[0]) if near is None else near
        for _ in range(_ITERATIONS + 1):
            # v − x√s(x) for x, or x√s(v) − v for v.
            squared, by_own, steep = curves[0].linearised(other)
            root = np.sqrt(squared)
            gap = other * root - at if given_velocity else at * root - other
            sensitivity = (other if given_velocity else at) / (2 * root)
            slope = (root if given_velocity else -1.0) + sensitivity * steep
            moves = -(sensitivity / slope)[:, None] * by_own
            other = other - gap / slope
        by_own = by_own + steep[:, None] * moves
    displacement, velocity = (other, at) if given_velocity else (at, other)
    damping, by_damping, steep = curves[1].linearised(velocity if of_velocity[1] else displacement)
    # The unknowns after those of the curves move nothing here.
    slopes = np.zeros((len(at), 2, len(fit.covariance)))
    slopes[:, 0, :n], slopes[:, 1, n : n + by_damping.shape[1]] = by_own, by_damping
    if of_velocity[1] != given_velocity:
        slopes[:, 1, :n] = steep[:, None] * moves
    return OnBackbone(np.stack([squared, damping], axis=1), slopes, displacement, velocity)


class _Reached(NamedTuple):
    displacement: np.ndarray
    speed: np.ndarray
    turns_back_at: float | None  # m/s, below the velocity that was asked for


def _near(fit: JointFit, velocity: float) -> _Reached:
    """The backbone from rest to beyond the measured displacements and a velocity."""
    reach = fit.largest[0]
    for _ in range(_DOUBLINGS):
        x = np.linspace(0.0, reach, _SCAN)
        speed = _on_backbone(fit, x, None).velocity
        turns = np.flatnonzero(~(np.diff(speed) > 0))
        if turns.size and np.min(speed[turns[0] :]) < velocity:
            return _Reached(x, speed, float(speed[turns[0]]))
        if turns.size or speed[-1] >= velocity:
            break
        reach *= 2
    end = turns[0] + 1 if turns.size else len(x)
    return _Reached(x[:end], speed[:end], None)
