"""Describing functions of a local nonlinear element, from nonlinear and linear receptances.

The only nonlinearity is one element between a known point and the ground. Its force N follows
from the difference between measured and linear response, X = H_rb F − H_rr N, and N = v(X) X
defines its describing function: Re v is the stiffness and Im v the loss at that amplitude.

Reference: Ö. Arslan, M. Aykan & H. N. Özgüven, Mech. Syst. Signal Process. 25 (2011) 1112.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Complex, Float

from snrmjax.measure.states import SteadyStates
from snrmjax.methods.one_sensor import SensorStates, sensor_states, signed_drive_point
from snrmjax.methods.result import MethodPoint, MethodResult, MethodStatus, method_result
from snrmjax.model.modes import (
    LinearModes,
    dynamic_stiffness,
    phasor_of_load,
    reference_sensor,
)

_STEP = 1e-6  # of the finite differences, relative or rad


def arslan_ozguven(data: SteadyStates, modes: LinearModes) -> MethodResult:
    """Natural frequency and damping that the describing function at each state implies.

    The element acts between the reference sensor and the ground; the rest of the structure is
    that of the linear `modes`. The point is the mode of interest of the structure with stiffness
    Re v(X) and damping Im v(X)/Ω added at the sensor.

    Arguments: `data` with forces in N and phases; `modes` with all modes that respond, rigid-body
    modes included. Returns a `MethodResult` with one point per state, at velocity ω̃ |X|; 1σ
    from the stated errors, by finite differences.
    Raises `ValueError` where the data have no forces or no phases.
    Validity: the element is at the reference sensor; errors of the linear model enter in full.
    """
    states = sensor_states(data, modes)
    factors = (1.0, 1 + _STEP, np.exp(1j * _STEP))
    moved = (states._replace(velocity=states.velocity * factor) for factor in factors)
    functions = np.stack([describing_function(one, modes) for one in moved], axis=1)
    points = [_point(states, k, of_state, modes) for k, of_state in enumerate(functions)]
    return method_result("arslan_ozguven", points, len(states.level))


def describing_function(states: SensorStates, modes: LinearModes) -> Complex[np.ndarray, " state"]:
    """Describing function v(X) = N/X in N/m at the reference sensor, for each state."""
    r, sign = reference_sensor(modes), np.sign(signed_drive_point(modes))
    flexible, square = np.asarray(modes.mode_shape)[r], states.frequency**2
    impedance = np.asarray(
        dynamic_stiffness(modes, np.arange(modes.n_modes), jnp.asarray(1j * states.frequency))
    )
    loads = np.stack([np.asarray(phasor_of_load(modes)), flexible], axis=1)
    response = flexible @ np.linalg.solve(impedance, loads[None])
    rigid = np.asarray(modes.rigid_body_shape)[r]
    per_force = rigid @ np.asarray(modes.rigid_body_participation)
    driven = sign * (response[:, 0] - per_force / square)
    direct = response[:, 1] - rigid @ rigid / square
    return (driven * states.force - states.displacement) / (direct * states.displacement)


def _point(
    states: SensorStates,
    k: int,
    functions: Complex[np.ndarray, " factor"],
    modes: LinearModes,
) -> MethodPoint:
    """The mode that one state implies, with 1σ by finite differences of amplitude and phase.

    Arguments: its describing `functions` as measured, and with these two changed.
    """
    state = states.of(np.array([k]))
    mode, *others = (_mode_of(v, float(state.frequency[0]), modes) for v in functions.tolist())
    if mode is None:
        return MethodPoint(MethodStatus.NOT_A_MODE, int(state.level[0]))
    natural, ratio = mode
    derivatives = [
        np.nan * np.zeros(2) if one is None else (np.array(one) - mode) / _STEP for one in others
    ]
    std = np.hypot(derivatives[0] * state.amplitude_std, derivatives[1] * state.phase_std)
    return MethodPoint(
        MethodStatus.FOUND,
        int(state.level[0]),
        natural * float(np.abs(state.displacement)[0]),
        natural,
        float(std[0]),
        ratio,
        float(std[1]),
    )


def _eigenvalue_of(
    stiffness: Float[np.ndarray, "mode mode"], damping: Float[np.ndarray, "mode mode"], which: int
) -> tuple[float, float] | None:
    """|λ| and −Re λ/|λ| of the complex mode with the largest component of mode `which`."""
    n = len(stiffness)
    state = np.block([[np.zeros((n, n)), np.eye(n)], [-stiffness, -damping]])
    values, vectors = np.linalg.eig(state)
    rising = values.imag > 0
    if not rising.any():
        return None
    linear_damping = np.abs(vectors[which]) / np.linalg.norm(vectors[:n], axis=0)
    value = values[np.argmax(np.where(rising, linear_damping, -1.0))]
    return (float(abs(value)), float(-value.real / abs(value))) if value.real < 0 else None


def _mode_of(v: complex, frequency: float, modes: LinearModes) -> tuple[float, float] | None:
    """ω̃ and ζ̃ of the mode of interest with an element v at Ω; None where not positive."""
    shape = np.asarray(modes.mode_shape)[reference_sensor(modes)]
    natural = np.asarray(modes.natural_frequency)
    stiffness = np.diag(natural**2) + v.real * np.outer(shape, shape)
    if modes.damping_coupling is not None:
        linear_damping = np.diag(2 * np.asarray(modes.damping_ratio) * natural)
        rate = v.imag / frequency
        damped = linear_damping + np.asarray(modes.damping_coupling) + rate * np.outer(shape, shape)
        return _eigenvalue_of(stiffness, damped, modes.mode_of_interest)
    squares, vectors = np.linalg.eigh(stiffness)
    k = int(np.argmax(np.abs(vectors[modes.mode_of_interest])))
    mode = vectors[:, k]
    added = v.imag / frequency * float(shape @ mode) ** 2
    damping = float(mode**2 @ (2 * np.asarray(modes.damping_ratio) * natural)) + added
    if not (squares[k] > 0 and damping > 0):
        return None
    own = float(np.sqrt(squares[k]))
    return own, damping / (2 * own)
