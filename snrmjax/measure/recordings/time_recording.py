"""Sampled channels of a test, in memory or read in blocks from a file."""

import abc
from collections.abc import Iterator, Sequence
from typing import ClassVar, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float, Num

from snrmjax.measure.recordings.channels import Channel, channel_number, checked_channels
from snrmjax.numerics.facts import Fact
from snrmjax.numerics.result import AbstractResult, Variable, setting
from snrmjax.numerics.rules import POSITIVE, InputError, require

_MOST_AT_ONCE = 2**25  # numbers of all channels together: 256 MiB of float64


class AbstractSamples(abc.ABC):
    """Samples as recorded, before calibration, from any storage."""

    @property
    @abc.abstractmethod
    def shape(self) -> tuple[int, int]:
        """Channels and samples."""

    @abc.abstractmethod
    def read(
        self, channels: Sequence[int], start: int, stop: int
    ) -> Num[np.ndarray, "channel sample"]:
        """Samples `start` to `stop` (exclusive) of some channels."""


class SamplesInMemory(AbstractSamples):
    """Samples in memory (or of a memory-mapped file)."""

    def __init__(self, values: Num[np.ndarray, "channel sample"]) -> None:
        self._values = values

    @property
    def shape(self) -> tuple[int, int]:
        """Channels and samples."""
        channels, samples = self._values.shape
        return channels, samples

    def read(
        self, channels: Sequence[int], start: int, stop: int
    ) -> Num[np.ndarray, "channel sample"]:
        """Samples `start` to `stop` (exclusive) of some channels."""
        return np.asarray(self._values[list(channels), start:stop])


class RecordBlock(NamedTuple):
    """A stretch of a recording."""

    start: int  # number of its first sample
    time: Float[np.ndarray, " sample"]  # s
    values: Float[np.ndarray, "channel sample"]  # SI


class TimeRecording(AbstractResult):
    """Simultaneously sampled channels at a constant rate; see `time_recording`.

    Reading is lazy: `values` gives a stretch in SI units, `blocks` the whole record in pieces, so
    that it need not fit into memory.
    """

    coordinates: ClassVar[tuple[str, ...]] = ("time_s",)

    channels: tuple[Channel, ...] = eqx.field(static=True)
    samples: AbstractSamples = eqx.field(static=True)
    sampling_rate: float = eqx.field(static=True)  # Hz
    start_time: float = eqx.field(static=True, default=0.0)  # s, of the first sample
    name: str = eqx.field(static=True, default="")
    notes: tuple[Fact | str, ...] = setting(default=())

    @property
    def n_samples(self) -> int:
        """Number of samples of every channel."""
        return self.samples.shape[1]

    @property
    def duration(self) -> float:
        """Duration from the first sample to one step after the last, s."""
        return self.n_samples / self.sampling_rate

    @property
    def channel_names(self) -> tuple[str, ...]:
        """The channels' names in order."""
        return tuple(channel.name for channel in self.channels)

    def time(self, start: int = 0, stop: int | None = None) -> Float[np.ndarray, " sample"]:
        """Times of samples `start` to `stop` (exclusive; the end by default), s."""
        last = self.n_samples if stop is None else min(stop, self.n_samples)
        return self.start_time + np.arange(start, last) / self.sampling_rate

    def values(
        self, names: Sequence[str] | None = None, start: int = 0, stop: int | None = None
    ) -> Float[np.ndarray, "channel sample"]:
        """Samples `start` to `stop` of the named channels (all by default) in SI units.

        Raises `ValueError` for an unknown name, and for more than 256 MiB at once: use `blocks`.
        """
        chosen = self.channel_names if names is None else tuple(names)
        rows = [channel_number(self.channels, name) for name in chosen]
        last = self.n_samples if stop is None else min(stop, self.n_samples)
        if len(rows) * max(0, last - start) > _MOST_AT_ONCE:
            raise InputError(
                f"{len(rows)} channels of {last - start} samples are too many for memory: "
                "read them by blocks."
            )
        scale = np.array([self.channels[k].calibration for k in rows])
        return np.asarray(self.samples.read(rows, start, last), dtype=float) * scale[:, None]

    def blocks(
        self, length: int, names: Sequence[str] | None = None, *, overlap: int = 0
    ) -> Iterator[RecordBlock]:
        """The recording in blocks of `length` samples, each overlapping the previous by `overlap`.

        The last may be shorter. Raises `ValueError` for an overlap that is not below `length`.
        """
        if not 0 <= overlap < length:
            raise InputError(f"`overlap` must be from 0 to below {length}, but is {overlap}.")
        start = 0
        while start < self.n_samples:
            stop = min(start + length, self.n_samples)
            yield RecordBlock(start, self.time(start, stop), self.values(names, start, stop))
            if stop == self.n_samples:
                return
            start = stop - overlap

    def summary(self) -> tuple[str, ...]:
        """Size and channels."""
        return (
            f"TimeRecording{': ' + self.name if self.name else ''}, {len(self.channels)} channels "
            f"of {self.n_samples} samples at {self.sampling_rate:.6g} Hz ({self.duration:.4g} s)",
            *(str(channel) for channel in self.channels),
            *(f"note: {note}" for note in self.notes),
        )

    def variables(self) -> dict[str, Variable]:
        """Every channel in SI units."""
        values = self.values()
        return {"time_s": Variable(("time_s",), self.time(), "s", "time")} | {
            channel.name: Variable(("time_s",), row, channel.si_unit, str(channel))
            for channel, row in zip(self.channels, values, strict=True)
        }


def time_recording(
    samples: Num[np.ndarray, "channel sample"] | AbstractSamples,
    channels: Sequence[Channel],
    sampling_rate: float,
    *,
    start_time: float = 0.0,
    name: str = "",
    notes: Sequence[Fact | str] = (),
) -> TimeRecording:
    """Build a `TimeRecording`, with checks.

    Arguments: `samples` as recorded, before calibration, an array (not copied, possibly
    memory-mapped) or a reader; `sampling_rate` in Hz; `start_time` in s.
    Raises `ValueError` for inconsistent shapes, no samples, channels as in `checked_channels`, and
    a rate that is not positive and finite.

    >>> record = time_recording(np.ones((1, 4)), [Channel("CH1", "force", "kN", 1e3)], 2.0)
    >>> record.values(["CH1"]).tolist(), record.time().tolist()
    ([[1000.0, 1000.0, 1000.0, 1000.0]], [0.0, 0.5, 1.0, 1.5])
    """
    stored = samples if isinstance(samples, AbstractSamples) else _in_memory(samples)
    listed = checked_channels(channels)
    if stored.shape[0] != len(listed):
        raise InputError(
            f"`samples` must have one row per channel, {len(listed)}, but has {stored.shape[0]}."
        )
    if not stored.shape[1]:
        raise InputError("a recording needs samples, but has none.")
    require("`sampling_rate` (Hz)", sampling_rate, POSITIVE)
    require("`start_time` (s)", start_time)
    return TimeRecording(
        listed, stored, float(sampling_rate), float(start_time), name, tuple(notes)
    )


def _in_memory(samples: Num[np.ndarray, "channel sample"]) -> SamplesInMemory:
    values = np.asanyarray(samples)
    if values.ndim != 2 or values.dtype.kind not in "iuf":
        raise InputError(
            "`samples` must be real numbers of channels by samples, but have shape "
            f"{values.shape} and type {values.dtype}."
        )
    return SamplesInMemory(values)
