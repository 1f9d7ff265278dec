"""Open-loop phase-resonance testing: velocity in phase with the force.

Each level is stepped in frequency, and the state at phase resonance is interpolated between the
two states around it. Its frequency is that of the nonlinear normal mode at that amplitude, and the
force gives the damping. A hardening resonance may be missed by a premature jump: such a level has
no point.

Reference: M. Peeters, G. Kerschen & J. C. Golinval, J. Sound Vib. 330 (2011) 486,
doi:10.1016/j.jsv.2010.08.028.
"""

import numpy as np

from snrmjax.measure.states import SteadyStates
from snrmjax.methods.one_sensor import SensorStates, drive_point, sensor_states
from snrmjax.methods.result import MethodPoint, MethodResult, MethodStatus, method_result
from snrmjax.methods.steady.equal_amplitude import CONTROLLED, displacement_spread
from snrmjax.model.modes import LinearModes

_WIDEST = 2 * np.pi / 3  # rad between the two states: above, the response has jumped


def phase_resonance(data: SteadyStates, modes: LinearModes) -> MethodResult:
    """Frequency, amplitude and damping at the phase resonance of every level.

    Between the two states around resonance all quantities are interpolated in tan φ. The velocity
    is that of the level where its displacement is controlled, else |v| / cos φ, the resonance
    amplitude under constant force. Damping is from the power balance, 2ζ̃ω̃ = |Φ_r Φᵀb| F / |v|.
    More than 120° between the two states around resonance is taken for a jump.

    Arguments: `data` with forces in N and phases; `modes` has the modal mass of the mode of
    interest. Returns a `MethodResult` with one point per level; 1σ from the stated errors.
    Raises `ValueError` where the data have no forces or no phases.
    """
    states = sensor_states(data, modes)
    points = [_resonance(level, at_level, modes) for level, at_level in states.levels()]
    return method_result("phase_resonance", points, len(states.level))


def _resonance(level: int, states: SensorStates, modes: LinearModes) -> MethodPoint:
    """The phase resonance of one level."""
    phase = states.phase
    below, above = np.flatnonzero(phase >= 0), np.flatnonzero(phase < 0)
    if not below.size or not above.size:
        return MethodPoint(MethodStatus.NO_RESONANCE, level)
    pair = np.array([below[np.argmin(phase[below])], above[np.argmax(phase[above])]])
    if phase[pair[0]] - phase[pair[1]] > _WIDEST:
        return MethodPoint(MethodStatus.NO_RESONANCE, level)
    near = states.of(pair)
    # Near resonance tan φ of a mode is linear in frequency; F cos φ / |v| is its damping.
    tangent, cosine, speed = np.tan(near.phase), np.cos(near.phase), np.abs(near.velocity)
    weight = np.array([-tangent[1], tangent[0]]) / (tangent[0] - tangent[1])
    frequency = float(weight @ near.frequency)
    damping = drive_point(modes) * float(weight @ (near.force * cosine / speed))
    controlled = displacement_spread(states) <= CONTROLLED
    velocity = float(weight @ (speed if controlled else speed / cosine))
    slope = (near.frequency[1] - near.frequency[0]) / (tangent[1] - tangent[0])
    tangent_std = np.hypot(*(weight * near.phase_std / cosine**2))  # of the interpolated tan φ
    amplitude = np.hypot(*(weight * near.amplitude_std))
    return MethodPoint(
        MethodStatus.FOUND,
        level,
        velocity,
        frequency,
        abs(slope) * tangent_std,
        damping / (2 * frequency),
        damping / (2 * frequency) * amplitude,
    )
