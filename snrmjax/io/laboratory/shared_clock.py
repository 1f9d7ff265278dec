"""Channels of one test on a common clock: aligned by stated start times, joined across files."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Num

from snrmjax.io.laboratory.names import role_of
from snrmjax.measure.recordings.channels import Channel
from snrmjax.measure.recordings.time_recording import AbstractSamples, TimeRecording
from snrmjax.numerics.facts import Fact

_WHOLE = 1e-2  # of a sample: tolerance of a shift by whole samples
_ALIKE = 1e-12  # relative tolerance of equal time steps of one device


class TimeAxis(NamedTuple):
    """Sampling times of a channel, as stated by the file."""

    step: float  # s
    start: float  # s, of the first sample
    n_samples: int


class SharedAxis(NamedTuple):
    """Channels sampled at the same instants, and where the common part begins in each."""

    channels: tuple[str, ...]
    skipped: tuple[int, ...]  # samples of each channel before the common part
    axis: TimeAxis
    cut: tuple[str, ...] = ()  # channels that continue after it


def shared_axes(stated: Mapping[str, TimeAxis]) -> list[SharedAxis]:
    """Group channels by common sampling instants, in the order of their first members.

    Channels of equal step whose starts differ by whole samples form a group if they overlap for
    most of the time; the overlap is kept. Others stay separate: a fraction of a sample would be a
    phase error.
    """
    groups: list[dict[str, TimeAxis]] = []
    for key, axis in stated.items():
        group = next((one for one in groups if _in_step(axis, [*one.values()])), None)
        if group is None:
            groups.append({key: axis})
        else:
            group[key] = axis
    shared = []
    for group in groups:
        step = next(iter(group.values())).step
        first = max(axis.start for axis in group.values())
        skipped = [round((first - axis.start) / step) for axis in group.values()]
        remaining = [axis.n_samples - n for axis, n in zip(group.values(), skipped, strict=True)]
        axis = TimeAxis(step, first, min(remaining))
        cut = tuple(key for key, n in zip(group, remaining, strict=True) if n > min(remaining))
        shared.append(SharedAxis(tuple(group), tuple(skipped), axis, cut))
    return shared


def _in_step(axis: TimeAxis, group: Sequence[TimeAxis]) -> bool:
    """Whether a channel shares sampling instants and most of its time with a group."""
    one = group[0]
    shift = (axis.start - one.start) / one.step
    together = [*group, axis]
    begins = max(each.start for each in together)
    ends = min(each.start + each.n_samples * each.step for each in together)
    longest = max(each.n_samples * each.step for each in together)
    return (
        abs(axis.step / one.step - 1) < _ALIKE
        and abs(shift - round(shift)) < _WHOLE
        and ends - begins > longest / 2
    )


def note_on_shift(shared: SharedAxis) -> tuple[Fact, ...]:
    """Notes on the channels that were shifted or cut, if any were."""
    cut = (Fact("channels_cut", names=shared.cut, n=shared.axis.n_samples),) if shared.cut else ()
    if not any(shared.skipped):
        return cut
    # The last to begin skips nothing; the note lists how much earlier the others began.
    shifts = dict(zip(shared.channels, shared.skipped, strict=True))
    earlier = {name: n for name, n in shifts.items() if n}
    shifted = Fact(
        "channels_shifted",
        names=tuple(earlier),
        seconds=tuple(n * shared.axis.step for n in earlier.values()),
    )
    return (shifted, *cut)


def note_on_clocks(clocks: Sequence[SharedAxis]) -> tuple[Fact, ...]:
    """A note on channels that are separate records, and how they differ from the first ones."""
    if len(clocks) < 2:
        return ()
    first, *others = clocks
    return tuple(
        Fact(
            "clocks_apart",
            names=other.channels,
            of=first.channels,
            seconds=other.axis.start - first.axis.start,
            samples=(other.axis.start - first.axis.start) / first.axis.step,
            rates=(1 / first.axis.step, 1 / other.axis.step),
        )
        for other in others
    )


class _JoinedSamples(AbstractSamples):
    """Samples of single-channel records of equal length."""

    def __init__(self, records: Sequence[TimeRecording]) -> None:
        self._records = [record.samples for record in records]

    @property
    def shape(self) -> tuple[int, int]:
        """Channels and samples."""
        return len(self._records), self._records[0].shape[1]

    def read(
        self, channels: Sequence[int], start: int, stop: int
    ) -> Num[np.ndarray, "channel sample"]:
        """Samples of some channels."""
        return np.concatenate([self._records[k].read([0], start, stop) for k in channels])


def joined_structs(records: Sequence[TimeRecording]) -> list[TimeRecording]:
    """Join single-channel records on a common clock, such as structs named force and response.

    At least one name must be an excitation: structs named "run1" and "run2" are two tests. Channels
    with equal names take the name of their struct.
    """
    named = [one.name.rsplit(".", 1)[-1] for one in records]
    single = len(records) > 1 and all(len(one.channels) == 1 for one in records)
    roles = [role_of(name) for name in named]
    if not single or not {"force", "drive"} & {*roles} or len({*named}) < len(named):
        return list(records)
    doubled = len({one.channels[0].name for one in records}) < len(records)
    renamed = {
        name: [
            dataclasses.replace(
                one,
                channels=(one.channels[0]._replace(name=name),) if doubled else one.channels,
            )
        ]
        for name, one in zip(named, records, strict=True)
    }
    joined = joined_by_clock(renamed)
    return list(records) if joined is None else [joined[0]]


def joined_by_clock(
    records: Mapping[str, Sequence[TimeRecording]],
) -> tuple[TimeRecording, str] | None:
    """Join the channels of several files into one record; None where they have no common clock.

    Each file must have one record of a single channel, all of equal rate, start and length, and no
    two of equal name and quantity (those would be two tests). Channels with equal names take the
    name of their file.
    Arguments: `records` of each file by its name.
    """
    single = {file: recordings[0] for file, recordings in records.items() if len(recordings) == 1}
    if len(single) < 2 or len(single) < len(records):
        return None
    each = list(single.values())
    axes = {(one.sampling_rate, one.start_time, one.n_samples) for one in each}
    if len(axes) > 1 or any(len(one.channels) > 1 for one in each):
        return None
    names = [one.channels[0].name for one in each]
    quantities = [one.channels[0].quantity for one in each]
    if len({*zip(names, quantities, strict=True)}) < len(each):
        return None
    channels: list[Channel] = []
    for file, one in single.items():
        (channel,) = one.channels
        doubled = names.count(channel.name) > 1
        channels.append(channel._replace(name=file.rsplit(".", 1)[0]) if doubled else channel)
    notes = tuple(dict.fromkeys(note for one in each for note in one.notes))
    joined = TimeRecording(
        tuple(channels),
        _JoinedSamples(each),
        each[0].sampling_rate,
        each[0].start_time,
        "",
        notes,
    )
    return joined, ", ".join(single)
