"""Whether data determine the errors of the instruments that a fit was asked to find."""

from collections.abc import Sequence
from enum import StrEnum
from typing import Any

import numpy as np
from jaxtyping import Float

from snrmjax.numerics.facts import Fact

_BESIDE_RESONANCE = np.radians(20)  # a state's phase, up to which inertia hardly counts

# 1σ from which on an unknown is doubted, and from which on there is no answer: of a gain's
# logarithm, of an offset over the smallest force, of a phase in rad.
_BOUNDS = {
    "force_gain": (0.1, 0.5),
    "force_offset": (0.2, 1.0),
    "instrument_phase": (np.radians(5), np.radians(30)),
}


class Determination(StrEnum):
    """How well data determine an unknown of the instruments."""

    WELL = "well"
    HARDLY = "hardly"
    NOT_AT_ALL = "not_at_all"


def _determined(name: str, std: float) -> Determination:
    doubted, refused = _BOUNDS[name]
    if std < doubted:
        return Determination.WELL
    return Determination.HARDLY if std < refused else Determination.NOT_AT_ALL


def force_gain_undetermined(std: float, farthest: float) -> Fact | None:
    """That data do not determine a force gain; None where they do.

    Arguments: `std` 1σ of the gain's logarithm; `farthest` the largest phase of a state from
    resonance, rad.
    """
    how = _determined("force_gain", std)
    if how is not Determination.WELL:
        return Fact("force_gain_undetermined", std=std, how=how)
    if farthest > _BESIDE_RESONANCE:
        return None
    return Fact("force_gain_near_resonance", farthest_deg=float(np.degrees(farthest)))


def require_passive(
    free: Sequence[str], mass: float, damping: Float[np.ndarray, " state"] | None = None
) -> None:
    """Raise `ValueError` for a fit that no passive structure has.

    With a gain or a phase that nobody knows, force and damping below zero fit states of one side of
    resonance as well: damping must then be positive at every state. Where the force is known it
    may be negative over a part of the amplitudes, as of a self-excited structure.

    Arguments: `free` what of the instruments is unknown; `mass` the modal mass over the model's;
    `damping` that of the states, 1/s, once it is known.
    """
    turned = tuple(name for name in free if name != "force_offset")
    if not mass > 0:
        raise ValueError(str(Fact("fit_not_passive", what="modal mass", free=turned)))
    some = damping is not None and not bool((np.all if turned else np.any)(damping > 0))
    if some:
        raise ValueError(str(Fact("fit_not_passive", what="damping", free=turned)))


def notes_on_instruments(fit: Any) -> list[Fact]:
    """What data hardly determine of the unknowns that a joint fit freed.

    Raises `ValueError` where one is not determined at all, so that the answer would mean nothing.
    """
    names, notes = fit.names(), []
    std = np.sqrt(np.abs(np.diag(fit.covariance)))
    for name in fit.free:
        size = float(std[names.index(name)])
        how = _determined(name, size)
        if name == "force_gain":
            phase = np.angle(np.asarray(fit.motion().velocity))
            note = force_gain_undetermined(size, float(np.max(np.abs(phase))))
        elif how is Determination.WELL:
            note = None
        else:
            note = Fact("instrument_undetermined", name=name, std=size, how=how)
        if how is Determination.NOT_AT_ALL:
            raise ValueError(str(note))
        notes += [] if note is None else [note]
    return notes
