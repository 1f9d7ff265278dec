"""Linear modes of what was measured: frequency responses, low-level states or free decays."""

from collections.abc import Mapping, Sequence
from typing import Any

from snrmjax.identify.modal.base_motion import MotionKind, relative_to_base
from snrmjax.identify.modal.free_decay import DecayModes, fit_free_decay
from snrmjax.identify.modal.linear_fit import fit_linear_modes
from snrmjax.identify.modal.modal_fit import LinearModalFit
from snrmjax.identify.modal.state_responses import (
    amplitude_dependence,
    levels_by_velocity,
    responses_of_states,
)
from snrmjax.measure.recordings.frequency_responses import FrequencyResponses
from snrmjax.measure.recordings.time_recording import TimeRecording
from snrmjax.measure.states import SteadyStates
from snrmjax.numerics.facts import Fact

_OF_DECAYS = ("to_frequency", "poles", "highest_order")


def find_modes(
    source: FrequencyResponses | SteadyStates | Sequence[TimeRecording],
    *,
    level: int | None = None,
    base: MotionKind | None = None,
    **settings: Any,
) -> tuple[LinearModalFit | DecayModes, tuple[Fact, ...]]:
    """Modes of what was measured, and notes on it.

    Of steady states the lowest level counts, and the next one says whether it was low enough.

    Arguments: `level` of steady states in place of the lowest; `base` what the responses are where
    the reference is the motion of a base; `settings` those of `fit_linear_modes`, of which free
    decays take the poles, the highest order and the upper end of the band.
    Raises `ValueError` as the fits do.
    """
    if isinstance(source, FrequencyResponses):
        return _of_responses(source, base, settings), ()
    if not isinstance(source, SteadyStates):
        of_decays = {name: settings[name] for name in _OF_DECAYS if name in settings}
        return fit_free_decay(source, **of_decays), ()
    levels = levels_by_velocity(source)
    chosen = levels[0] if level is None else level
    lowest = responses_of_states(source, chosen)
    modes = _of_responses(lowest.responses, base, {**settings, "std": lowest.std})
    above = levels[levels.index(chosen) + 1 :]
    if not above:
        return modes, (Fact("one_level_for_modes"),)
    other = responses_of_states(source, above[0])
    by_hand = {"poles": tuple(modes.natural_frequency), "order": None, "std": other.std}
    try:
        second = _of_responses(other.responses, base, {**settings, **by_hand})
    except ValueError as error:
        pair = {"level": chosen, "other": above[0]}
        return modes, (Fact("levels_not_compared", **pair, reason=str(error)),)
    return amplitude_dependence(modes, second, (lowest.velocity, other.velocity))


def _of_responses(
    responses: FrequencyResponses, base: MotionKind | None, settings: Mapping[str, Any]
) -> LinearModalFit:
    if base is None:
        return fit_linear_modes(responses, **settings)
    relative = relative_to_base(responses, base)
    return fit_linear_modes(relative.responses, **{**settings, "std": relative.std})
