"""The force law whose describing function is a remainder, for a completed model."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from snrmjax.diagnose.naming.parts import Remainder
from snrmjax.diagnose.naming.rows import Problem
from snrmjax.model.library.free_laws import DisplacementDampingLaw, StiffnessLaw

_KNOTS = 16
_ANGLES = 200
_SMOOTH = 1e-4  # weight of second differences, for knots that data do not determine


def remainder_laws(
    problem: Problem, remainders: dict[str, Remainder]
) -> list[StiffnessLaw | DisplacementDampingLaw]:
    """The forces of the remainders of each part, on the mode of interest."""
    readings = problem.readings
    laws: list[StiffnessLaw | DisplacementDampingLaw] = []
    natural, largest = readings.natural_frequency, readings.largest
    for part, remainder in remainders.items():
        q = largest * remainder.velocity / np.max(remainder.velocity)
        knots = np.geomspace(q[0], q[-1], _KNOTS)
        if part == "stiffness":
            secant = _secants(q, natural**2 * remainder.value, knots, in_phase=True)
            laws.append(StiffnessLaw(jnp.asarray(knots), jnp.asarray(secant * knots)))
        else:
            secant = _secants(q, 2 * natural * remainder.value, knots, in_phase=False)
            laws.append(DisplacementDampingLaw(jnp.asarray(knots), jnp.asarray(secant)))
    return laws


def _secants(
    amplitude: Float[np.ndarray, " point"],
    value: Float[np.ndarray, " point"],
    knots: Float[np.ndarray, " knot"],
    *,
    in_phase: bool,
) -> Float[np.ndarray, " knot"]:
    """Secants s at knots for which the mean of 2 s(a |cos t|) cos² t, or sin² t, is `value` at a.

    By regularised least squares, piecewise linear in ln q.
    """
    t = (np.arange(_ANGLES) + 0.5) * 0.5 * np.pi / _ANGLES
    weight = 2 * (np.cos(t) ** 2 if in_phase else np.sin(t) ** 2) / _ANGLES
    at = np.log(np.maximum(np.outer(amplitude, np.cos(t)), knots[0]))
    hats = np.array([np.interp(at, np.log(knots), unit) @ weight for unit in np.eye(len(knots))]).T
    roughness = _SMOOTH * np.diff(np.eye(len(knots)), 2, axis=0)
    rows, goal = np.vstack([hats, roughness]), np.concatenate([value, np.zeros(len(roughness))])
    return np.linalg.lstsq(rows, goal, rcond=None)[0]
