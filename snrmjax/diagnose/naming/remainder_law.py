"""The force law whose describing function is a remainder, for a completed model."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from snrmjax.diagnose.naming.parts import Remainder
from snrmjax.diagnose.naming.rows import Problem
from snrmjax.model.library.free_laws import DisplacementDampingLaw, StiffnessLaw

_KNOTS = 16
_ANGLES = 200
_WEIGHTS = np.geomspace(1e4, 1e-4, 33)  # of the roughness, the smoothest law first
_AT_THE_TOP = 0.5  # 1σ: a larger distance would bias the highest peaks, where the law ends
_LEAST_STD = 1e-3  # of the largest remainder: the accuracy that a law needs


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
            secant = natural**2 * _secants(q, remainder, knots, in_phase=True)
            laws.append(StiffnessLaw(jnp.asarray(knots), jnp.asarray(secant * knots)))
        else:
            secant = 2 * natural * _secants(q, remainder, knots, in_phase=False)
            laws.append(DisplacementDampingLaw(jnp.asarray(knots), jnp.asarray(secant)))
    return laws


def _secants(
    amplitude: Float[np.ndarray, " point"],
    remainder: Remainder,
    knots: Float[np.ndarray, " knot"],
    *,
    in_phase: bool,
) -> Float[np.ndarray, " knot"]:
    """Secants s at knots for which the mean of 2 s(a |cos t|) cos² t, or sin² t, is the remainder.

    Piecewise linear in ln q. The inverse of an average amplifies errors: the law is the smoothest
    one (second differences) whose average is the remainder within its rms 1σ, and within half of it
    at the largest amplitude; 1σ is at least 0.1 % of the largest. See the discrepancy principle of
    Morozov, Sov. Math. Dokl. 7 (1966) 414.
    """
    t = (np.arange(_ANGLES) + 0.5) * 0.5 * np.pi / _ANGLES
    weight = 2 * (np.cos(t) ** 2 if in_phase else np.sin(t) ** 2) / _ANGLES
    at = np.log(np.maximum(np.outer(amplitude, np.cos(t)), knots[0]))
    hats = np.array([np.interp(at, np.log(knots), unit) @ weight for unit in np.eye(len(knots))]).T
    largest = np.max(np.abs(remainder.value))
    if largest == 0:
        return np.zeros(len(knots))
    std = np.maximum(remainder.std, _LEAST_STD * largest)[:, None]
    rows, goal = hats / std, remainder.value / std[:, 0]
    roughness = np.diff(np.eye(len(knots)), 2, axis=0) / np.median(std)
    secant = np.zeros(len(knots))
    for weight_of_roughness in _WEIGHTS:
        both = np.vstack([rows, weight_of_roughness * roughness])
        wanted = np.concatenate([goal, np.zeros(len(roughness))])
        secant = np.linalg.lstsq(both, wanted, rcond=None)[0]
        off = rows @ secant - goal
        if np.sqrt(np.mean(off**2)) <= 1 and abs(off[-1]) <= _AT_THE_TOP:
            break
    return secant
