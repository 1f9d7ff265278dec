"""Whether data determine the errors of the instruments that a fit was asked to find."""

from collections.abc import Sequence
from enum import StrEnum
from typing import Any, NamedTuple

import numpy as np

_BESIDE_RESONANCE = np.radians(20)  # a state's phase, up to which inertia hardly counts
_CAP = 0.99  # of the largest level-to-level variance that a fit allows: where it has stopped short
LARGEST_LEVEL_STD = 0.3
"""1σ of what levels share beyond which they are not levels of one structure's test."""

REMEDY_OF_GAIN = (
    "Measure the force, or calibrate the drive (a force transducer at one state, or a known added "
    "mass); or add states 30° to 70° from resonance on both sides, where the inertia of the modal "
    "mass is known"
)
"""What determines the gain of a force that is known in volts."""


class _Bounds(NamedTuple):
    """How well an unknown of the instruments must be known, and what would determine it."""

    doubted: float  # 1σ from which on it is said
    refused: float  # and from which on there is no answer
    remedy: str


_BOUNDS: dict[str, _Bounds] = {
    "force_gain": _Bounds(0.1, 0.5, REMEDY_OF_GAIN),
    "force_offset": _Bounds(
        0.2, 1.0, "Add levels of smaller force, and states 30° to 70° from resonance"
    ),
    "instrument_phase": _Bounds(
        np.radians(5), np.radians(30), "Add states on both sides of resonance"
    ),
}


class Determination(StrEnum):
    """How well data determine an unknown of the instruments."""

    WELL = "well"
    HARDLY = "hardly"
    NOT_AT_ALL = "not_at_all"


def force_gain_determined(std: float) -> Determination:
    """How well a force gain is known, by the 1σ of its logarithm."""
    bounds = _BOUNDS["force_gain"]
    if std < bounds.doubted:
        return Determination.WELL
    return Determination.HARDLY if std < bounds.refused else Determination.NOT_AT_ALL


def force_gain_undetermined(std: float, farthest: float) -> str:
    """One sentence where data do not determine a force gain; nothing where they do.

    Arguments: `std` 1σ of the gain's logarithm; `farthest` the largest phase of a state from
    resonance, rad.
    """
    bounds = _BOUNDS["force_gain"]
    if std < bounds.doubted:
        if farthest > _BESIDE_RESONANCE:
            return ""
        return (
            "these data hardly determine the force gain: all states lie within "
            f"{np.degrees(farthest):.0f}° of resonance, where an error of the velocity that "
            "changes with the amplitude passes for a gain; the 1σ of gain and damping leave such "
            f"errors out. {bounds.remedy}."
        )
    if std < bounds.refused:
        return (
            "these data hardly determine the force gain: its 1σ is "
            f"{100 * std:.2g} %, and so is that of every damping; natural frequencies rest on the "
            f"states near resonance. {bounds.remedy}."
        )
    return f"the force gain cannot be determined from these data ({_wide(std)}). {bounds.remedy}."


def _wide(std: float) -> str:
    """How large the 1σ of a logarithm is."""
    if not std < np.log(100):  # NaN too
        return "any value fits them about equally well"
    return f"its 1σ is a factor of {np.exp(std):.2g}, and damping is proportional to it"


def notes_on_instruments(fit: Any, level_errors: Sequence[str]) -> tuple[str, ...]:
    """What data hardly determine of the unknowns that a fit freed.

    Arguments: `fit` a `JointFit`; `level_errors` are the names of what the states of a level may
    share.
    Raises `ValueError` where one is not determined at all, so that the answer would mean nothing,
    or where beside a free gain the levels' gains had to be as large as a fit allows.
    """
    names, notes = fit.names(), []
    std = np.sqrt(np.abs(np.diag(fit.covariance)))
    for name in fit.free:
        bounds, own = _BOUNDS[name], float(std[names.index(name)])
        if name == "force_gain":
            phase = np.angle(np.asarray(fit.motion().velocity))
            said = force_gain_undetermined(own, float(np.max(np.abs(phase))))
        else:
            said = _undetermined(name, own, bounds)
        if said and not own < bounds.refused:
            raise ValueError(said)
        notes += [said] if said else []
    at_cap = np.asarray(fit.noise.level_std) >= _CAP * LARGEST_LEVEL_STD
    capped = [name for name, is_ in zip(level_errors, at_cap, strict=True) if is_]
    if capped:
        said = (
            f"the error in {' and '.join(capped)} that the states of a level share is as large as "
            f"a fit allows ({100 * LARGEST_LEVEL_STD:.0f} %, 1σ): no levels of one test differ by "
            "so much, and the curves are not to be believed."
        )
        if "force_gain" in fit.free:
            raise ValueError(
                f"{said} The force gain cannot be determined beside it. {REMEDY_OF_GAIN}."
            )
        notes.append(said)
    return tuple(notes)


def _undetermined(name: str, std: float, bounds: _Bounds) -> str:
    """One sentence where data do not determine another unknown than the gain."""
    if std < bounds.doubted:
        return ""
    size = f"{np.degrees(std):.2g}°" if name == "instrument_phase" else f"{100 * std:.2g} %"
    of = "" if name == "instrument_phase" else " of the smallest force"
    verb = "hardly determine" if std < bounds.refused else "cannot determine"
    return f"these data {verb} `{name}` (1σ {size}{of}). {bounds.remedy}, or do not free it."
