"""Sections of a test at equal displacement: at each, a nonlinear structure answers linearly."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float

from snrmjax.methods.one_sensor import SensorStates

CONTROLLED = 0.1
"""Largest relative spread of the displacement within a level that counts as controlled.

Response control holds velocities or displacements to some per cent; a resonance under constant
force changes them several times over.
"""
_SECTIONS = 15  # amplitudes at which levels of constant force are cut
_LEAST = 3  # states of a section: two give a mode without anything left to check it


class AmplitudeSection(NamedTuple):
    """States of one amplitude of displacement."""

    level: int  # -1 where the states come from several levels
    amplitude: float  # m
    frequency: Float[np.ndarray, " state"]  # rad/s, rising
    stiffness: Complex[np.ndarray, " state"]  # force over displacement, N/m


def sections_of(states: SensorStates) -> tuple[list[AmplitudeSection], list[int]]:
    """Sections at equal displacement, and the levels whose displacement was controlled.

    A level whose displacement stays within `CONTROLLED` is a section as it is. Where no level
    is, all are cut at amplitudes that several of them reach, interpolated on each side.
    """
    levels = dict(states.levels())
    held = [
        level for level, at_level in levels.items() if displacement_spread(at_level) <= CONTROLLED
    ]
    if held:
        return [_controlled(level, levels[level]) for level in held], held
    sides = [
        side
        for at_level in levels.values()
        for rows in (at_level.phase >= 0, at_level.phase < 0)
        if (side := _rising(at_level.of(rows))) is not None
    ]
    if not sides:
        return [], []
    # Each side reaches a range of amplitudes; a section needs enough sides that reach it.
    low = min(float(np.abs(side.displacement)[0]) for side in sides)
    high = max(float(np.abs(side.displacement)[-1]) for side in sides)
    cut = [_cut(amplitude, sides) for amplitude in np.geomspace(low, high, _SECTIONS)]
    return [section for section in cut if len(section.frequency) >= _LEAST], []


def displacement_spread(states: SensorStates) -> float:
    """Half the range of the displacement over its mean; infinite for a single state."""
    size = np.abs(states.displacement)
    return float(np.ptp(size) / (2 * size.mean())) if len(size) >= _LEAST else np.inf


def _controlled(level: int, states: SensorStates) -> AmplitudeSection:
    rows = np.argsort(states.frequency)
    size = float(np.abs(states.displacement).mean())
    return AmplitudeSection(level, size, states.frequency[rows], 1 / states.receptance[rows])


def _rising(side: SensorStates) -> SensorStates | None:
    """One side of a level by rising displacement; None where there are not two amplitudes."""
    _, first = np.unique(np.abs(side.displacement), return_index=True)
    return side.of(first) if len(first) > 1 else None


def _cut(amplitude: float, sides: list[SensorStates]) -> AmplitudeSection:
    """The states of one amplitude, one from each side that reaches it."""
    found = []
    for side in sides:
        size = np.abs(side.displacement)
        if size[0] <= amplitude <= size[-1]:
            each = 1 / side.receptance
            real, imag = (np.interp(amplitude, size, part) for part in (each.real, each.imag))
            found.append((np.interp(amplitude, size, side.frequency), real + 1j * imag))
    found.sort(key=lambda row: row[0])
    frequency = np.array([row[0] for row in found])
    return AmplitudeSection(
        -1, amplitude, frequency, np.array([row[1] for row in found], dtype=complex)
    )
