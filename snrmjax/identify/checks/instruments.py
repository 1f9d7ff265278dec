"""Whether the data determine the instrument errors that a fit estimates."""

from collections.abc import Sequence
from enum import StrEnum
from typing import Any

import numpy as np
from jaxtyping import Float

from snrmjax.numerics.facts import Fact
from snrmjax.numerics.rules import InputError

_NEAR_RESONANCE = np.radians(20)  # phase from resonance, within which inertia hardly counts

# 1σ above which an unknown is poorly determined, and above which the fit is refused: of a gain's
# logarithm, of an offset over the smallest force, of a phase in rad.
_BOUNDS = {
    "force_gain": (0.1, 0.5),
    "force_offset": (0.2, 1.0),
    "instrument_phase": (np.radians(5), np.radians(30)),
}


class Determination(StrEnum):
    """How well the data determine an instrument error."""

    WELL = "well"
    HARDLY = "hardly"
    NOT_AT_ALL = "not_at_all"


def _determined(name: str, std: float) -> Determination:
    uncertain, undetermined = _BOUNDS[name]
    if std < uncertain:
        return Determination.WELL
    return Determination.HARDLY if std < undetermined else Determination.NOT_AT_ALL


def force_gain_undetermined(std: float, farthest: float) -> Fact | None:
    """Note that the data do not determine a force gain; None where they do.

    Arguments: `std` 1σ of the gain's logarithm; `farthest` the largest phase of a state from
    resonance, rad.
    """
    how = _determined("force_gain", std)
    if how is not Determination.WELL:
        return Fact("force_gain_undetermined", std=std, how=how)
    if farthest > _NEAR_RESONANCE:
        return None
    return Fact("force_gain_near_resonance", farthest_deg=float(np.degrees(farthest)))


def require_passive(
    free: Sequence[str], mass: float, damping: Float[np.ndarray, " state"] | None = None
) -> None:
    """Raise `ValueError` for a fit that is not passive.

    With an unknown gain or phase, states on one side of resonance are fitted equally well by a
    reversed force with negative damping: damping must then be positive at every state. With known
    force it may be negative over a range of amplitudes, as in self-excited structures.

    Arguments: `free` the unknown instrument errors; `mass` the modal mass over the model's;
    `damping` of the states, 1/s, where already fitted.
    """
    sign_unknown = tuple(name for name in free if name != "force_offset")
    if not mass > 0:
        raise InputError(str(Fact("fit_not_passive", what="modal mass", free=sign_unknown)))
    not_passive = damping is not None and not bool(
        (np.all if sign_unknown else np.any)(damping > 0)
    )
    if not_passive:
        raise InputError(str(Fact("fit_not_passive", what="damping", free=sign_unknown)))


def notes_on_instruments(fit: Any) -> list[Fact]:
    """Notes on instrument errors of a joint fit that the data determine poorly.

    Raises `ValueError` where one is not determined at all: the fit would be meaningless.
    """
    names, notes = fit.names(), []
    std = np.sqrt(np.abs(np.diag(fit.covariance)))
    for name in fit.free:
        std_of_unknown = float(std[names.index(name)])
        how = _determined(name, std_of_unknown)
        if name == "force_gain":
            phase = np.angle(np.asarray(fit.motion().velocity))
            note = force_gain_undetermined(std_of_unknown, float(np.max(np.abs(phase))))
        elif how is Determination.WELL:
            note = None
        else:
            note = Fact("instrument_undetermined", name=name, std=std_of_unknown, how=how)
        if how is Determination.NOT_AT_ALL:
            raise InputError(str(note))
        notes += [] if note is None else [note]
    return notes
