"""The settled steps of a record, each folded to one period of the force."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float

from snrmjax.measure.recordings.channels import channel_number
from snrmjax.measure.recordings.stepped_sine import SteppedSineStates
from snrmjax.measure.recordings.time_recording import TimeRecording

_ORDERS = (0, 1, 2, 3, 4, 5)
_MOST = 20_000  # samples of a step that are used, from its end


class FoldedRecord(NamedTuple):
    """One steady state, recorded and fitted, folded to one period of the force.

    Phases are relative to the force's fundamental; harmonics e^{+ikΩt}, order 0 first.
    """

    phase: Float[np.ndarray, " sample"]  # rad, from 0 to 2π
    force: Float[np.ndarray, " sample"]  # N (or V)
    response: Float[np.ndarray, " sample"]  # as recorded, in the SI unit of its quantity
    force_harmonics: Complex[np.ndarray, " harmonic"]
    response_harmonics: Complex[np.ndarray, " harmonic"]
    orders: tuple[int, ...]
    quantity: str = "velocity"
    unit: str = "m/s"


def folded_records(
    recording: TimeRecording, steps: SteppedSineStates, force: str, response: str
) -> list[FoldedRecord | None]:
    """Every steady state of a record folded to one period, in the order of the states.

    Arguments: `steps` from `stepped_sine_states` of `recording`; `force` and `response` are
    names of channels. Harmonics 0 to 5 are fitted by least squares to the end of each step; None
    where a period has too few samples for them.
    """
    channel = recording.channels[channel_number(recording.channels, response)]
    folded: list[FoldedRecord | None] = [None] * steps.states.n_states
    for step in np.flatnonzero(np.asarray(steps.state) >= 0):
        omega = float(steps.frequency[step])
        stop = _sample(recording, float(steps.stop[step]))
        start = max(_sample(recording, float(steps.settled_from[step])), stop - _MOST)
        if omega * max(_ORDERS) >= np.pi * recording.sampling_rate:
            continue
        both = recording.values([force, response], start, stop)
        angle = omega * recording.time(start, stop)
        fitted, *_ = np.linalg.lstsq(_basis(angle), both.T, rcond=None)
        n = len(_ORDERS)
        phasors = fitted[:n] - 1j * np.concatenate([np.zeros((1, 2)), fitted[n:]])
        lead = float(np.angle(phasors[1, 0]))
        phasors = phasors * np.exp(-1j * lead * np.array(_ORDERS))[:, None]
        phase = np.mod(angle + lead, 2 * np.pi)
        folded[int(steps.state[step])] = FoldedRecord(
            phase=phase,
            force=both[0],
            response=both[1],
            force_harmonics=phasors[:, 0],
            response_harmonics=phasors[:, 1],
            orders=_ORDERS,
            quantity=channel.quantity,
            unit=channel.si_unit,
        )
    return folded


def _sample(recording: TimeRecording, at: float) -> int:
    number = round((at - recording.start_time) * recording.sampling_rate)
    return min(max(number, 0), recording.n_samples)


def _basis(angle: np.ndarray) -> np.ndarray:
    cosines = [np.cos(order * angle) for order in _ORDERS]
    return np.stack([*cosines, *(np.sin(order * angle) for order in _ORDERS[1:])], axis=1)
