"""Frequency responses from periodic multisines.

The part that repeats from period to period is signal, the rest is noise; differences between
realisations of random phases beyond noise are nonlinear distortions.

Reference: R. Pintelon & J. Schoukens, System Identification: A Frequency Domain Approach, 2nd ed.
(2012), section 4.3 (robust and fast method for the best linear approximation).
"""

from collections.abc import Sequence
from typing import ClassVar, NamedTuple

import numpy as np
from jaxtyping import Complex, Float

from snrmjax.measure.recordings.channels import Channel, channel_number
from snrmjax.measure.recordings.frequency_responses import FrequencyResponses, frequency_responses
from snrmjax.measure.recordings.time_recording import TimeRecording
from snrmjax.numerics.result import AbstractResult, Variable, quantity, setting
from snrmjax.numerics.rules import InputError
from snrmjax.numerics.units import HERTZ

_EXCITED = 0.03  # of the largest line of the force, least amplitude of an excited line
_SURE = 25.0  # and least power over the variance of its mean
_MOST_SAMPLES = 2**21  # searched for a period
_REPEATS = 0.5  # least autocorrelation at a lag of one period
_BEST = 0.9  # of the largest autocorrelation: the first such lag is the period
_OFF = 0.05  # samples, permitted deviation of a period from a whole number


class MultisineResponses(AbstractResult):
    """Best linear approximation of multisine tests, and its errors.

    Standard deviations are rms of the complex errors of the means. `total_std` includes nonlinear
    scatter between realisations; NaN for a single one.
    """

    coordinates: ClassVar[tuple[str, ...]] = ("frequency_hz", "response")

    responses: FrequencyResponses
    noise_std: Float[np.ndarray, "response frequency"] = quantity(
        "response frequency_hz", "SI", "error by noise"
    )
    total_std: Float[np.ndarray, "response frequency"] = quantity(
        "response frequency_hz", "SI", "error by noise and nonlinearity"
    )
    period: float = setting()  # s
    periods: int = setting()  # used of each realisation
    realisations: int = setting()

    def summary(self) -> tuple[str, ...]:
        """Lines, noise and scatter."""
        hertz = self.responses.frequency / HERTZ
        lines = [
            f"MultisineResponses: {len(hertz)} lines, {hertz[0]:.6g} to {hertz[-1]:.6g} Hz, "
            f"{self.periods} periods of {self.period:.4g} s, {self.realisations} realisations",
            f"noise {100 * _relative(self.noise_std, self.responses.values):.2g} %",
        ]
        if self.realisations > 1:
            fraction = 100 * _relative(self.total_std, self.responses.values)
            lines.append(f"noise and nonlinear scatter {fraction:.2g} %")
        return tuple(lines)

    def variables(self) -> dict[str, Variable]:
        """Columns by response and line, with the linear approximation."""
        at, linear = ("response", "frequency_hz"), self.responses.variables()
        values = {
            name: linear[name]._replace(dimensions=at, values=linear[name].values[:, 0])
            for name in ("value_re", "value_im")
        }
        return {
            "response": linear["response"],
            "frequency_hz": linear["frequency_hz"],
            **values,
            **super().variables(),
        }


def _relative(std: np.ndarray, values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(std**2) / np.mean(np.abs(values) ** 2)))


