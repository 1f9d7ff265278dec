"""Backbones from controlled phase-resonance tests in the virtual laboratory."""

from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float

from snrmjax.methods.one_sensor import drive_point
from snrmjax.methods.result import MethodPoint, MethodResult, MethodStatus, method_result
from snrmjax.simulate.balance.given_numbers import positive
from snrmjax.simulate.virtual_test.laboratory import Laboratory
from snrmjax.simulate.virtual_test.phase_loop import LoopGains, locked_motions
from snrmjax.simulate.virtual_test.record_phasors import ControlledMotion
from snrmjax.simulate.virtual_test.target_feedback import FeedbackBench, FeedbackSettings

_SAME_VELOCITY = 0.02  # least relative difference of velocities that determines a slope


def phase_locked_loop(
    laboratory: Laboratory,
    voltages: Float[np.ndarray, " level"],
    *,
    gains: LoopGains | None = None,
    settle_cycles: int = 300,
    record_cycles: int = 50,
    seed: int = 0,
) -> MethodResult:
    """Backbone by a phase-locked loop that stays closed while the drive voltage is stepped up.

    Damping is from the power balance, 2ζ̃ω̃ = |Φ_r Φᵀb| F / |v|.

    Arguments: `voltages` in V, in the order of the test; the others as in `locked_motions`.
    Returns a `MethodResult` with a point per voltage. 1σ is from the sample noise, which the loop
    feeds into its frequency, or from the scatter between tenths of the record where that is
    larger, and from the noise of the point's velocity times the slope between the levels. Levels
    whose record is off phase resonance by more than 1°, or whose frequency varies by more than
    half of ζω (1σ), are `NOT_LOCKED`. `test_seconds` is the duration of the whole test.
    Raises `ValueError` for voltages or cycles that are not positive.
    Validity: where the natural frequency changes strongly over a small amplitude range (a stop, a
    gap) the loop must be faster than the growth of the motion: use higher gains or smaller steps.
    A loop that has not settled has an error of some times its remaining drift, which is not in 1σ:
    0.005 % of the frequency after 300 cycles at a large step with v|v| damping, none after 900.
    """
    motions, _, seconds = locked_motions(
        laboratory,
        [(float(voltage), 0.0) for voltage in positive("voltages", voltages)],
        gains=gains,
        settle_cycles=settle_cycles,
        record_cycles=record_cycles,
        seed=seed,
    )
    per_force = drive_point(laboratory.structure.modes)

    def point(level: int, motion: ControlledMotion) -> MethodPoint:
        damping = per_force * (motion.force / motion.velocity).real
        ratio = damping / (2 * motion.frequency)
        return MethodPoint(
            MethodStatus.FOUND,
            level,
            abs(motion.velocity),
            motion.frequency,
            motion.frequency_std,
            ratio,
            ratio * motion.ratio_std,
        )

    return method_result("pll", _points(motions, point), len(motions), test_seconds=seconds)


def control_based_continuation(
    laboratory: Laboratory,
    amplitudes: Float[np.ndarray, " level"],
    settings: FeedbackSettings,
    *,
    seed: int = 0,
) -> MethodResult:
    """Backbone: at each target amplitude the frequency at which velocity and force are in phase.

    The remaining phase error is corrected by the equation of motion of the mode,
    ω̃² − Ω² + 2iζ̃ω̃Ω = iΩ|Φ_r Φᵀb| F/v.

    Arguments: `amplitudes` of the target in m/s, rising. Returns a `MethodResult` with a point per
    amplitude; damping by the power balance. Amplitudes whose phase error stayed above 0.5°, whose
    feedback is invasive (its own harmonics exceed `settings.invasive`), or that were not steady
    within 1 %, are `NOT_LOCKED`. 1σ covers the noise and the scatter within a record, but neither
    a close second mode nor harmonics of the force. `test_seconds` is the duration of the test.
    Raises `ValueError` for numbers that are not positive.
    """
    bench = FeedbackBench(laboratory, settings, seed)
    motions, omega = [], laboratory.frequency
    for amplitude in positive("amplitudes", amplitudes):
        motions.append(bench.resonance(omega, float(amplitude)))
        omega = motions[-1].frequency if motions[-1].on_target else omega
    per_force = drive_point(laboratory.structure.modes)

    def point(level: int, motion: ControlledMotion) -> MethodPoint:
        balance = per_force * motion.force / motion.velocity  # 2ζ̃ω̃ + (ω̃² − Ω²)/(iΩ)
        natural = float(np.sqrt(motion.frequency**2 - motion.frequency * balance.imag))
        error = abs(balance) * motion.ratio_std
        return MethodPoint(
            MethodStatus.FOUND,
            level,
            abs(motion.velocity),
            natural,
            error / 2,
            balance.real / (2 * natural),
            error / (2 * natural),
        )

    return method_result("cbc", _points(motions, point), len(motions), test_seconds=bench.seconds)


def _points(
    motions: Sequence[ControlledMotion], point: Callable[[int, ControlledMotion], MethodPoint]
) -> list[MethodPoint]:
    """Points of locked motions; their 1σ includes the error of the velocity along the curve."""
    points = [
        point(level, motion) if motion.on_target else MethodPoint(MethodStatus.NOT_LOCKED, level)
        for level, motion in enumerate(motions, 1)
    ]
    locked = [k for k, motion in enumerate(motions) if motion.on_target]
    at = np.log([points[k].velocity for k in locked])
    order = np.argsort(at)
    if len(locked) < 2 or not np.all(np.diff(at[order]) > _SAME_VELOCITY):
        return points
    curves = np.array([(points[k].natural_frequency, points[k].damping_ratio) for k in locked])
    slopes = np.empty_like(curves)
    slopes[order] = np.gradient(curves[order], at[order], axis=0)
    for k, slope in zip(locked, slopes, strict=True):
        frequency, ratio = slope * motions[k].velocity_std
        point_of_level = points[k]
        points[k] = point_of_level._replace(
            natural_frequency_std=float(np.hypot(point_of_level.natural_frequency_std, frequency)),
            damping_ratio_std=float(np.hypot(point_of_level.damping_ratio_std, ratio)),
        )
    return points
