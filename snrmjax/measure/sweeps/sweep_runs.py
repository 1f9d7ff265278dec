"""Sweeps of a record: stretches of monotonic drive frequency."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from snrmjax.measure.recordings.tone_track import ToneTrack

LEAST_RANGE = 0.02  # least relative frequency range of a sweep
_TURN = 0.02  # of the range of log frequency: larger reversals end a sweep
_FEWEST_FRAMES = 8
_GAP = 1.6  # hops between frames, above which data are missing
_JUMP = 0.1  # of log frequency between frames: another sweep begins


class Sweep(NamedTuple):
    """One run of a record in one direction."""

    start: float  # s
    stop: float  # s
    first: float  # rad/s
    last: float  # rad/s


def track_speed(track: ToneTrack, phase: np.ndarray) -> Float[np.ndarray, " frame"]:
    """Frequency in rad per sample at every frame, from the phases of its neighbours."""
    return np.gradient(phase, track.middle)


def sweep_runs(track: ToneTrack, phase: np.ndarray) -> list[slice]:
    """Stretches of frames with monotonic frequency."""
    if len(track.middle) < _FEWEST_FRAMES:
        return []
    level = np.log(np.maximum(track_speed(track, phase), np.finfo(float).tiny))
    gaps = np.flatnonzero(
        np.diff(track.middle) > _GAP * np.maximum(track.length[1:], track.length[:-1])
    )
    jumps = np.flatnonzero(np.abs(np.diff(np.log(track.frequency))) > _JUMP)
    breaks = {int(k) + 1 for k in (*gaps, *jumps)}
    reversal = _TURN * float(np.ptp(np.log(track.frequency)))
    cuts, extreme, direction = [0], 0, 0
    for k in range(1, len(level)):
        if k in breaks:
            cuts, extreme, direction = [*cuts, k], k, 0
            continue
        moved = level[k] - level[extreme]
        if direction == 0 and abs(moved) > reversal:
            direction, extreme = int(np.sign(moved)), k
        elif direction * moved > 0:
            extreme = k
        elif direction and -direction * moved > reversal:
            cuts, direction, extreme = [*cuts, extreme], -direction, k
    ends = [*cuts[1:], len(level)]
    return [
        slice(begin, end)
        for begin, end in zip(cuts, ends, strict=True)
        if end - begin >= _FEWEST_FRAMES
        and abs(np.log(track.frequency[end - 1] / track.frequency[begin])) > LEAST_RANGE
    ]