def multisine_responses(
    recordings: TimeRecording | Sequence[TimeRecording],
    force: str,
    responses: Sequence[str],
    *,
    period: float | None = None,
    skip: int = 1,
    lines: Float[np.ndarray, " line"] | Sequence[float] | None = None,
) -> MultisineResponses:
    """Best linear approximation from several periods and realisations of a multisine.

    G(k) is the mean over realisations of the ratio of the period-averaged spectra. Only one period
    at a time is in memory.

    Arguments: `recordings`, one per realisation of random phases, with the same channels and rate;
    `force` and `responses` by their channels' names; `period` in s, by default detected; `skip`
    periods at the start of each record are discarded for the transient; `lines` in rad/s are the
    excited ones, by default detected.
    Returns `MultisineResponses`. Raises `ValueError` for different channels or rates, a period
    that is not detected or not a whole number of samples, fewer than two remaining periods,
    lines between multiples of 1/period, no excited line, and samples that are not finite.
    Reference: Pintelon & Schoukens (2012), section 4.3.
    """
    records = (recordings,) if isinstance(recordings, TimeRecording) else tuple(recordings)
    names = (force, *((responses,) if isinstance(responses, str) else tuple(responses)))
    _check(records, names, skip)
    rate = records[0].sampling_rate
    samples = _detected_period(records[0], force) if period is None else _stated(period, rate)
    spectra = [_spectra(record, names, samples, skip) for record in records]
    periods = min(record.periods for record in spectra)
    excited = _lines(lines, spectra[0], rate, samples)
    ratio, noise = zip(*(_response(record, excited) for record in spectra), strict=True)
    mean = np.mean(ratio, axis=0)
    count = len(records)
    noise_std = np.sqrt(np.mean(noise, axis=0) / count)
    scatter = np.sum(np.abs(np.array(ratio) - mean) ** 2, axis=0) / max(count - 1, 1) / count
    total = (
        np.sqrt(np.maximum(scatter, noise_std**2)) if count > 1 else np.full_like(scatter, np.nan)
    )
    linear = frequency_responses(
        excited * HERTZ * rate / samples,
        mean[:, None],
        [_in_si(records[0], name) for name in names[1:]],
        [_in_si(records[0], force)],
        averages=periods * count,
        name=records[0].name,
    )
    return MultisineResponses(
        responses=linear,
        noise_std=noise_std,
        total_std=total,
        period=samples / rate,
        periods=periods,
        realisations=count,
    )


class _Spectra(NamedTuple):
    """Mean spectrum over periods (peak amplitudes) and the covariance of a single period."""

    mean: Complex[np.ndarray, "channel line"]
    variance: Float[np.ndarray, "channel line"]
    mixed: Complex[np.ndarray, "channel line"]  # covariance with the first channel
    periods: int


def _check(records: tuple[TimeRecording, ...], names: tuple[str, ...], skip: int) -> None:
    if not records:
        raise InputError("`recordings` must have at least one realisation, but is empty.")
    if len(names) < 2 or len(set(names)) != len(names):
        raise InputError(f"name a force and other channels as responses, not {', '.join(names)}.")
    for record in records:
        for name in names:
            channel_number(record.channels, name)
        if record.sampling_rate != records[0].sampling_rate:
            raise InputError(
                "realisations must have one sampling rate, but have "
                f"{records[0].sampling_rate:g} and {record.sampling_rate:g} Hz."
            )
    if skip < 0 or int(skip) != skip:
        raise InputError(f"`skip` must be a whole number of periods from 0 on, but is {skip}.")


def _in_si(recording: TimeRecording, name: str) -> Channel:
    """The channel of values that are already in SI units."""
    channel = recording.channels[channel_number(recording.channels, name)]
    return channel._replace(calibration=1.0)


def _stated(period: float, rate: float) -> int:
    samples = round(period * rate) if np.isfinite(period) else 0
    if samples < 4 or abs(period * rate - samples) > 1e-3:
        raise InputError(
            f"`period` must be a whole number of samples (4 or more), but {period:g} s are "
            f"{period * rate:g}."
        )
    return samples


