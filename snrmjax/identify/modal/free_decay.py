"""Linear modes from free decays: eigensystem realisation, then a fit of decaying oscillations.

y_i(t) = Σ_r e^(−ζωt) (a cos ω_d t + b sin ω_d t) + c. A decay has no force: frequencies, damping
and ratios of shapes follow, no scale.
Reference: Juang & Pappa, J. Guid. Control Dyn. 8 (1985) 620, doi:10.2514/3.20031.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float
from scipy.signal import decimate

from snrmjax.identify.modal.modal_fit import REAL, AbstractModalFit, phase_collinearity
from snrmjax.identify.modal.pole_orders import PoleOrders, clusters, gathered
from snrmjax.identify.modal.separable_fit import (
    ChannelRows,
    SeparableFit,
    TermColumns,
    fit_separable,
)
from snrmjax.measure.recordings.channels import Channel
from snrmjax.measure.recordings.time_recording import TimeRecording
from snrmjax.numerics.compiled import on_numbers
from snrmjax.numerics.facts import Fact
from snrmjax.numerics.result import quantity
from snrmjax.numerics.units import HERTZ

_MOTIONS = ("displacement", "velocity", "acceleration")
_HIGHEST = 30  # half the model order
_MOST_ROWS, _MOST_COLUMNS = 240, 3000  # of a Hankel matrix
_MOST_SAMPLES = 40_000  # of a channel, in the fit
_FEWEST_SAMPLES = 40
_SAMPLES_PER_CYCLE = 5  # kept of the highest frequency asked for
_SIGNIFICANT = 4.0  # standard errors of a mode's largest amplitude, without which it is none
_MOST_DAMPED = 0.5
_CORRELATED = 2.0  # sum of the correlations of residuals, from which on it is worth a note
_MOST_GROWTH = 3.0  # of a mode's logarithm over the record


class DecayCurves(NamedTuple):
    """Signals as recorded and as the modes give them, SI."""

    time: Float[np.ndarray, " sample"]  # s
    measured: Float[np.ndarray, "channel sample"]
    fitted: Float[np.ndarray, "channel sample"]


class DecayModes(AbstractModalFit):
    """Linear modes from free decays; see `fit_free_decay`.

    `amplitude` is the complex amplitude at the first sample used, in the unit of its channel, of
    the first decay; shapes are its ratios.
    """

    shape: Float[np.ndarray, "sensor mode"] = quantity(
        "sensor mode", "1", "shape, one at its largest sensor"
    )
    shape_std: Float[np.ndarray, "sensor mode"] = quantity("sensor mode", "1", "its 1σ")
    amplitude: Complex[np.ndarray, "sensor mode"]
    curves: DecayCurves

    def source_in_words(self) -> str:
        """See `AbstractModalFit`."""
        duration = self.curves.time[-1] - self.curves.time[0]
        return f"at {', '.join(self.sensor_names)} from {duration:.4g} s"


@on_numbers("Differentiate `sj.model.linear_response`.")
def fit_free_decay(
    decays: TimeRecording | Sequence[TimeRecording],
    *,
    channels: Sequence[str] | None = None,
    start_time: float | None = None,
    end_time: float | None = None,
    to_frequency: float | None = None,
    poles: Sequence[float] | None = None,
    highest_order: int | None = None,
) -> DecayModes:
    """Frequencies, damping ratios and relative shapes from free decays, with covariance.

    Poles of all orders of an eigensystem realisation start a least-squares fit of decaying
    oscillations to all channels and decays together; the size of each channel's residuals and the
    correlation of neighbouring ones give the errors.

    Arguments: one recording or several of the same channels and rate; `channels` by name, all that
    are a motion by default; `start_time`, `end_time` s of the part to use (from the largest
    value, to the end); `to_frequency` rad/s the highest of interest, to which long records are
    low-passed and thinned; `poles` natural frequencies in rad/s in place of clusters.
    Raises `ValueError` for recordings that differ in channels or rate, no motion, fewer than 40
    samples, signals of zeros, and where no pole is stable over the order.
    Validity: nothing acts on the structure in that part; linear and time-invariant.
    Not differentiable: differentiate `snrmjax.model.linear_response`.
    """
    recordings = [decays] if isinstance(decays, TimeRecording) else list(decays)
    used = _channels(recordings, channels)
    rate = recordings[0].sampling_rate
    parts = [
        _part(recording, used, start_time, end_time, k) for k, recording in enumerate(recordings)
    ]
    length = min(part.shape[1] for part in parts)
    values = np.concatenate([part[:, :length] for part in parts])
    if to_frequency is not None:
        step = max(1, int(rate / (_SAMPLES_PER_CYCLE * to_frequency / HERTZ)))
        for factor in _factors(step):
            values = decimate(values, factor, axis=1, zero_phase=True)
            rate /= factor
    values = values[:, :_MOST_SAMPLES]
    if values.shape[1] < _FEWEST_SAMPLES:
        raise ValueError(
            f"a decay needs {_FEWEST_SAMPLES} samples at least, but has {values.shape[1]}."
        )
    highest = min(highest_order or _HIGHEST, values.shape[1] // 8)
    orders = _realised(values, rate, highest)
    top = np.pi * rate if to_frequency is None else to_frequency
    start = _start(orders, poles, top)
    return _fitted(values, rate, start, orders, tuple(used), poles is not None)


def _channels(recordings: Sequence[TimeRecording], names: Sequence[str] | None) -> list[Channel]:
    first = recordings[0]
    for recording in recordings[1:]:
        if (
            recording.channel_names != first.channel_names
            or recording.sampling_rate != first.sampling_rate
        ):
            raise ValueError(
                "decays must share their channels and sampling rate, but have "
                f"{', '.join(recording.channel_names)} at {recording.sampling_rate:.6g} Hz and "
                f"{', '.join(first.channel_names)} at {first.sampling_rate:.6g} Hz."
            )
    if names is None:
        motions = [channel for channel in first.channels if channel.quantity in _MOTIONS]
        if not motions:
            raise ValueError(
                "a decay needs a channel that is a displacement, velocity or acceleration, but "
                f"there are {', '.join(map(str, first.channels))}."
            )
        return motions
    by_name = {channel.name: channel for channel in first.channels}
    for name in names:
        if name not in by_name:
            raise ValueError(f"there is no channel {name!r}; there are {', '.join(by_name)}.")
    return [by_name[name] for name in names]


def _part(
    recording: TimeRecording,
    channels: Sequence[Channel],
    start: float | None,
    end: float | None,
    number: int,
) -> np.ndarray:
    values = recording.values([channel.name for channel in channels])
    time = recording.time()
    if not np.isfinite(values).all():
        raise ValueError(f"decay {number + 1} has samples that are not finite.")
    if not np.any(values):
        raise ValueError(f"decay {number + 1} is zero all along.")
    if start is None:
        scaled = np.abs(values - np.median(values, axis=1, keepdims=True))
        start = float(time[np.argmax(scaled.max(axis=0))])
    last = np.inf if end is None else end
    keep = (time >= start) & (time <= last)
    if keep.sum() < _FEWEST_SAMPLES:
        raise ValueError(
            f"a decay needs {_FEWEST_SAMPLES} samples at least, but {int(keep.sum())} lie from "
            f"{start:.6g} s on in decay {number + 1}."
        )
    return values[:, keep]


def _factors(step: int) -> list[int]:
    """A thinning by steps of at most eight, as the filter wants."""
    factors = []
    while step > 1:
        factor = min(step, 8)
        factors.append(factor)
        step //= factor
    return factors


def _realised(values: np.ndarray, rate: float, highest: int) -> PoleOrders:
    """Poles of even orders from the singular vectors of a block Hankel matrix."""
    size = np.sqrt(np.mean(values**2, axis=1, keepdims=True))
    scaled = values / np.where(size > 0, size, 1.0)
    channels, samples = scaled.shape
    rows = max(min(samples // 2, max(_MOST_ROWS // channels, 4)), 4)
    columns = min(samples - rows + 1, _MOST_COLUMNS)
    windows = np.lib.stride_tricks.sliding_window_view(scaled, columns, axis=1)[:, :rows]
    hankel = windows.transpose(1, 0, 2).reshape(rows * channels, columns)
    left, singular, _ = np.linalg.svd(hankel, full_matrices=False)
    highest = max(1, min(highest, (len(singular) - channels) // 2))
    poles = []
    for half in range(1, highest + 1):
        observed = left[:, : 2 * half] * np.sqrt(singular[: 2 * half])
        step = np.linalg.lstsq(observed[:-channels], observed[channels:], rcond=None)[0]
        root = np.linalg.eigvals(step)
        root = root[(root.imag > 0) & (np.abs(root) > 0)]
        poles.append((half, np.log(root) * rate))
    return gathered(poles, highest)


def _start(
    orders: PoleOrders, poles: Sequence[float] | None, top: float
) -> Complex[np.ndarray, " mode"]:
    if poles is not None:
        wanted = np.sort(np.asarray(poles, dtype=float))
        damped = orders.pole[(orders.pole.real < 0) & (orders.damping_ratio < 0.25)]
        if not wanted.size or np.any(wanted <= 0) or np.any(wanted >= top) or not damped.size:
            raise ValueError(
                f"poles must be from 0 to {top / HERTZ:.6g} Hz, where the decay shows some, but "
                f"are {', '.join(f'{one / HERTZ:.6g}' for one in wanted) or 'none'}."
            )
        return np.array([damped[np.argmin(np.abs(np.abs(damped) - one))] for one in wanted])
    stable = clusters(orders, (0.0, top))
    stable = stable[stable.real < 0]
    if not stable.size:
        raise ValueError(
            "no pole is stable over the model orders of the decay: choose the part that decays, "
            "a lower highest frequency, or the natural frequencies by hand."
        )
    return stable


def _columns(time: np.ndarray, unknowns: np.ndarray) -> list[TermColumns]:
    n = len(unknowns) // 2
    omega, ratio = unknowns[:n], unknowns[n:]
    root = np.sqrt(1 - ratio**2)
    pole = -ratio * omega + 1j * omega * root
    wave = np.exp(time[:, None] * pole)
    by_omega = time[:, None] * wave * (pole / omega)
    by_ratio = time[:, None] * wave * (-omega - 1j * omega * ratio / root)
    columns = np.column_stack([wave.real, -wave.imag, np.ones_like(time)])
    slopes = np.zeros((2 * n, *columns.shape))
    at = np.arange(n)
    for first, slope in ((0, by_omega), (n, by_ratio)):
        slopes[first + at, :, at] = slope.real.T
        slopes[first + at, :, n + at] = -slope.imag.T
    return [TermColumns(columns, slopes)]


def _fitted(
    values: np.ndarray,
    rate: float,
    start: np.ndarray,
    orders: PoleOrders,
    channels: tuple[Channel, ...],
    keep_all: bool,
) -> DecayModes:
    time = np.arange(values.shape[1]) / rate
    unknowns = np.concatenate([np.abs(start), -start.real / np.abs(start)])
    scale = np.sqrt(np.mean(values**2, axis=1)) * 0.1
    while True:
        n = len(unknowns) // 2
        # A mode may grow a little over the record: it is then left out for that.
        growth = -np.minimum(_MOST_GROWTH / (unknowns[:n] * time[-1]), _MOST_DAMPED)
        low = np.concatenate([0.8 * unknowns[:n], growth])
        high = np.concatenate([1.25 * unknowns[:n], np.full(n, _MOST_DAMPED)])
        for _ in range(3):
            weights = np.broadcast_to(1 / scale[:, None], values.shape)
            rows = ChannelRows(values, weights, np.zeros(len(values), dtype=int), 1)
            fit = fit_separable(lambda x: _columns(time, x), rows, unknowns, (low, high))
            unknowns = fit.unknowns
            free = values.shape[1] - 2 * n - 1 - 2 * n / len(values)
            rms = np.sqrt(np.sum(fit.residuals**2, axis=1) / max(free, 1.0))
            scale = scale * np.maximum(rms, 1e-9 * max(float(rms.max()), 1e-300))
        fit = fit.with_variance(float(np.mean(rms**2)))
        amplitude = fit.coefficients[:, :n] + 1j * fit.coefficients[:, n : 2 * n]
        variance = np.stack(
            [
                np.diag(fit.term_covariance(k)) + np.diag(fit.term_covariance(n + k))
                for k in range(n)
            ]
        ).T
        certain = np.max(np.abs(amplitude) / np.sqrt(np.maximum(variance, 1e-300) / 2), axis=0)
        certain = np.where(unknowns[n:] > 0, certain, 0.0)
        worst = int(np.argmin(certain))
        if keep_all or certain[worst] >= _SIGNIFICANT:
            break
        if n == 1:
            raise ValueError("no mode of positive damping stands out of the noise of the decay.")
        unknowns = np.delete(unknowns, [worst, n + worst])
    return _result(values, time, fit, unknowns, variance / 2, orders, channels)


def _result(
    values: np.ndarray,
    time: np.ndarray,
    fit: SeparableFit,
    unknowns: np.ndarray,
    variance: np.ndarray,
    orders: PoleOrders,
    channels: tuple[Channel, ...],
) -> DecayModes:
    n = len(unknowns) // 2
    rank = np.argsort(unknowns[:n])
    covariance = np.stack([fit.covariance[np.ix_([k, n + k], [k, n + k])] for k in rank])
    n_channels = len(channels)
    amplitudes = fit.coefficients[:, :n] + 1j * fit.coefficients[:, n : 2 * n]
    fitted = fit.coefficients @ _columns(time, unknowns)[0].columns.T
    amplitude, spread = amplitudes[:n_channels, rank], np.sqrt(variance[:n_channels, rank])
    top = np.argmax(np.abs(amplitude), axis=0)
    largest = amplitude[top, np.arange(n)]
    ratio = amplitude / largest
    shape_std = np.hypot(spread, np.abs(ratio) * spread[top, np.arange(n)]) / np.abs(largest)
    shape_std[top, np.arange(n)] = 0.0
    collinearity, _ = phase_collinearity(ratio)
    notes = [
        Fact("complex_mode", mode=k + 1, frequency_hz=float(omega) / HERTZ, collinearity=value)
        for k, (omega, value) in enumerate(
            zip(unknowns[:n][rank], collinearity.tolist(), strict=True)
        )
        if value < REAL
    ]
    if not fit.status.found_minimum:
        notes.append(Fact("modal_fit_not_settled"))
    if fit.correlation.sum() > _CORRELATED:
        notes.append(Fact("decay_residuals_correlated"))
    return DecayModes(
        natural_frequency=unknowns[:n][rank],
        damping_ratio=unknowns[n:][rank],
        mode_covariance=covariance,
        collinearity=collinearity,
        orders=orders,
        sensors=channels,
        status=fit.status,
        notes=tuple(notes),
        shape=ratio.real,
        shape_std=shape_std,
        amplitude=amplitude,
        curves=DecayCurves(time, values[:n_channels], fitted[:n_channels]),
    )
