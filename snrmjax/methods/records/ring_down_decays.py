"""Backbones from the ring-downs of a record: found, all channels together, read by amplitude.

Where the drive stops, the channels of one mode move in proportion, x_s(t) = φ_s q(t). The
proportions are the strongest singular vector of the record, and q is read for all channels at once,
with less noise than any of them has.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from snrmjax.measure.recordings.channels import channel_number
from snrmjax.measure.recordings.ring_down import find_ring_downs
from snrmjax.measure.recordings.time_recording import TimeRecording
from snrmjax.methods.records.resonant_decay import Reading, resonant_decay
from snrmjax.methods.result import MethodResult, method_result
from snrmjax.numerics.facts import Fact

_HERTZ = 2 * np.pi
_POWER = {"displacement": 1, "velocity": 0, "acceleration": -1}
_MOST_SAMPLES = 2**22  # of all channels: the decay itself is held in memory
_LEADS = 1.0  # cycles after the drive's last sample that are left out
_SETTLED = 8.0  # over a filter's width: what it needs at an end
_ABOVE_NOISE = 4.0  # standard deviations of noise down to which a decay is read


def ring_down_decays(
    recording: TimeRecording,
    drive: str,
    responses: Sequence[str],
    *,
    band: tuple[float, float] | None = None,
    reading: Reading = "peaks",
    window: float | None = None,
    least_amplitude: float | None = None,
    quiet: float = 0.05,
) -> tuple[MethodResult, ...]:
    """Natural frequency and damping against velocity along every free decay of a record.

    Arguments: `drive` names the channel that says when nothing drives (see `find_ring_downs`, also
    for `quiet`); `responses` name channels of one motion, displacement, velocity or acceleration;
    the velocities of the answer are those of the first; `band` (Hz), `reading` and `window` as in
    `resonant_decay`; `least_amplitude` in SI units of the channels, by default four times the noise
    that the record has beside the mode.
    Returns a `MethodResult` a ring-down. Accelerations and displacements are turned into velocities
    by the frequency that was found, damping with them, valid for the fundamental.
    Raises `ValueError` as `find_ring_downs` and `resonant_decay` do, for responses that are no
    motion or of different motions, and for decays of more than four million samples.
    Validity: one mode; shapes that do not change with amplitude.
    """
    names = (responses,) if isinstance(responses, str) else tuple(responses)
    if not names or len(set(names)) != len(names):
        raise ValueError(f"`responses` must name channels once each, but is {', '.join(names)}.")
    kinds = {recording.channels[channel_number(recording.channels, one)].quantity for one in names}
    if len(kinds) > 1 or not kinds <= set(_POWER):
        raise ValueError(
            "`responses` must be displacements, velocities or accelerations, all of one kind, but "
            f"are {', '.join(sorted(kinds))}."
        )
    unit = recording.channels[channel_number(recording.channels, names[0])].si_unit
    power = _POWER[kinds.pop()]
    results = []
    for k, free in enumerate(find_ring_downs(recording, drive, names[0], quiet=quiet)):
        lead = int(np.ceil(_LEADS * _HERTZ * recording.sampling_rate / free.frequency))
        start, stop = free.start + lead, free.stop
        if (stop - start) * len(names) > _MOST_SAMPLES:
            raise ValueError(
                f"ring-down {k} has {stop - start} samples of {len(names)} channels, more than "
                f"{_MOST_SAMPLES} together: ask for fewer channels."
            )
        values = recording.values(names, start, stop)
        if not np.isfinite(values).all():
            raise ValueError(f"ring-down {k} has samples that are not finite.")
        signal, share = _one_motion(values - values.mean(axis=1, keepdims=True))
        width = None if band is None else (band[1] - band[0]) / recording.sampling_rate
        noise = white_noise(signal)
        floor = _ABOVE_NOISE * noise * (1.0 if width is None else float(np.sqrt(2 * width)))
        least = floor if least_amplitude is None else least_amplitude
        signal = above_noise(signal, max(least, _ABOVE_NOISE * noise), lead, width)
        found = resonant_decay(
            recording.time(start, start + len(signal)),
            signal,
            reading=reading,
            band=band,
            window=window,
            least_amplitude=least,
        )
        begins = float(recording.time(start, start + 1)[0])
        notes = (
            Fact("ring_down_read", number=k, start_s=begins, least=least, unit=unit),
            *((Fact("power_in_one_shape", share=share),) if len(names) > 1 else ()),
            *found.notes,
        )
        results.append(_as_velocity(found, power, notes))
    return tuple(results)


def _one_motion(
    values: Float[np.ndarray, "channel sample"],
) -> tuple[Float[np.ndarray, " sample"], float]:
    """The motion that all channels share, at the first channel, and its share of the power."""
    covariance = values @ values.T
    powers, shapes = np.linalg.eigh(covariance)
    shape = shapes[:, -1]
    share = float(powers[-1] / max(np.trace(covariance), np.finfo(float).tiny))
    return shape[0] * (shape @ values), share


def white_noise(signal: Float[np.ndarray, " sample"]) -> float:
    """1σ of white noise by the median of the spectrum."""
    from scipy.signal import welch

    density = welch(signal, nperseg=min(len(signal), 4096))[1]
    return float(np.sqrt(np.median(density) / np.log(2) / 2))


def above_noise(
    signal: Float[np.ndarray, " sample"], least: float, cycle: int, width: float | None = None
) -> Float[np.ndarray, " sample"]:
    """The decay as long as it is above noise, and what a filter needs beyond that."""
    count = len(signal) // cycle
    sizes = np.abs(signal[: count * cycle]).reshape(count, cycle).max(axis=1)
    quiet = np.flatnonzero(sizes < least)
    if not quiet.size:
        return signal
    beyond = 0 if width is None else int(np.ceil(_SETTLED / width))
    return signal[: (int(quiet[0]) + 1) * cycle + beyond]


def _as_velocity(found: MethodResult, power: int, notes: Sequence[Fact]) -> MethodResult:
    """Amplitudes of a displacement or acceleration as those of the velocity: times ω^±1."""
    size = np.asarray(found.velocity)
    omega = np.asarray(found.natural_frequency)
    good = found.found
    bend = np.zeros(len(size))
    if power and good.sum() > 2:
        # d ln v/dt = d ln x/dt ± d ln ω/dt, and ω is a function of the amplitude.
        bend[good] = np.gradient(np.log(omega[good]), np.log(size[good]))
    points = [
        point._replace(
            velocity=float(speed), damping_ratio=float(point.damping_ratio * (1 + power * turn))
        )
        for point, speed, turn in zip(found.points(), size * omega**power, bend, strict=True)
    ]
    return method_result("resonant_decay", points, 0, notes)
