"""Phase resonances bracketed by the states of a level, and jumps past them."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from snrmjax.identify.pointwise.backbone import Backbone
from snrmjax.measure.states import SteadyStates
from snrmjax.numerics.units import HERTZ

_SAME_FORCE = 0.05  # relative difference between a level's force and the requested one
_ONE_BRANCH = np.radians(45.0)  # largest phase step across a resonance on one branch
_STEEPER = 2.0  # slope of tan φ over that of the neighbouring states, above which it is a jump


class MeasuredResonance(NamedTuple):
    """Phase resonance of a level, interpolated between two states."""

    level: int
    force: float  # N
    frequency: float  # Hz
    velocity: float  # m/s


def measured_resonances(data: SteadyStates, sensor: int, sign: float) -> list[MeasuredResonance]:
    """Phase resonances bracketed by states, level by level; `sign` is that of the modal constant.

    By interpolation in the tangent of the phase.
    """
    velocity = sign * np.asarray(data.velocity)[:, sensor]
    force, frequency = np.asarray(data.force), np.asarray(data.frequency)
    level = np.asarray(data.level)
    good = np.isfinite(force) & np.isfinite(np.abs(velocity)) & (velocity.real > 0)
    bracketed = []
    for number in np.unique(level[good]):
        of_level = np.flatnonzero(good & (level == number))
        tangent = velocity[of_level].imag / velocity[of_level].real
        if not tangent.min() <= 0 <= tangent.max():
            continue
        order = of_level[np.argsort(tangent)]
        rows = np.sort(tangent)
        if jump_at_resonance(rows, frequency[order]) is not None:
            continue
        columns = (force, frequency / HERTZ, np.abs(velocity))
        at = (float(np.interp(0.0, rows, column[order])) for column in columns)
        bracketed.append(MeasuredResonance(int(number), *at))
    return bracketed


def jump_at_resonance(
    tangent: Float[np.ndarray, " state"], frequency: Float[np.ndarray, " state"]
) -> tuple[float, float] | None:
    """The frequencies between which a level jumps past its phase resonance; None where it does not.

    Between states of one branch tan φ falls steadily with frequency, so that a resonance between
    them can be interpolated. A jump shows as a slope twice that of the neighbouring states, slopes
    that differ by a factor of two between the sides, or a reversal: the resonance was not measured.

    Arguments: `tangent` of the phases of a level's states, rising, and their frequencies.
    Validity: at least two states on one side; with fewer no jump can be detected.
    """
    below = int(np.searchsorted(tangent, 0.0, side="right")) - 1
    if below < 0 or below + 1 >= len(tangent):
        return None
    pair = slice(below, below + 2)
    ends = float(frequency[pair].min()), float(frequency[pair].max())
    if np.ptp(np.arctan(tangent[pair])) < _ONE_BRANCH:
        return None
    neighbours = [k for k in (below - 1, below + 1) if 0 <= k < len(tangent) - 1]
    slopes = [_slope(tangent[k : k + 2], frequency[k : k + 2]) for k in neighbours]
    if not slopes:
        return None
    slope = _slope(tangent[pair], frequency[pair])
    # Steep on one side and flat on the other: two branches.
    apart = len(slopes) == 2 and min(slopes) < _STEEPER * max(slopes)
    return ends if slope >= 0 or apart or slope < _STEEPER * min(*slopes, 0.0) else None


def _slope(tangent: Float[np.ndarray, " 2"], frequency: Float[np.ndarray, " 2"]) -> float:
    step = float(frequency[1] - frequency[0])
    return float(tangent[1] - tangent[0]) / step if step else -np.inf


def level_in_resonance(
    data: SteadyStates, backbone: Backbone, force: float
) -> MeasuredResonance | None:
    """The phase resonance of the level whose force (N) is nearest to `force`; None without one."""
    sensor, sign = data.sensors.index(backbone.sensor), np.sign(float(backbone.modal_constant))
    measured = measured_resonances(data, sensor, sign)
    near = min(measured, key=lambda resonance: abs(resonance.force / force - 1), default=None)
    return None if near is None or abs(near.force / force - 1) > _SAME_FORCE else near
