"""What a diagnosis knows of every kind of effect: the one table to add a hypothesis to."""

from typing import Any

import numpy as np

from snrmjax.diagnose import priors
from snrmjax.diagnose.kinds import changes, confounders, describing, starts
from snrmjax.diagnose.kinds.hypothesis import Hypothesis
from snrmjax.model.library import (
    damping,
    friction,
    internal_resonances,
    linear_changes,
    measurement_chain,
    stiffness,
)
from snrmjax.numerics.units import HERTZ

_INSTRUMENT: dict[str, Any] = {"odds": priors.INSTRUMENT, "of_instrument": True}
_OF_GAIN: dict[str, Any] = {"std": 1.0, **_INSTRUMENT}


def _resonance(order: int) -> Hypothesis:
    """An internal resonance with a mode at `order` times the frequency."""
    return Hypothesis(
        changes.resonance_change(order),
        changes.third_of_resonance(order),
        (changes.DETUNINGS, changes.DAMPINGS),
        sign=1,
        odds=priors.RESONANCE,
        parameters=changes.resonance_parameters(order),
        starts=starts.of_resonance(order),
        steps=starts.steps_of_resonance,
        idle=starts.mode_above(order),
        confounders=(confounders.WHICH_RESONANCE,),
    )


HYPOTHESES: dict[str, Hypothesis] = {
    linear_changes.LinearFrequencyShift.kind: Hypothesis(
        changes.stiffness_at_constant_damping_ratio,
        parameters=lambda r, s: (float(np.sqrt(max(1 + s, 0.0))) - 1,),
        confounders=(confounders.STIFFNESS_OR_MASS,),
    ),
    stiffness.CubicStiffness.kind: Hypothesis(
        *changes.of_force(lambda q, _: 4 / 3 * q**3),
        parameters=lambda r, s: (s * r.natural_frequency**2 / (0.75 * r.largest**2),),
        confounders=(confounders.SEPARATED_BY_MEAN_OR_SECOND_HARMONIC,),
    ),
    stiffness.QuinticStiffness.kind: Hypothesis(
        *changes.of_force(lambda q, _: 1.6 * q**5),
        parameters=lambda r, s: (s * r.natural_frequency**2 / (0.625 * r.largest**4),),
    ),
    stiffness.QuadraticStiffness.kind: Hypothesis(
        lambda r, log_s, _: changes.quadratic_change(r, log_s)[0],
        changes.second_harmonic_of(changes.quadratic_change),
        axes=(changes.QUADRATICS,),
        choices=(1.0, -1.0),
        sign=1,
        parameters=lambda r, s, log_s, side: (
            side * float(np.exp(log_s) * np.sqrt(max(s, 0.0))) * r.natural_frequency**2 / r.largest,
        ),
        confounders=(confounders.SEPARATED_BY_MEAN_OR_SECOND_HARMONIC,),
    ),
    stiffness.BilinearStiffness.kind: Hypothesis(
        lambda r, log_k, _: changes.bilinear_change(r, log_k)[0],
        changes.second_harmonic_of(changes.bilinear_change),
        axes=(changes.BILINEARS,),
        choices=(1.0, -1.0),
        sign=-1,
        parameters=lambda r, s, log_k, side: (
            side * float(np.exp(log_k) * np.sqrt(max(-s, 0.0))) * r.natural_frequency**2,
        ),
        starts=starts.of_bilinear_spring,
        confounders=(confounders.STRUCTURE_OR_FORCE_SPECTRUM,),
    ),
    stiffness.GapStiffness.kind: Hypothesis(
        *changes.of_force(lambda q, _, width: np.sign(q) * np.maximum(np.abs(q) - width, 0.0)),
        (changes.GAPS,),
        sign=1,
        parameters=lambda r, s, width: (s * r.natural_frequency**2, width * r.largest),
        starts=starts.of_contact(3.0),
        confounders=(confounders.ONE_SIDED_OR_TWO_SIDED,),
    ),
    stiffness.OneSidedStop.kind: Hypothesis(
        *changes.of_force(changes.at_stop),
        (changes.GAPS, changes.STIFFNESSES),
        sign=1,
        parameters=lambda r, s, width, _: (s * r.natural_frequency**2, width * r.largest),
        starts=starts.of_contact(6.0),
        confounders=(confounders.ONE_SIDED_OR_TWO_SIDED,),
    ),
    linear_changes.LinearDampingChange.kind: Hypothesis(
        lambda r: 1j * r.relative_frequency, parameters=lambda r, s: (s / 2,)
    ),
    damping.QuadraticDamping.kind: Hypothesis(
        *changes.of_force(lambda _, v: 3 * np.pi / 8 * v * np.abs(v)),
        sign=1,
        parameters=lambda r, s: (s * 3 * np.pi / (8 * r.largest),),
        confounders=(confounders.SEPARATED_BY_THIRD_HARMONIC,),
    ),
    damping.CubicDamping.kind: Hypothesis(
        *changes.of_force(lambda _, v: 4 / 3 * v**3),
        parameters=lambda r, s: (s / (0.75 * r.largest**2 * r.natural_frequency),),
        confounders=(confounders.SEPARATED_BY_THIRD_HARMONIC,),
    ),
    damping.VanDerPolDamping.kind: Hypothesis(
        *changes.of_force(lambda q, v: 4 * q**2 * v),
        parameters=lambda r, s: (4 * s * r.natural_frequency / r.largest**2,),
        confounders=(confounders.SEPARATED_BY_THIRD_HARMONIC,),
    ),
    friction.CoulombFriction.kind: Hypothesis(
        *changes.of_force(lambda _, v: np.pi / 4 * np.sign(v)),
        sign=1,
        parameters=lambda r, s: (s * r.natural_frequency**2 * np.pi * r.largest / 4,),
        confounders=(confounders.FRICTION_OR_FORCE_OFFSET,),
    ),
    friction.JenkinsSlider.kind: Hypothesis(
        *changes.of_force(lambda q, v, log_slip: describing.slipping(q, v, np.exp(log_slip))),
        (changes.SLIPS,),
        sign=1,
        parameters=lambda r, s, log_slip: (
            s * r.natural_frequency**2,
            float(np.exp(log_slip)) * r.largest,
        ),
        starts=starts.of_slider,
    ),
    friction.IwanMicroslip.kind: Hypothesis(
        *changes.of_force(describing.microslip),
        (changes.EXPONENTS,),
        sign=1,
        parameters=lambda r, s, p: (s * r.natural_frequency**2 / r.largest ** (p - 1), p),
        starts=starts.of_microslip,
    ),
    internal_resonances.InternalResonanceOneToTwo.kind: _resonance(2),
    internal_resonances.InternalResonanceOneToThree.kind: _resonance(3),
    linear_changes.AddedMass.kind: Hypothesis(
        lambda r: -(r.relative_frequency**2) * priors.ADDED_MASS + 0j,
        std=1.0,
        odds=priors.INSTRUMENT,
        parameters=lambda r, s: (s * priors.ADDED_MASS,),
        confounders=(confounders.STIFFNESS_OR_MASS,),
        like_force_gain=True,
    ),
    measurement_chain.ForceHarmonics.kind: Hypothesis(
        lambda r, _: np.zeros_like(r.dynamic_stiffness),
        changes.forced_harmonic,
        choices=(2.0, 3.0),
        parameters=lambda r, s, order: (s * (order == 2), s * (order == 3)),
        confounders=(confounders.STRUCTURE_OR_FORCE_SPECTRUM,),
        **_INSTRUMENT,
    ),
    measurement_chain.ForceGainError.kind: Hypothesis(
        lambda r: changes.relative_stiffness(r) * priors.GAIN,
        parameters=lambda r, s: (-s * priors.GAIN,),
        confounders=(confounders.RESPONSE_SCALE, confounders.FORCE_OR_SENSOR_GAIN),
        like_force_gain=True,
        **_OF_GAIN,
    ),
    measurement_chain.SensorGainError.kind: Hypothesis(
        changes.larger_motion(0),
        changes.harmonics_of_larger_motion(0),
        axes=(changes.MOTION_GAINS,),
        unit=priors.GAIN,
        parameters=lambda r, s, _: (s * priors.GAIN,),
        confounders=(confounders.RESPONSE_SCALE, confounders.FORCE_OR_SENSOR_GAIN),
        like_force_gain=True,
        **_OF_GAIN,
    ),
    measurement_chain.ModeShapeChange.kind: Hypothesis(
        changes.larger_motion(2),
        changes.harmonics_of_larger_motion(2),
        axes=(changes.MOTION_GAINS,),
        unit=priors.GAIN,
        std=1.0,
        odds=priors.INSTRUMENT,
        parameters=changes.shape_change,
        confounders=(confounders.RESPONSE_SCALE,),
    ),
    measurement_chain.CloseMode.kind: Hypothesis(
        changes.close_mode_change,
        axes=(changes.APART, changes.DAMPINGS),
        parameters=lambda r, s, apart, log_times: (
            -s * r.constant,
            (1 + apart) * r.natural_frequency / HERTZ,
            float(np.exp(log_times)) * max(r.damping_ratio, 1e-4),
        ),
        starts=starts.of_close_mode,
        steps=starts.steps_of_close_mode,
        idle=starts.mode_above(1),
        confounders=(confounders.FURTHER_MODE,),
        follows_force=True,
        searched=False,
        **_INSTRUMENT,
    ),
    measurement_chain.ResidualMode.kind: Hypothesis(
        lambda r: changes.relative_stiffness(r) ** 2,
        parameters=lambda r, s: (-s * r.constant / r.natural_frequency**2,),
        confounders=(confounders.FAR_MODE_OR_PHASE_ERROR,),
        follows_force=True,
        **_INSTRUMENT,
    ),
    measurement_chain.SensorPhaseError.kind: Hypothesis(
        lambda r: -1j * changes.relative_stiffness(r) * priors.INSTRUMENT_PHASE,
        parameters=lambda r, s: (float(np.rad2deg(s * priors.INSTRUMENT_PHASE)),),
        confounders=(confounders.FAR_MODE_OR_PHASE_ERROR,),
        only_phase=True,
        **_OF_GAIN,
    ),
    measurement_chain.ForceOffsetError.kind: Hypothesis(
        lambda r: changes.relative_stiffness(r) * np.min(r.force) / r.force * priors.FORCE_OFFSET,
        parameters=lambda r, s: (-s * priors.FORCE_OFFSET * float(np.min(r.force)),),
        confounders=(confounders.FRICTION_OR_FORCE_OFFSET,),
        **_OF_GAIN,
    ),
    linear_changes.FrequencyDrift.kind: Hypothesis(
        lambda r: 2 * r.order * priors.DRIFT * changes.stiffness_at_constant_damping_ratio(r),
        parameters=lambda r, s: (s * priors.DRIFT,),
        confounders=(confounders.DRIFT,),
        **_OF_GAIN,
    ),
    stiffness.StaticPreload.kind: Hypothesis(
        # Without effect on a linear structure; with a cubic spring it acts like a quadratic one.
        lambda r, log_static, _: changes.preload_change(r, log_static)[0],
        changes.second_harmonic_of(changes.preload_change),
        axes=(changes.PRELOADS,),
        choices=(1.0, -1.0),
        sign=1,
        parameters=changes.preload,
        starts=starts.of_preload,
        confounders=(confounders.SEPARATED_BY_MEAN_OR_SECOND_HARMONIC,),
    ),
}
"""By kind: every effect of the library, and those that `register_hypothesis` adds."""
