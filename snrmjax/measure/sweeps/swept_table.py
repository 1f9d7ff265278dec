"""Swept phasors as a table of steady states, each with the force that would sustain it."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float

from snrmjax.measure.recordings.channels import DERIVATIVE
from snrmjax.measure.recordings.velocity_states import ChosenChannels, PhasorTable
from snrmjax.measure.sweeps.sweep_correction import ModalBalance, SweptMotion, fraction_of_bias
from snrmjax.measure.sweeps.swept_phasors import SweptPhasors, displacement_series


class Moment(NamedTuple):
    """The phasors of a sweep at one moment."""

    sweep: int
    phasors: SweptPhasors
    motion: Complex[np.ndarray, "channel power"]  # displacements of the responses, m
    motion_std: Float[np.ndarray, "channel power"]


def swept_moment(chosen: ChosenChannels, sweep: int, phasors: SweptPhasors) -> Moment:
    """The displacements of all responses at one moment, from any recorded motion."""
    motion, std = [], []
    rows = (chosen.responses, phasors.series[1:], phasors.std[1:])
    for channel, series, error in zip(*rows, strict=True):
        times = DERIVATIVE[channel.quantity]
        motion.append(displacement_series(series[None], phasors.rate, times)[0])
        std.append(error / phasors.rate[0] ** times)
    return Moment(sweep, phasors, np.array(motion), np.array(std))


def reference_response(moments: list[Moment]) -> int:
    """The response with the largest signal-to-noise ratio."""
    amplitude = np.abs([moment.motion[:, 0] for moment in moments])
    ratio = amplitude / np.fmax([moment.motion_std[:, 0] for moment in moments], 1e-300)
    return int(np.argmax(np.median(ratio, axis=0)))


def swept_motion(moments: list[Moment], reference: int) -> SweptMotion:
    """Force, and displacement of one response with its derivatives."""
    series = np.array([moment.motion[reference] for moment in moments])
    return SweptMotion(
        np.array([moment.phasors.rate[0] for moment in moments]),
        np.array([moment.phasors.rate[1] for moment in moments]),
        np.array([moment.phasors.series[0, 0] for moment in moments]),
        series[:, 0],
        series[:, 1],
        2 * series[:, 2],
        np.array([moment.motion_std[reference, 1] for moment in moments]),
    )


def steady_force(
    moments: list[Moment], reference: int, balance: ModalBalance, corrected: bool
) -> tuple[Complex[np.ndarray, " state"], Float[np.ndarray, " state"]]:
    """Force that would sustain each state, and the rms of its complex error.

    Without correction the error includes the estimated bias of the sweep.
    """
    motion = swept_motion(moments, reference)
    std = np.array([moment.phasors.std[0, 0] for moment in moments])
    if not corrected:
        return motion.force, np.hypot(std, np.abs(motion.force) * fraction_of_bias(motion))
    transient = balance.force_to_move(motion)
    of_slope = 2 * motion.frequency * motion.first_std / abs(balance.constant)
    of_constant = np.abs(transient) * balance.constant_std / abs(balance.constant)
    return motion.force - transient, np.sqrt(std**2 + of_slope**2 + of_constant**2)


def table_of(
    moments: list[Moment],
    chosen: ChosenChannels,
    force: Complex[np.ndarray, " state"],
    force_error: Float[np.ndarray, " state"],
) -> PhasorTable:
    """Phasors relative to the sustaining force of each state, with their errors."""
    omega = np.array([moment.phasors.rate[0] for moment in moments])
    phasors = np.array([moment.phasors.harmonics[1:] for moment in moments])
    times = np.array([DERIVATIVE[moment.quantity] for moment in chosen.responses])
    # A steady motion of the same displacement.
    steady = np.array([moment.motion[:, 0] for moment in moments])
    phasors[:, :, 0] = steady * (1j * omega[:, None]) ** times
    unit = force / np.abs(force)
    order = 1 + np.arange(phasors.shape[2])
    std = np.array([moment.phasors.std[1:, 0] for moment in moments]) / np.sqrt(2)
    force_std = force_error / np.sqrt(2)
    return PhasorTable(
        np.array([moment.phasors.time for moment in moments]),
        omega,
        np.abs(force),
        force_std,
        phasors * unit.conj()[:, None, None] ** order,
        np.array([moment.phasors.mean[1:] for moment in moments]),
        std,
        np.hypot(std / np.abs(phasors[:, :, 0]), (force_std / np.abs(force))[:, None]),
        np.array([moment.phasors.harmonic_std[1:] for moment in moments]),
    )
