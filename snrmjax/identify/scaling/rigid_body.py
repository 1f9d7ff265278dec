"""The rigid-body mode of a free structure, from low residuals or from its mass."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from snrmjax.identify.modal.modal_fit import LinearModalFit
from snrmjax.numerics.facts import Fact

_RESIDUAL_STDS = 5.0  # standard errors of a low residual
_APART = 1.2  # ratio of the residual's mass and the stated one that is worth a note


class RigidBodyMode(NamedTuple):
    """Shape at the sensors and participation, both kg^-1/2; no shape where none is due."""

    shape: Float[np.ndarray, " sensor"] | None
    participation: float
    notes: tuple[Fact, ...]


def rigid_body_mode(
    fit: LinearModalFit,
    gain: float,
    free: float | None,
    drive: tuple[int, float] | None,
    scaled_by: Fact,
) -> RigidBodyMode:
    """What the low residuals, or the stated mass of a free structure, say of its rigid motion.

    A rigid-body mode answers −φp/Ω²: the low residual of the drive point is −1/m of the mass that
    the force feels. Modes below the band look alike, so that it is written only where the
    structure is said to be free: `free` is its mass in kg, 0 where it is not known, None where
    nobody said. `drive` is the number of the sensor at the force and its sign against it.
    Raises `ValueError` where a free structure's residual refutes that.
    """
    lower, std = fit.lower / gain, fit.lower_std / abs(gain)
    at, sign = drive or (0, 1.0)
    residual = residual_std = np.nan
    if drive is not None and std[at] > 0:
        residual, residual_std = sign * lower[at], std[at]
    shows = residual < -_RESIDUAL_STDS * residual_std
    if free is None:
        note = (Fact("low_residual_of_free_mass", mass_kg=float(-1 / residual)),) if shows else ()
        return RigidBodyMode(None, 0.0, note)
    if free < 0 or not np.isfinite(free):
        raise ValueError(f"the mass of a free structure must be positive (kg), but is {free:g}.")
    if free > 0:
        ones = np.full(len(fit.sensors), free**-0.5)
        if not shows:
            return RigidBodyMode(ones, free**-0.5, (Fact("rigid_body_of_stated_mass"),))
        ratio = float(-1 / residual / free)
        off = not 1 / _APART < ratio < _APART
        note = (Fact("low_residual_of_mass", mass_kg=ratio * free, ratio=ratio, off=off),)
        signs = np.sign(lower) * np.sign(lower[at])
        ones = ones * np.where(signs == 0, 1.0, signs) * sign
        return RigidBodyMode(ones, free**-0.5, note)
    if not shows:
        what = (
            "is not known"
            if np.isnan(residual)
            else f"is {residual:.3g} ± {1.96 * residual_std:.2g} 1/kg"
        )
        raise ValueError(
            f"a free structure answers −1/(m Ω²) at low frequency, but the low residual at the "
            f"drive point {what}: state its mass, or do not call it free."
        )
    participation = float(np.sqrt(-residual))
    mass = {"mass_kg": float(-1 / residual), "std_kg": float(residual_std / residual**2)}
    note = (Fact("rigid_body_of_residuals", **mass, scaled_by=scaled_by),)
    return RigidBodyMode(-lower / participation, participation, note)
