"""Channels of one test on one clock: shifted by the starts that files state, joined over files."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Num

from snrmjax.io.laboratory.names import role_of
from snrmjax.measure.recordings.channels import Channel
from snrmjax.measure.recordings.time_recording import AbstractSamples, TimeRecording
from snrmjax.numerics.facts import Fact

_WHOLE = 1e-2  # of a sample, within which a shift is one of whole samples
_ALIKE = 1e-12  # relative, of two steps in the properties of one device


class TimeAxis(NamedTuple):
    """What a channel's file says of its samples' times."""

    step: float  # s
    start: float  # s, of the first sample
    n_samples: int


class SharedAxis(NamedTuple):
    """Channels that were sampled at the same instants, and where in each the common part begins."""

    channels: tuple[str, ...]
    skipped: tuple[int, ...]  # samples of each channel before the common part
    axis: TimeAxis
    cut: tuple[str, ...] = ()  # channels that go on behind it


def shared_axes(stated: Mapping[str, TimeAxis]) -> list[SharedAxis]:
    """Channels in groups that have their instants in common, in the order of their first ones.

    Channels of one step whose starts differ by whole samples are of one group, of which the time
    that all have is kept, if that is most of it; others stay apart: a fraction of a sample is an
    error of the phase.
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
        left = [axis.n_samples - n for axis, n in zip(group.values(), skipped, strict=True)]
        axis = TimeAxis(step, first, min(left))
        cut = tuple(key for key, n in zip(group, left, strict=True) if n > min(left))
        shared.append(SharedAxis(tuple(group), tuple(skipped), axis, cut))
    return shared


def _in_step(axis: TimeAxis, group: Sequence[TimeAxis]) -> bool:
    """Whether a channel has its instants in common with a group, and most of its time."""
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
    # The last to begin skips nothing: the others are told by how much earlier they began.
    shifts = dict(zip(shared.channels, shared.skipped, strict=True))
    earlier = {name: n for name, n in shifts.items() if n}
    shifted = Fact(
        "channels_shifted",
        names=tuple(earlier),
        seconds=tuple(n * shared.axis.step for n in earlier.values()),
    )
    return (shifted, *cut)


class _JoinedSamples(AbstractSamples):
    """The channels of records of one channel each, all of one length."""

    def __init__(self, records: Sequence[TimeRecording]) -> None:
        self._records = [record.samples for record in records]

    @property
    def shape(self) -> tuple[int, int]:
        """Channels and samples."""
        return len(self._records), self._records[0].shape[1]

    def read(
        self, channels: Sequence[int], start: int, stop: int
    ) -> Num[np.ndarray, "channel sample"]:
        """A stretch of some channels."""
        return np.concatenate([self._records[k].read([0], start, stop) for k in channels])


def joined_structs(records: Sequence[TimeRecording]) -> list[TimeRecording]:
    """Records of one channel each, of one clock, as one: those of structs called force and so on.

    One of them at least must be called what drives a structure: structs called "run1" and "run2"
    are two tests. Channels of one name get their struct's.
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
    """One record of the channels of several files, or None where they are none of one clock.

    A test is in several files where each of them holds one record of a single channel, all of one
    rate, start and length, and no two of one name and quantity: those would be two tests. Channels
    keep their names; those of one name get their file's.
    Arguments: `records` of each file by its name.
    """
    single = {file: held[0] for file, held in records.items() if len(held) == 1}
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
