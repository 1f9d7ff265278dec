"""States whose force is known as a drive voltage only: a first value of the unknown gain."""

from typing import NamedTuple

import equinox as eqx
import numpy as np

from snrmjax.diagnose.misfit.predictions import predictions_of
from snrmjax.diagnose.misfit.weighted_misfit import weighted_misfit
from snrmjax.measure.states import SteadyStates
from snrmjax.model.structures import Structure

FREE_GAIN_STD = 1.0
"""Relative 1σ of a force gain that is unknown."""


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

    It is that of a joint fit of smooth curves. A joint fit needs phases: where some are unknown,
    the gain is the median, over the states, of the force that the model needs for the measured
    motion over the drive voltage.

    Raises `ValueError` where the model has no such motions, and what `fit_jointly` raises, as for
    a gain that the states do not determine.
    """
    doubts: tuple[str, ...] = ()
    if np.any(np.asarray(data.phase_unknown)):
        in_volts = eqx.tree_at(lambda d: d.force, data, data.drive)
        needed = weighted_misfit(predictions_of(model, in_volts, FREE_GAIN_STD)).baseline.force
        if not np.any(np.isfinite(needed)):
            raise ValueError("the model has no motion of the measured amplitude for any state.")
        gain = float(np.median(np.abs(needed)[np.isfinite(needed)]))
        found, by = eqx.tree_at(lambda d: d.force, data, gain * data.drive), "the model as given"
    else:
        # Few need it, and it takes as long to import as half the others.
        from snrmjax.identify.checks.instruments import notes_on_instruments
        from snrmjax.identify.inference.corrected_states import corrected_states
        from snrmjax.identify.joint.joint_fit import fit_jointly
        from snrmjax.identify.test_model.states import LEVEL_ERRORS

        fit = fit_jointly(data, model.modes, free=("force_gain",))
        gain = float(np.exp(fit.unknowns.log_force_gain))
        found, by = corrected_states(data, fit), "a joint fit of smooth curves"
        doubts = notes_on_instruments(fit, LEVEL_ERRORS)
    note = (
        f"the force is known as a drive voltage only: about {gain:.4g} N/V by {by}. The gain "
        "is fitted too: a 1 % error of the gain looks like 1 % of damping."
    )
    return FirstGain(found, gain, (note, *doubts))
