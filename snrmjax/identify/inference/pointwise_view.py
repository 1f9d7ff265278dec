"""A joint fit in the form of a pointwise identification: points, curves and predictions."""

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from snrmjax.identify.inference.fitted_curves import as_backbone
from snrmjax.identify.inference.fitted_response import FittedResponse
from snrmjax.identify.joint.force_balance import with_deviations
from snrmjax.identify.joint.joint_fit import JointFit
from snrmjax.identify.pointwise.backbone import BackboneFit
from snrmjax.identify.pointwise.backbone_points import identify_points
from snrmjax.identify.pointwise.identification import (
    Identification,
    errors_from_scatter,
    notes_on_phases,
    notes_on_points,
)
from snrmjax.identify.pointwise.prediction import PredictedResponse, Resonance
from snrmjax.measure.states import SteadyStates
from snrmjax.model.modes import residual_velocity

_FREE_PHASE = (
    "let the fit estimate it (`--free instrument_phase`; in Python "
    '`fit_jointly(…, free=["instrument_phase"])`)'
)
_PHASE_FREED = (
    "since this fit has already estimated it, check the force calibration and trust points near "
    "resonance"
)


def identification_of_fit(data: SteadyStates, fit: JointFit) -> Identification:
    """Each steady state's own point beside the curves of a joint fit.

    Points come from the inverse method, as those of `identify_backbone` do; no curves are fitted
    to them. Where no noise is stated their 1σ is what the joint fit found: its noise, and errors
    of gain, phase, natural frequency and damping that the states of a level share.

    Arguments: `data` are the steady states of the fit, with forces in newtons.
    Returns an `Identification` whose `notes` are those of the fit and of the points.
    """
    points = identify_points(data, fit.modes_found)
    j = fit.modes.mode_of_interest
    own, ratio = (float(v[j]) for v in (fit.modes.natural_frequency, fit.modes.damping_ratio))
    curves = BackboneFit(
        backbone=as_backbone(fit),
        noise_scale=(fit.noise.scale, fit.noise.scale),
        level_frequency_std=0.5 * float(fit.noise.level_std[2]) * own,
        level_damping_std=float(fit.noise.level_std[3]) * ratio,
        noise_stated=fit.noise.stated,
        anchor=None,
    )
    if not fit.noise.stated:
        gain, phase = map(float, fit.noise.level_std[:2])
        wandering = 0.5 * own * float(np.max(np.asarray(fit.data.std)[:, 3]))
        points = errors_from_scatter(
            points,
            curves,
            level_gain=gain,
            level_phase=phase,
            frequency_std=wandering,
            modal_mass_std=fit.modes_found.own_modal_mass_std,
        )
    freed = "instrument_phase" in fit.free
    consequence = "have no point of their own (the joint fit uses them)"
    notes = (
        *fit.notes,
        *notes_on_points(points, fit.modes, consequence),
        *notes_on_phases(points, curves, _PHASE_FREED if freed else _FREE_PHASE),
    )
    return Identification(points, curves, notes)


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
