"""Sections of a test at equal displacement, at which a nonlinear mode responds linearly."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float

from snrmjax.methods.one_sensor import SensorStates

CONTROLLED = 0.1
"""Largest relative spread of the displacement in a response-controlled level.

Response control keeps velocities or displacements within some per cent; under constant force they
change several times over through resonance.
"""
_SECTIONS = 15  # amplitudes at which levels of constant force are cut
_LEAST = 3  # states of a section: two fit a mode exactly, without a residual


class AmplitudeSection(NamedTuple):
    """States of one displacement amplitude."""

    level: int  # -1 where the states come from several levels
    amplitude: float  # m
    frequency: Float[np.ndarray, " state"]  # rad/s, rising
    stiffness: Complex[np.ndarray, " state"]  # force over displacement, N/m


def sections_of(states: SensorStates) -> tuple[list[AmplitudeSection], list[int]]:
    """Sections at equal displacement, and the levels of controlled displacement.

    A level whose displacement stays within `CONTROLLED` is one section. Where there is none, all
    levels are interpolated, on each side of resonance, at amplitudes that several reach.
    """
    levels = dict(states.levels())
    controlled = [
        level for level, at_level in levels.items() if displacement_spread(at_level) <= CONTROLLED
    ]
    if controlled:
        return [_controlled(level, levels[level]) for level in controlled], controlled
    sides = [
        side
        for at_level in levels.values()
        for rows in (at_level.phase >= 0, at_level.phase < 0)
        if (side := _rising(at_level.of(rows))) is not None
    ]
    if not sides:
        return [], []
    # A section needs `_LEAST` sides whose amplitude range contains it.
    low = min(float(np.abs(side.displacement)[0]) for side in sides)
    high = max(float(np.abs(side.displacement)[-1]) for side in sides)
    cut = [_cut(amplitude, sides) for amplitude in np.geomspace(low, high, _SECTIONS)]
    return [section for section in cut if len(section.frequency) >= _LEAST], []


def displacement_spread(states: SensorStates) -> float:
    """Half the range of the displacement over its mean; infinite for a single state."""
    amplitude = np.abs(states.displacement)
    return float(np.ptp(amplitude) / (2 * amplitude.mean())) if len(amplitude) >= _LEAST else np.inf


def _controlled(level: int, states: SensorStates) -> AmplitudeSection:
    rows = np.argsort(states.frequency)
    amplitude = float(np.abs(states.displacement).mean())
    return AmplitudeSection(level, amplitude, states.frequency[rows], 1 / states.receptance[rows])


def _rising(side: SensorStates) -> SensorStates | None:
    """One side of a level by rising displacement; None with fewer than two amplitudes."""
    _, first = np.unique(np.abs(side.displacement), return_index=True)
    return side.of(first) if len(first) > 1 else None


def _cut(amplitude: float, sides: list[SensorStates]) -> AmplitudeSection:
    """The states of one amplitude, one from each side that reaches it."""
    states = []
    for side in sides:
        reached = np.abs(side.displacement)
        if reached[0] <= amplitude <= reached[-1]:
            each = 1 / side.receptance
            real, imag = (np.interp(amplitude, reached, part) for part in (each.real, each.imag))
            states.append((np.interp(amplitude, reached, side.frequency), real + 1j * imag))
    states.sort(key=lambda row: row[0])
    frequency = np.array([row[0] for row in states])
    return AmplitudeSection(
        -1, amplitude, frequency, np.array([row[1] for row in states], dtype=complex)
    )
