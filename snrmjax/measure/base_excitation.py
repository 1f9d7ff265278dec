"""Steady states of a structure on a moving base: relative motion over the base's acceleration."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Complex, Float, Int, Shaped

from snrmjax.measure.states import UNNAMED_SENSOR, SteadyStates, steady_states


def base_excited_states(
    level: Int[Shaped[np.ndarray, " state"], " state"],
    frequency: Float[Shaped[np.ndarray, " state"], " state"],
    base_acceleration: Complex[Shaped[np.ndarray, " state"], " state"],
    velocity: Complex[Shaped[np.ndarray, "state sensor"], "state sensor"],
    *,
    sensors: Sequence[str] = UNNAMED_SENSOR,
    along: Sequence[float] | None = None,
    relative: bool = False,
) -> SteadyStates:
    """Steady states of a base-excited test, as the force balance of a mode wants them.

    On a base with acceleration a(t) a mode obeys q̈ + 2ζωq̇ + ω²q + … = −Γa, q the motion relative to
    the base and Γ the participation of the base's motion, Σ m φ along it (kg^1/2). The relative
    velocity V − c a/(iΩ), relative to a, is returned, with |a| in the place of the force: the
    model's participation must then be −Γ, in kg^1/2 per m/s² (`snrmjax modes --base` writes it so).

    Arguments: `level`; `frequency` in rad/s; phasors e^{+iΩt} of one common reference,
    `base_acceleration` in m/s² and `velocity` in m/s, peak amplitudes of the fundamental; `sensors`
    names the columns of `velocity`; `along` has the cosine between each sensor's axis and the
    base's motion, 1 where not given; `relative` says that velocities are relative to the base
    already.
    Returns `SteadyStates` whose `force` is the amplitude of the acceleration in m/s².
    Raises `ValueError` for shapes that disagree and as `steady_states` does.
    Validity: a rigid base that moves along one axis, its acceleration measured at the structure's
    foot.

    >>> a, speed = np.array([2.0 + 0j]), np.array([[0.1 + 0.01j]])
    >>> base_excited_states([1], [500.0], a, speed).velocity.round(4).tolist()
    [[(0.1+0.014j)]]
    """
    omega = np.asarray(frequency, dtype=float)
    load = np.asarray(base_acceleration, dtype=complex)
    seen = np.asarray(velocity, dtype=complex)
    seen = seen[:, None] if seen.ndim == 1 else seen
    cosine = np.ones(len(sensors)) if along is None else np.asarray(along, dtype=float)
    if load.shape != omega.shape or seen.shape != (omega.size, len(sensors)):
        raise ValueError(
            f"`base_acceleration` must have shape {omega.shape} and `velocity` "
            f"{(omega.size, len(sensors))}, but have {load.shape} and {seen.shape}."
        )
    if cosine.shape != (len(sensors),):
        raise ValueError(f"`along` must have one number a sensor, {len(sensors)}.")
    if not relative:
        seen = seen - cosine * (load / (1j * omega))[:, None]
    size = np.abs(load)
    turn = np.exp(-1j * np.angle(load))
    return steady_states(
        np.asarray(level), omega, size, seen * turn[:, None], sensors=tuple(sensors)
    )
