"""Velocity of a record from a measured velocity, acceleration or displacement."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from snrmjax.measure.decays.decay_record import even_record
from snrmjax.measure.recordings.channels import channel_number
from snrmjax.measure.recordings.time_recording import TimeRecording
from snrmjax.numerics.facts import Fact
from snrmjax.numerics.rules import InputError
from snrmjax.numerics.units import HERTZ

_CORNER = 0.25  # of the motion's frequency: below it an integrated signal is drift
_ORDER = 4  # at the motion's frequency the filter is then 1 within 2e-5
_ENDS = 8.0  # cycles at both ends until it has settled
_SPLINE = 5


class RecordedVelocity(NamedTuple):
    """A stretch of a record as velocity."""

    time: Float[np.ndarray, " sample"]  # s
    velocity: Float[np.ndarray, " sample"]  # m/s
    start: int  # sample of the record at which it begins
    notes: tuple[Fact, ...] = ()


def recorded_velocity(
    recording: TimeRecording,
    name: str,
    frequency: float,
    part: tuple[int, int],
) -> RecordedVelocity:
    """The velocity of a motion over `part` of a record.

    Arguments: `name` of a channel of velocity, acceleration or displacement; `frequency` of the
    motion (rad/s); `part` in samples. Accelerations are integrated and displacements
    differentiated by a spline of degree 5; drift of an integral, below a quarter of the frequency,
    is removed by a zero-phase high-pass, whose ends of eight cycles are left out.
    Returns a `RecordedVelocity`. Raises `ValueError` as `even_record` does (a clipped record, one
    that is not finite).
    """
    quantity = recording.channels[channel_number(recording.channels, name)].quantity
    start, stop = part
    values = recording.values([name], start, stop)[0]
    time, signal = even_record(recording.time(start, stop), values - values.mean())
    notes: tuple[Fact, ...] = ()
    cycle = max(1, int(np.ceil(HERTZ * recording.sampling_rate / frequency)))
    if quantity != "velocity":
        from scipy.interpolate import make_interp_spline

        curve = make_interp_spline(time, signal, k=_SPLINE)
        change = curve.derivative() if quantity == "displacement" else curve.antiderivative()
        signal = np.asarray(change(time))
        notes = (Fact("velocity_by_spline", quantity=quantity),)
    if quantity == "acceleration":
        from scipy.signal import butter, sosfiltfilt

        ends = int(_ENDS * cycle)
        if len(signal) < 4 * ends:
            raise InputError(
                f"an acceleration needs {4 * _ENDS:g} cycles to be integrated, but the record has "
                f"{len(signal) / cycle:.3g}."
            )
        sections = butter(
            _ORDER, _CORNER * frequency, "highpass", fs=HERTZ * recording.sampling_rate,
            output="sos",
        )  # fmt: skip
        signal = sosfiltfilt(sections, signal)[ends:-ends]
        time, start = time[ends:-ends], start + ends
    return RecordedVelocity(time, signal, start, notes)