def _detected_period(recording: TimeRecording, force: str) -> int:
    values = recording.values([force], 0, _MOST_SAMPLES)[0]
    if not np.isfinite(values).all():
        raise InputError(f"channel {force} has samples that are not finite.")
    values = values - values.mean()
    n = len(values)
    spectrum = np.abs(np.fft.rfft(values, 2 * n)) ** 2
    lags = np.arange(n // 2)
    correlation = np.fft.irfft(spectrum)[: n // 2] / (n - lags)
    correlation /= max(correlation[0], np.finfo(float).tiny)
    # Beyond the first drop: every signal is correlated near lag zero.
    falls = np.flatnonzero(correlation < _REPEATS)
    after = int(falls[0]) if falls.size else n // 2
    best = correlation[after:].max(initial=0.0)
    if best < _REPEATS:
        raise InputError(
            f"no period in channel {force}: it does not repeat within half the record; state "
            "`period`."
        )
    late = correlation[after:]
    inner = np.flatnonzero(
        (late[1:-1] >= late[:-2]) & (late[1:-1] >= late[2:]) & (late[1:-1] >= _BEST * best)
    )
    if not inner.size:
        raise InputError(f"no period in channel {force}; state `period`.")
    lag = after + 1 + int(inner[0])
    a, b, c = correlation[lag - 1 : lag + 2]
    off = 0.5 * (a - c) / (a - 2 * b + c)
    if abs(off) > _OFF:
        raise InputError(
            f"the period of channel {force}, about {lag + off:.2f} samples, is not a whole "
            "number: sample in step with the generator, or state `period`."
        )
    return lag


def _spectra(recording: TimeRecording, names: tuple[str, ...], samples: int, skip: int) -> _Spectra:
    count = recording.n_samples // samples - skip
    if count < 2:
        raise InputError(
            f"two periods are needed after the {skip} discarded, but the record has "
            f"{recording.n_samples / samples:.3g} of {samples / recording.sampling_rate:.4g} s."
        )
    total = np.zeros((len(names), samples // 2 + 1), dtype=complex)
    squares = np.zeros(total.shape)
    mixed = np.zeros_like(total)
    first = np.zeros_like(total)
    for k in range(skip, skip + count):
        values = recording.values(names, k * samples, (k + 1) * samples)
        if not np.isfinite(values).all():
            raise InputError(f"period {k} of the record has samples that are not finite.")
        spectrum = 2 / samples * np.fft.rfft(values, axis=1)
        first = spectrum if k == skip else first
        away = spectrum - first  # relative to the first: no cancellation in the squares
        total += away
        squares += np.abs(away) ** 2
        mixed += away * away[0].conj()
    mean = total / count
    return _Spectra(
        mean + first,
        np.maximum(squares - count * np.abs(mean) ** 2, 0.0) / (count - 1),
        (mixed - count * mean * mean[0].conj()) / (count - 1),
        count,
    )


def _lines(
    lines: Float[np.ndarray, " line"] | Sequence[float] | None,
    spectra: _Spectra,
    rate: float,
    samples: int,
) -> np.ndarray:
    """Numbers of the excited lines."""
    highest = spectra.mean.shape[1] - 1
    if lines is not None:
        position = np.asarray(lines, dtype=float) * samples / rate / HERTZ
        number = np.unique(np.round(position).astype(int))
        if not position.size or np.any(np.abs(position - np.round(position)) > 1e-3):
            raise InputError("`lines` must be multiples of 1/period (in rad/s: times 2π).")
        if number[0] < 1 or number[-1] >= highest:
            raise InputError("`lines` must lie between 0 and half the sampling rate.")
        return number
    amplitude = np.abs(spectra.mean[0])
    amplitude[0] = 0.0
    noise = spectra.variance[0] / spectra.periods
    excited = np.flatnonzero(
        (amplitude > _EXCITED * amplitude.max()) & (amplitude**2 > _SURE * noise)
    )
    if not excited.size or amplitude.max() == 0:
        raise InputError("no line of the force exceeds its noise: nothing is excited.")
    return excited


def _response(spectra: _Spectra, lines: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Ratios at the excited lines and the variances of their complex errors."""
    drive = spectra.mean[0, lines]
    ratio = spectra.mean[1:, lines] / drive
    variance = (
        spectra.variance[1:, lines]
        + np.abs(ratio) ** 2 * spectra.variance[0, lines]
        - 2 * np.real(spectra.mixed[1:, lines] * ratio.conj())
    )
    return ratio, np.maximum(variance, 0.0) / np.abs(drive) ** 2 / spectra.periods
