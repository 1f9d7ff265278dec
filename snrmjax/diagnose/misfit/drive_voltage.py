"""States whose force is known as a drive voltage only: a first value of the unknown gain."""

from typing import NamedTuple

import equinox as eqx
import numpy as np

from snrmjax.diagnose.misfit.predictions import predictions_of
from snrmjax.diagnose.misfit.reference import reference_of
from snrmjax.diagnose.misfit.weighted_misfit import weighted_misfit
from snrmjax.identify.checks.instruments import force_gain_undetermined
from snrmjax.measure.states import SteadyStates
from snrmjax.model.structures import Structure

FREE_GAIN_STD = 1.0
"""Relative 1σ of a force gain that is unknown."""

_BESIDE = 0.5  # cosine of the phase of states from which on the damping is seen well
_ROUNDS = 2  # of smooth curves: the first one's prior lies about what the model as given needs


class FirstGain(NamedTuple):
    """States with a force in N by a first value of the gain."""

    data: SteadyStates
    gain: float  # N/V
    notes: tuple[str, ...]


def driven_by_voltage(data: SteadyStates) -> bool:
    """Whether the force is known as a drive voltage only."""
    force, drive = np.asarray(data.force), np.asarray(data.drive)
    return bool(not np.any(np.isfinite(force)) and np.any(np.isfinite(drive)))


def with_first_gain(model: Structure, data: SteadyStates) -> FirstGain:
    """The states with a force by a first value of the unknown gain, which must stay free.

    It is the median, over the states, of the force that the model needs for the measured motion
    over the drive voltage; and, where phases are known, what smooth curves of amplitude make of
    that: with a gain of the force all of the dynamic stiffness grows, but not the part of the known
    modal mass.

    Raises `ValueError` where the model has no such motions.
    """

    def driven(gain: float) -> SteadyStates:
        return eqx.tree_at(lambda d: d.force, data, gain * data.drive)

    predictions = predictions_of(model, driven(1.0), FREE_GAIN_STD)
    needed, unknown = weighted_misfit(predictions).baseline.force, predictions.chosen.phase_unknown
    phase = np.angle(np.asarray(predictions.chosen.states.velocity)[:, 0])
    # With known phases the part against damping, which no error of the stiffness changes.
    part = np.real(needed * np.exp(-1j * phase)) / np.maximum(np.cos(phase), _BESIDE)
    gains = np.abs(needed if unknown.any() else part)
    if not np.any(np.isfinite(gains)):
        raise ValueError("the model has no motion of the measured amplitude for any state.")
    gain, by = float(np.median(gains[np.isfinite(gains)])), "the model as given"
    doubt = ""
    for _ in range(0 if unknown.any() else _ROUNDS):
        reference = reference_of(predictions_of(model, driven(gain), FREE_GAIN_STD))
        if reference is None:
            break
        mass, std = reference.posterior.modal_mass
        gain, by = gain / mass, "smooth curves of amplitude"
        doubt = force_gain_undetermined(std / mass, float(np.max(np.abs(phase))))
    note = (
        f"the force is known as a drive voltage only: about {gain:.4g} N/V by {by}. The gain "
        "is fitted too: a 1 % error of the gain looks like 1 % of damping."
    )
    return FirstGain(driven(gain), gain, (note, doubt) if doubt else (note,))
