"""Describing functions of a local nonlinear element, from nonlinear and linear receptances.

One element between a known point and the ground is all that is nonlinear. What it pulls with is
what the measured motion lacks to the linear one, X = H_rb F − H_rr N, and N = v(X) X is its
describing function: Re v a stiffness and Im v a loss at that amplitude.

Reference: Ö. Arslan, M. Aykan & H. N. Özgüven, Mech. Syst. Signal Process. 25 (2011) 1112.
"""

import numpy as np
from jaxtyping import Complex

from snrmjax.measure.states import SteadyStates
from snrmjax.methods.one_sensor import SensorStates, sensor_states, signed_drive_point
from snrmjax.methods.result import MethodPoint, MethodResult, MethodStatus, method_result
from snrmjax.model.modes import LinearModes, reference_sensor


def arslan_ozguven(data: SteadyStates, modes: LinearModes) -> MethodResult:
    """Natural frequency and damping that the describing function at each state implies.

    The element is taken to act between the reference sensor and the ground, and all other motion
    to be the linear modes of `modes`. The mode of the structure with stiffness Re v(X) and damping
    Im v(X)/Ω added at the sensor is followed from the mode of interest.

    Arguments: `data` with forces in N and phases; `modes` with all modes that respond, rigid-body
    modes included. Returns a `MethodResult` with one point a state, at velocity ω̃ |X|; 1σ from
    the stated errors, by differences.
    Raises `ValueError` where the data have no forces or no phases.
    Validity: the element stands at the reference sensor; errors of the linear model enter in full.
    """
    states = sensor_states(data, modes)
    points = [_point(states, k, modes) for k in range(len(states.level))]
    return method_result("arslan_ozguven", points, len(states.level))


def describing_function(states: SensorStates, modes: LinearModes) -> Complex[np.ndarray, " state"]:
    """v(X) = N/X in N/m at the reference sensor, one number a state."""
    r, turn = reference_sensor(modes), np.sign(signed_drive_point(modes))
    flexible = np.asarray(modes.mode_shape)[r]
    square = states.frequency[:, None] ** 2
    natural, ratio = np.asarray(modes.natural_frequency), np.asarray(modes.damping_ratio)
    damping = 2j * ratio * natural * states.frequency[:, None]
    modal = 1 / (natural**2 - square + damping)
    rigid = np.asarray(modes.rigid_body_shape)[r]
    driven = turn * (
        modal @ (flexible * np.asarray(modes.participation))
        - rigid @ np.asarray(modes.rigid_body_participation) / square[:, 0]
    )
    direct = modal @ flexible**2 - rigid @ rigid / square[:, 0]
    return (driven * states.force - states.displacement) / (direct * states.displacement)


def _point(states: SensorStates, k: int, modes: LinearModes) -> MethodPoint:
    """The mode that one state implies, with 1σ by differences of amplitude and phase."""
    state = states.of(np.array([k]))
    found = _mode_of(state, modes)
    if found is None:
        return MethodPoint(MethodStatus.NOT_A_MODE, int(state.level[0]))
    natural, ratio = found
    step = 1e-6
    slopes = []
    for turned in (1 + step, np.exp(1j * step)):
        moved = _mode_of(state._replace(velocity=state.velocity * turned), modes)
        slopes.append(np.nan * np.zeros(2) if moved is None else (np.array(moved) - found) / step)
    std = np.hypot(slopes[0] * state.amplitude_std, slopes[1] * state.phase_std)
    return MethodPoint(
        MethodStatus.FOUND,
        int(state.level[0]),
        natural * float(np.abs(state.displacement)[0]),
        natural,
        float(std[0]),
        ratio,
        float(std[1]),
    )


def _mode_of(state: SensorStates, modes: LinearModes) -> tuple[float, float] | None:
    """ω̃ and ζ̃ of the mode of interest with the element of one state; None where it has none."""
    v = complex(describing_function(state, modes)[0])
    shape = np.asarray(modes.mode_shape)[reference_sensor(modes)]
    natural = np.asarray(modes.natural_frequency)
    stiffness = np.diag(natural**2) + v.real * np.outer(shape, shape)
    squares, vectors = np.linalg.eigh(stiffness)
    k = int(np.argmax(np.abs(vectors[modes.mode_of_interest])))
    mode = vectors[:, k]
    added = v.imag / float(state.frequency[0]) * float(shape @ mode) ** 2
    damping = float(mode**2 @ (2 * np.asarray(modes.damping_ratio) * natural)) + added
    if not (squares[k] > 0 and damping > 0):
        return None
    frequency = float(np.sqrt(squares[k]))
    return frequency, damping / (2 * frequency)
