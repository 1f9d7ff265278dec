"""What a joint fit predicts in the form that curves without bands have."""

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from snrmjax.identify.inference.fitted_response import FittedResponse
from snrmjax.identify.joint.force_balance import with_deviations
from snrmjax.identify.joint.joint_fit import JointFit
from snrmjax.identify.pointwise.prediction import PredictedResponse, Resonance
from snrmjax.model.modes import residual_velocity


class FitPrediction(NamedTuple):
    """What a joint fit predicts under one force, on its own curves and without bands."""

    resonances: list[Resonance]
    responses: list[PredictedResponse]


def without_bands(fit: JointFit, curves: Sequence[FittedResponse]) -> FitPrediction:
    """Resonances and response curves of a joint fit, as those of a backbone are given.

    They lie exactly on the curves of the fit. At a phase resonance the mode moves in phase with
    the force: 2ζ̃ω̃ = |A|F/v, with v the velocity amplitude of the mode alone.

    Arguments: `curves` from `fitted_response`, the main one first.
    Returns the resonances in order of amplitude, and the curves in their order.
    """
    modes, sensor = fit.modes, fit.data.sensor
    constant = float(fit.problem.constant_of(fit.unknowns))
    linear = with_deviations(modes, fit.unknowns.linear, fit.prior.linear)

    def of_other_modes(frequency: np.ndarray, force: float) -> np.ndarray:
        load = jnp.full(frequency.shape, force)
        others = residual_velocity(linear, jnp.asarray(frequency), load)[:, sensor]
        return np.asarray(others) * np.sign(constant)

    found, responses = [], []
    for number, curve in enumerate(curves):
        own = curve.velocity * np.sign(constant) - of_other_modes(curve.frequency, curve.force)
        responses.append(
            PredictedResponse(
                force=curve.force,
                frequency=curve.frequency,
                velocity=curve.velocity,
                amplitude=np.abs(own) / curve.frequency,
                stable=curve.stable,
                branch=tuple(np.where(own.imag >= 0, "lead", "lag").tolist()),
                continued=curve.continued,
                isolated=number > 0,
                note=curve.note,
            )
        )
        for point in curve.resonances:
            other = complex(of_other_modes(np.array([point.frequency]), point.force)[0])
            # |v + other| is the velocity of the point, and v is real.
            speed = np.sqrt(point.velocity**2 - other.imag**2) - other.real
            found.append(
                Resonance(
                    force=point.force,
                    amplitude=float(speed / point.frequency),
                    frequency=point.frequency,
                    damping_ratio=float(
                        abs(constant) * point.force / (2 * point.frequency * speed)
                    ),
                    velocity=point.velocity,
                    continued=point.continued,
                )
            )
    return FitPrediction(sorted(found, key=lambda one: one.amplitude), responses)
