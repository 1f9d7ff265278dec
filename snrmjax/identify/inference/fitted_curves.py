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
from snrmjax.numerics.names import with_former_arguments
from snrmjax.numerics.rules import InputError

_SCAN = 256  # displacements at which the backbone is sampled to bracket a velocity
_ITERATIONS = 12
_KNOTS = 120  # of a named family interpolated as a `Backbone`
_DOUBLINGS = 6  # of the displacement range, to reach a velocity


@with_former_arguments({"of_a_new_level": "include_level_variance"})
@on_numbers("Differentiate `sj.identify.refit`.")
def fitted_values(
    fit: JointFit,
    velocity: Float[np.ndarray, " point"] | None = None,
    *,
    displacement: Float[np.ndarray, " point"] | None = None,
    include_level_variance: bool = False,
) -> BackboneValues:
    """ω̃ and ζ̃ at amplitudes on the backbone, with 1σ at that amplitude.

    Arguments: either `velocity` in m/s or `displacement` in m, zero allowed. With
    `include_level_variance` the bands are predictive: they include level-to-level variation.
    Raises `ValueError` for a velocity that the backbone has at several displacements, possible
    where it softens: give displacements there.
    Not differentiable: differentiate `snrmjax.identify.refit`.
    """
    if (velocity is None) == (displacement is None):
        raise InputError("give either `velocity` or `displacement`.")
    if velocity is not None:
        curves = values_at_velocity(fit, np.asarray(velocity, np.float64))
    else:
        curves = values_at_displacement(fit, np.asarray(displacement, np.float64))
    covariance = np.einsum("ocp,pq,odq->ocd", curves.slopes, fit.covariance, curves.slopes)
    squared, damping = curves.values.T
    if include_level_variance:
        stiffness, dissipation = np.asarray(fit.prior.new_level)[2:]
        covariance[:, 0, 0] += (squared * stiffness) ** 2
        covariance[:, 1, 1] += (damping * dissipation) ** 2
    return banded_values(curves.velocity, squared, damping, covariance)


def values_to_the_largest(fit: JointFit, n_points: int) -> BackboneValues:
    """`fitted_values` from rest to the largest measured amplitude.

    In equal steps of velocity, or of displacement where the velocity is not monotonic.
    """
    displacement, velocity = fit.largest
    steps = np.linspace(0.0, 1.0, n_points)
    if _backbone_to(fit, velocity).reverses_at is None:
        return fitted_values(fit, velocity * steps)
    return fitted_values(fit, displacement=displacement * steps)


def as_backbone(
    fit: JointFit, *, argument: Argument = "displacement", reach: float = 1.0
) -> Backbone:
    """The fitted curves as a `Backbone`, for response prediction.

    Smooth curves keep the fit's knots. Named families are interpolated at many knots, up to `reach`
    times the largest measured displacement; damping as a function of velocity is evaluated on the
    backbone. For `argument` "velocity" the knots are at the backbone's velocities.
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
    """Whether both curves are smoothing splines of displacement, which share their knots."""
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
    # A polynomial ω̃² may become negative beyond the data: cut it there.
    displacement = displacement[: np.append(positive, False).argmin()]
    curves = values_at_displacement(fit, displacement)
    if argument == "velocity":
        curves = values_at_velocity(fit, curves.velocity)
    at, values = getattr(curves, argument), curves.values
    # Dry friction has infinite damping at rest: use the next knot's value.
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
    """Both curves at these velocities, with derivatives by the free unknowns.

    Raises `ValueError` where the backbone has a velocity at several displacements, or at none.
    """
    backbone = _backbone_to(fit, float(np.max(velocity)))
    if backbone.reverses_at is not None:
        raise InputError(
            f"the backbone turns back at {backbone.reverses_at:.4g} m/s, so that a velocity has "
            "several displacements: give displacements instead."
        )
    if np.max(velocity) > backbone.speed[-1]:
        raise InputError(f"the backbone does not reach {np.max(velocity):.4g} m/s.")
    near = np.interp(velocity, backbone.speed, backbone.displacement)
    return _on_backbone(fit, velocity, near)


def values_at_displacement(fit: JointFit, displacement: Float[np.ndarray, " point"]) -> OnBackbone:
    """Both curves at these displacements, with derivatives by the free unknowns."""
    return _on_backbone(fit, displacement, None)


def _on_backbone(
    fit: JointFit, at: Float[np.ndarray, " point"], near: Float[np.ndarray, " point"] | None
) -> OnBackbone:
    """ω̃² and 2ζ̃ω̃ and their derivatives at fixed amplitude, on the host.

    Arguments: `at` displacements or, with approximate displacements `near`, velocities. A curve of
    the other amplitude is evaluated there by v = ω̃x, whose dependence on the curves' parameters is
    included in the derivatives.
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
            # Newton: x√s(x) − v = 0 for x, or x√s(v) − v = 0 for v.
            squared, by_own, steep = curves[0].linearised(other)
            root = np.sqrt(squared)
            residual = other * root - at if given_velocity else at * root - other
            sensitivity = (other if given_velocity else at) / (2 * root)
            slope = (root if given_velocity else -1.0) + sensitivity * steep
            moves = -(sensitivity / slope)[:, None] * by_own
            other = other - residual / slope
        by_own = by_own + steep[:, None] * moves
    displacement, velocity = (other, at) if given_velocity else (at, other)
    damping, by_damping, steep = curves[1].linearised(velocity if of_velocity[1] else displacement)
    # The other unknowns do not enter the curves.
    slopes = np.zeros((len(at), 2, len(fit.covariance)))
    slopes[:, 0, :n], slopes[:, 1, n : n + by_damping.shape[1]] = by_own, by_damping
    if of_velocity[1] != given_velocity:
        slopes[:, 1, :n] = steep[:, None] * moves
    return OnBackbone(np.stack([squared, damping], axis=1), slopes, displacement, velocity)


class _BackboneRange(NamedTuple):
    displacement: np.ndarray
    speed: np.ndarray
    reverses_at: float | None  # m/s, below the requested velocity


def _backbone_to(fit: JointFit, velocity: float) -> _BackboneRange:
    """The backbone from rest to at least the measured displacements and this velocity."""
    reach = fit.largest[0]
    for _ in range(_DOUBLINGS):
        x = np.linspace(0.0, reach, _SCAN)
        speed = _on_backbone(fit, x, None).velocity
        reversals = np.flatnonzero(~(np.diff(speed) > 0))
        if reversals.size and np.min(speed[reversals[0] :]) < velocity:
            return _BackboneRange(x, speed, float(speed[reversals[0]]))
        if reversals.size or speed[-1] >= velocity:
            break
        reach *= 2
    end = reversals[0] + 1 if reversals.size else len(x)
    return _BackboneRange(x[:end], speed[:end], None)
