"""Phasors of a sweep's moments as a table of steady states, each with the force that holds it."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float

from snrmjax.measure.recordings.velocity_states import ChosenChannels, PhasorTable
from snrmjax.measure.sweeps.sweep_correction import ModalBalance, SweptMotion, share_of_bias
from snrmjax.measure.sweeps.swept_phasors import SweptPhasors, displacement_series

_INTEGRATIONS = {"displacement": 0, "velocity": 1, "acceleration": 2}
_PAIR = 0.2  # relative difference of amplitudes that are one state in both directions


class Moment(NamedTuple):
    """One state on its way from the sweep."""

    sweep: int
    wanted: float  # rad/s
    found: SweptPhasors
    motion: Complex[np.ndarray, "channel power"]  # displacements of the responses, m
    motion_std: Float[np.ndarray, "channel power"]


def swept_moment(chosen: ChosenChannels, sweep: int, omega: float, found: SweptPhasors) -> Moment:
    """The displacements of all responses at one moment, whatever motion was recorded."""
    motion, std = [], []
    for one, series, error in zip(chosen.responses, found.series[1:], found.std[1:], strict=True):
        times = _INTEGRATIONS[one.quantity]
        motion.append(displacement_series(series[None], found.rate, times)[0])
        std.append(error / found.rate[0] ** times)
    return Moment(sweep, omega, found, np.array(motion), np.array(std))


def reference_response(moments: list[Moment]) -> int:
    """The response that stands out of its noise most."""
    ratio = [np.abs(one.motion[:, 0]) / np.fmax(one.motion_std[:, 0], 1e-300) for one in moments]
    return int(np.argmax(np.median(ratio, axis=0)))


def swept_motion(moments: list[Moment], reference: int) -> SweptMotion:
    """Force and displacement of one response, with how the displacement changes."""
    series = np.array([one.motion[reference] for one in moments])
    return SweptMotion(
        np.array([one.found.rate[0] for one in moments]),
        np.array([one.found.rate[1] for one in moments]),
        np.array([one.found.series[0, 0] for one in moments]),
        series[:, 0],
        series[:, 1],
        2 * series[:, 2],
        np.array([one.motion_std[reference, 1] for one in moments]),
    )


def held_force(
    moments: list[Moment], reference: int, balance: ModalBalance, corrected: bool
) -> tuple[Complex[np.ndarray, " state"], Float[np.ndarray, " state"]]:
    """Force that would hold each state, and the rms of its complex error.

    Without correction the error holds what the sweep may have done.
    """
    motion = swept_motion(moments, reference)
    std = np.array([one.found.std[0, 0] for one in moments])
    if not corrected:
        return motion.force, np.hypot(std, np.abs(motion.force) * share_of_bias(motion))
    moving = balance.force_to_move(motion)
    of_slope = 2 * motion.frequency * motion.first_std / abs(balance.constant)
    of_constant = np.abs(moving) * balance.constant_std / abs(balance.constant)
    return motion.force - moving, np.sqrt(std**2 + of_slope**2 + of_constant**2)


def table_of(
    moments: list[Moment],
    chosen: ChosenChannels,
    held: Complex[np.ndarray, " state"],
    held_std: Float[np.ndarray, " state"],
) -> PhasorTable:
    """Phasors relative to the force that holds each state, with their errors."""
    omega = np.array([one.found.rate[0] for one in moments])
    phasors = np.array([one.found.harmonics[1:] for one in moments])
    times = np.array([_INTEGRATIONS[one.quantity] for one in chosen.responses])
    # A steady motion of the same displacement.
    steady = np.array([one.motion[:, 0] for one in moments])
    phasors[:, :, 0] = steady * (1j * omega[:, None]) ** times
    unit = held / np.abs(held)
    order = 1 + np.arange(phasors.shape[2])
    std = np.array([one.found.std[1:, 0] for one in moments]) / np.sqrt(2)
    force_std = held_std / np.sqrt(2)
    return PhasorTable(
        np.array([one.found.time for one in moments]),
        omega,
        np.abs(held),
        force_std,
        phasors * unit.conj()[:, None, None] ** order,
        np.array([one.found.mean[1:] for one in moments]),
        std,
        np.hypot(std / np.abs(phasors[:, :, 0]), (force_std / np.abs(held))[:, None]),
        np.array([one.found.harmonic_std[1:] for one in moments]),
    )


def pairs_of(wanted: np.ndarray, rising: np.ndarray, table: PhasorTable) -> list[tuple[int, int]]:
    """Rows that are one state, passed upwards and downwards; others alone (twice themselves)."""
    size = np.abs(table.phasors[:, :, 0])
    free, pairs = set(range(len(wanted))), []
    for k in range(len(wanted)):
        if k not in free:
            continue
        free.remove(k)
        partners = [
            m
            for m in sorted(free)
            if wanted[m] == wanted[k]
            and rising[m] != rising[k]
            and np.all(np.abs(np.log(size[m] / size[k])) < _PAIR)
            and abs(np.log(table.force[m] / table.force[k])) < _PAIR
        ]
        pairs.append((k, partners[0] if partners else k))
        free -= set(partners[:1])
    return pairs


def averaged_table(table: PhasorTable, pairs: list[tuple[int, int]]) -> PhasorTable:
    """Means of pairs of rows; a row that is paired with itself stays."""
    up, down = (np.array(rows) for rows in zip(*pairs, strict=True))
    alone = up == down

    def middle(values: np.ndarray) -> np.ndarray:
        return (values[up] + values[down]) / 2

    def error(std: np.ndarray) -> np.ndarray:
        both = np.sqrt(std[up] ** 2 + std[down] ** 2) / 2
        return np.where(alone.reshape(-1, *[1] * (std.ndim - 1)), std[up], both)

    return PhasorTable(
        middle(table.time),
        middle(table.frequency),
        middle(table.force),
        error(table.force_std),
        middle(table.phasors),
        middle(table.mean),
        error(table.amplitude_std),
        error(table.phase_std),
        error(table.harmonic_std),
    )
