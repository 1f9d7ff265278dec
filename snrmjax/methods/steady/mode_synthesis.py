"""Nonlinear mode synthesis: responses near resonance from a measured mode, unstable parts too.

A mode whose natural frequency ω̃(a) and damping ratio ζ̃(a) were measured against its amplitude a
answers a force of one frequency as a linear mode of that amplitude does,

    (ω̃² − Ω² + 2iζ̃ω̃Ω) a = |Φ_r Φᵀb| F,

with a as displacement at the sensor, so that each amplitude has two frequencies, and both together
are the whole response, folds included. `predict_response` draws it for the inverse method; here
the backbone comes from any other: a phase-locked loop, continuation, a decay.

Reference: S. Peter, M. Scheel, M. Krack & R. I. Leine, Mech. Syst. Signal Process. 101 (2018) 498,
doi:10.1016/j.ymssp.2017.09.014.
"""

import interpax
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from snrmjax.identify.curves.family_base import AbstractCurve
from snrmjax.identify.pointwise.backbone import Backbone
from snrmjax.identify.pointwise.prediction import LARGEST_AMPLITUDE_RATIO, predict_response
from snrmjax.identify.pointwise.prediction_result import PredictedResponse
from snrmjax.methods.one_sensor import drive_point
from snrmjax.methods.result import MethodResult
from snrmjax.model.modes import LinearModes, reference_sensor

_FEWEST_POINTS = 2
_SAME = 1e-6  # relative: amplitudes nearer than this are one


class ShapePreservingCurve(AbstractCurve):
    """A monotonicity-preserving cubic (PCHIP) in the squared amplitude, through `parameters`.

    Beyond its knots it goes on straight in the square of the amplitude.
    """

    knots: Float[Array, " parameter"]  # amplitudes, increasing

    def amplitude(self, displacement: Array, velocity: Array) -> Array:
        """See `AbstractCurve`."""
        return displacement

    def __call__(self, amplitude: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
        """See `AbstractCurve`."""
        knots = self.knots**2
        x = jnp.asarray(amplitude) ** 2
        inside = jnp.clip(x, knots[0], knots[-1])
        slopes = jax.vmap(jax.grad(lambda u: self._within(u[None])[0]))(knots[jnp.array([0, -1])])
        below, above = jnp.minimum(x - knots[0], 0.0), jnp.maximum(x - knots[-1], 0.0)
        value = self._within(inside.reshape(-1)).reshape(x.shape)
        return value + below * slopes[0] + above * slopes[1]

    def _within(self, square: Float[Array, " point"]) -> Float[Array, " point"]:
        method = "monotonic" if self.knots.shape[0] > 2 else "linear"
        return interpax.interp1d(square, self.knots**2, self.parameters, method=method, extrap=True)


def backbone_of(result: MethodResult, modes: LinearModes) -> Backbone:
    """What a method found as a curve through its points, for what takes a `Backbone`.

    ω̃² and 2ζ̃ω̃ against displacement, by PCHIP in its square; beyond the points along the end
    slopes. Points of equal amplitude count as their mean; 1σ that the method gives are those of
    the knots, others are zero. The modal constant |Φ_r Φᵀb| is that of `modes`.
    Raises `ValueError` where the method found fewer than two amplitudes.
    """
    good = result.found
    omega = np.asarray(result.natural_frequency)[good]
    ratio = np.asarray(result.damping_ratio)[good]
    size = np.asarray(result.velocity)[good] / omega
    order = np.argsort(size)
    apart = np.diff(size[order]) > _SAME * size[order][1:]
    group = np.zeros(len(order), dtype=int)
    group[1:] = np.cumsum(apart)
    knots = int(group[-1]) + 1 if len(group) else 0
    if knots < _FEWEST_POINTS:
        raise ValueError(
            f"`result` must have two amplitudes or more to draw a response, but {result.method} "
            f"found {knots}."
        )
    count = np.bincount(group)

    def mean(values: np.ndarray) -> np.ndarray:
        return np.bincount(group, values[order]) / count

    def variance(values: np.ndarray) -> np.ndarray:
        # Of a mean of independent points.
        return np.bincount(group, np.nan_to_num(values)[order]) / count**2

    omega_std = np.asarray(result.natural_frequency_std)[good]
    ratio_std = np.asarray(result.damping_ratio_std)[good]
    at = jnp.asarray(mean(size))
    both = variance((2 * omega * omega_std) ** 2), variance((2 * ratio_std * omega) ** 2)
    squared, damping = (
        ShapePreservingCurve(jnp.asarray(mean(values)), at[-1], at)
        for values in (omega**2, 2 * ratio * omega)
    )
    return Backbone(
        squared_frequency=squared,
        modal_damping=damping,
        covariance=jnp.diag(jnp.asarray(np.concatenate(both))),
        modal_constant=jnp.asarray(drive_point(modes)),
        smallest=at[0],
        largest=at[-1],
        argument="displacement",
        sensor=modes.sensors[reference_sensor(modes)],
    )


def synthesised_response(
    result: MethodResult,
    modes: LinearModes,
    force: float,
    *,
    from_frequency: float = 0.0,
    to_frequency: float = np.inf,
    largest_amplitude_ratio: float = LARGEST_AMPLITUDE_RATIO,
) -> list[PredictedResponse]:
    """The response to a force that a measured mode implies, both sides and the unstable part.

    Arguments: `result` of any method; `modes` have the modal mass of the mode of interest and the
    other modes, which are added as linear; `force` in N, frequencies in rad/s; amplitudes up to
    `largest_amplitude_ratio` times the largest that the method found.
    Returns connected curves, the main one first; `continued` says where they leave the measured
    amplitudes. Raises `ValueError` for a force that is not positive and as `backbone_of`.
    Validity: one well-separated mode whose shape changes little; the fundamental of the force.
    """
    return predict_response(
        backbone_of(result, modes),
        modes,
        force,
        from_frequency=from_frequency,
        to_frequency=to_frequency,
        largest_amplitude_ratio=largest_amplitude_ratio,
    )
