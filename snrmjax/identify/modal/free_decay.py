"""Linear modes from free decays: eigensystem realisation, then a fit of decaying oscillations.

y_i(t) = Σ_r e^(−ζωt) (a cos ω_d t + b sin ω_d t) + c. A decay has no force: frequencies, damping
and relative shapes are identified, without a scale.
Reference: Juang & Pappa, J. Guid. Control Dyn. 8 (1985) 620, doi:10.2514/3.20031.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float
from scipy.signal import decimate

from snrmjax.identify.modal.decay_fit import (
    DecayFit,
    WaveForm,
    fit_waves,
    significant,
    with_modes,
    without_mode,
)
from snrmjax.identify.modal.modal_fit import REAL, AbstractModalFit, phase_collinearity
from snrmjax.identify.modal.pole_orders import LIGHTLY_DAMPED, PoleOrders, clusters, gathered
from snrmjax.identify.modal.response_data import POWERS
from snrmjax.identify.modal.small_motion import (
    PartFit,
    envelope,
    frequency_at,
    is_linear,
    noise_of_channels,
    nonlinear_before_last_part,
    parts_of_decay,
    small_motion,
)
from snrmjax.measure.recordings.channels import Channel
from snrmjax.measure.recordings.time_recording import TimeRecording
from snrmjax.numerics.compiled import on_numbers
from snrmjax.numerics.facts import Fact
from snrmjax.numerics.result import quantity
from snrmjax.numerics.rules import InputError
from snrmjax.numerics.units import HERTZ

_HIGHEST = 30  # half the model order
_MOST_ROWS, _MOST_COLUMNS = 240, 3000  # of a Hankel matrix
_MOST_SAMPLES = 40_000  # of a channel, in the fit
_FEWEST_SAMPLES = 40
_SAMPLES_PER_CYCLE = 5  # kept per cycle of the highest requested frequency
_LONG = 12_000  # samples of a channel, above which a record is cut and decimated to its content
_SAMPLES_OF_LINE = 3  # kept per cycle of the highest line: the filter passes 0.8 of half the rate
_ABOVE = 30.0  # times the median power of a spectrum, exceeded by noise once in 1e9 lines
_FILTER_ENDS = 20  # samples affected by a decimation filter
_BEYOND = 1.3  # times the duration in which the motion exceeds the noise
_NOTHING = "no mode of positive damping stands out of the noise of the decay."
_FEW_MODES = 6  # in the test of a record for linearity
_CORRELATED = 2.0  # sum of the correlations of residuals that gives a note


class DecayCurves(NamedTuple):
    """Recorded and fitted signals, SI."""

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
    progress: Callable[[int, int], None] | None = None,
) -> DecayModes:
    """Frequencies, damping ratios and relative shapes from free decays, with covariance.

    Poles of all orders of an eigensystem realisation start a least-squares fit of decaying
    oscillations to all channels and decays together, the strongest first; the rms of each
    channel's residuals and the correlation of neighbouring ones give the errors. If frequency or
    damping of the strongest mode change with its amplitude, that change is fitted too, and the
    modes are those at zero amplitude (see `small_motion`).

    Arguments: one recording or several of the same channels and rate; `channels` by name, by
    default all motions; `start_time`, `end_time` s of the part to use (from the largest value, to
    the end); `to_frequency` rad/s the highest of interest, to which long records are low-passed and
    decimated; `poles` natural frequencies in rad/s in place of clusters; `progress` is called with
    the number of fitted parts and their total.
    Raises `ValueError` for recordings that differ in channels or rate, no motion, fewer than 40
    samples, zero signals, no stable pole, and for a mode that still changes with its amplitude
    where the record ends or disappears in noise.
    Validity: no force acts on the structure in that part.
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
    samples, highest_line = _SAMPLES_PER_CYCLE, to_frequency
    if highest_line is None and values.shape[1] > _LONG:
        values = _above_noise(values, rate)
        samples, highest_line = _SAMPLES_OF_LINE, _highest_line(values, rate)
    if highest_line is not None:
        step = max(1, int(rate / (samples * highest_line / HERTZ)))
        for factor in _factors(step):
            values = decimate(values, factor, axis=1, zero_phase=True)
            rate /= factor
            # Near the ends the filter has data on one side only.
            values = values[:, _FILTER_ENDS:-_FILTER_ENDS]
    values = values[:, :_MOST_SAMPLES]
    if values.shape[1] < _FEWEST_SAMPLES:
        raise InputError(
            f"a decay needs {_FEWEST_SAMPLES} samples at least, but has {values.shape[1]}."
        )
    highest = min(highest_order or _HIGHEST, values.shape[1] // 8)
    orders = _realised(values, rate, highest)
    top = np.pi * rate if to_frequency is None else to_frequency
    modes = _decay_modes(values, rate, orders, top, poles, progress)
    return _result(values, rate, modes, orders, tuple(used))


def _channels(recordings: Sequence[TimeRecording], names: Sequence[str] | None) -> list[Channel]:
    first = recordings[0]
    for recording in recordings[1:]:
        if (
            recording.channel_names != first.channel_names
            or recording.sampling_rate != first.sampling_rate
        ):
            raise InputError(
                "decays must share their channels and sampling rate, but have "
                f"{', '.join(recording.channel_names)} at {recording.sampling_rate:.6g} Hz and "
                f"{', '.join(first.channel_names)} at {first.sampling_rate:.6g} Hz."
            )
    if names is None:
        motions = [channel for channel in first.channels if channel.quantity in POWERS]
        if not motions:
            raise InputError(
                "a decay needs a channel that is a displacement, velocity or acceleration, but "
                f"there are {', '.join(map(str, first.channels))}."
            )
        return motions
    by_name = {channel.name: channel for channel in first.channels}
    for name in names:
        if name not in by_name:
            raise InputError(f"there is no channel {name!r}; there are {', '.join(by_name)}.")
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
        raise InputError(f"decay {number + 1} has samples that are not finite.")
    if not np.any(values):
        raise InputError(f"decay {number + 1} is zero throughout.")
    if start is None:
        scaled = np.abs(values - np.median(values, axis=1, keepdims=True))
        start = float(time[np.argmax(scaled.max(axis=0))])
    last = np.inf if end is None else end
    keep = (time >= start) & (time <= last)
    if keep.sum() < _FEWEST_SAMPLES:
        raise InputError(
            f"a decay needs {_FEWEST_SAMPLES} samples at least, but {int(keep.sum())} lie from "
            f"{start:.6g} s on in decay {number + 1}."
        )
    return values[:, keep]


def _above_noise(values: np.ndarray, rate: float) -> np.ndarray:
    """The record up to slightly after the motion falls below the noise of a sample."""
    amplitude, _ = envelope(values, noise_of_channels(values), rate)
    end = int(_BEYOND * np.count_nonzero(amplitude > 1.0))
    return values[:, : max(end, _FEWEST_SAMPLES)]


def _highest_line(values: np.ndarray, rate: float) -> float:
    """The highest frequency in rad/s above the noise."""
    window = np.hanning(values.shape[1])
    away = values - values.mean(axis=1, keepdims=True)
    power = np.abs(np.fft.rfft(away * window, axis=1)) ** 2
    above = power > _ABOVE * np.median(power, axis=1, keepdims=True)
    last = np.flatnonzero(above.any(axis=0))
    return float(HERTZ * rate * (last[-1] if last.size else power.shape[1]) / values.shape[1])


def _factors(step: int) -> list[int]:
    """Factors of at most eight for a decimation in stages."""
    factors = []
    while step > 1:
        factor = min(step, 8)
        factors.append(factor)
        step //= factor
    return factors


def _realised(values: np.ndarray, rate: float, highest: int) -> PoleOrders:
    """Poles of even orders from the singular vectors of a block Hankel matrix."""
    rms = np.sqrt(np.mean(values**2, axis=1, keepdims=True))
    scaled = values / np.where(rms > 0, rms, 1.0)
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
        damped = orders.pole[(orders.pole.real < 0) & (orders.damping_ratio < LIGHTLY_DAMPED)]
        if not wanted.size or np.any(wanted <= 0) or np.any(wanted >= top) or not damped.size:
            raise InputError(
                f"poles must be from 0 to {top / HERTZ:.6g} Hz, where the decay has some, but "
                f"are {', '.join(f'{one / HERTZ:.6g}' for one in wanted) or 'none'}."
            )
        return np.array([damped[np.argmin(np.abs(np.abs(damped) - one))] for one in wanted])
    stable = clusters(orders, (0.0, top))
    stable = stable[stable.real < 0]
    if not stable.size:
        raise InputError(
            "no pole is stable over the model orders of the decay: choose the part that decays, "
            "a lower highest frequency, or the natural frequencies by hand."
        )
    return stable


class AcceptedModes(NamedTuple):
    """The fit, its accepted modes and its first sample."""

    decay: DecayFit
    kept: np.ndarray
    first: int = 0
    spread: np.ndarray = np.zeros((2, 1))  # additional 1σ of ω and ζ of the modes
    notes: tuple[Fact, ...] = ()


def _decay_modes(
    values: np.ndarray,
    rate: float,
    orders: PoleOrders,
    top: float,
    poles: Sequence[float] | None,
    progress: Callable[[int, int], None] | None,
) -> AcceptedModes:
    """The modes of the whole record, or at zero amplitude if they depend on it."""
    start = _start(orders, poles, top)
    time, noise = np.arange(values.shape[1]) / rate, noise_of_channels(values)

    def candidates(part: np.ndarray) -> list[complex]:
        highest = min(orders.highest, part.shape[1] // 8)
        stable = clusters(_realised(part, rate, highest), (0.0, top))
        return [complex(pole) for pole in stable if pole.real < 0]

    if poles is None:
        few = with_modes(values, time, start, most=_FEW_MODES)
    else:
        unknowns = np.concatenate([np.abs(start), -start.real / np.abs(start)])
        few = fit_waves(values, time, unknowns, WaveForm(len(start)))
    parts: list[PartFit] = []
    if few is not None and not is_linear(values, time, few, noise):
        parts = parts_of_decay(values, rate, candidates, noise, progress)
    if parts and any(part.depends_on_amplitude for part in parts):
        return _amplitude_dependent(parts, values, rate)
    fit = few if poles is not None else with_modes(values, time, start, few)
    if fit is None:
        raise InputError(_NOTHING)
    if poles is not None:
        return AcceptedModes(fit, np.ones(fit.form.n_modes, dtype=bool))
    if parts and nonlinear_before_last_part(parts, fit, noise):
        return _amplitude_dependent(parts, values, rate)
    kept = significant(fit)
    while not kept.all() and fit.form.n_modes > 1:
        fit = without_mode(values, time, fit, int(np.flatnonzero(~kept)[0]))
        kept = significant(fit)
    kept &= fit.damping_ratio > 0
    if not kept.any():
        raise InputError(_NOTHING)
    return AcceptedModes(fit, kept)


def _amplitude_dependent(parts: list[PartFit], values: np.ndarray, rate: float) -> AcceptedModes:
    chosen, kept = small_motion(parts, values, rate)
    fit = chosen.fitted
    omega = fit.natural_frequency[fit.form.leading]
    note = Fact(
        "decay_moves_with_amplitude",
        frequency_hz=float(omega) / HERTZ,
        begin=chosen.first / rate,
        from_hz=frequency_at(values, chosen.first, rate, float(omega)),
        powers=fit.form.powers,
    )
    return AcceptedModes(fit, kept, chosen.first, chosen.spread, (note,))


def _result(
    values: np.ndarray,
    rate: float,
    modes: AcceptedModes,
    orders: PoleOrders,
    channels: tuple[Channel, ...],
) -> DecayModes:
    fit, unknowns, n = modes.decay.fit, modes.decay.unknowns, modes.decay.form.n_modes
    kept = np.flatnonzero(modes.kept)
    rank = kept[np.argsort(unknowns[kept])]
    covariance = np.stack([fit.covariance[np.ix_([k, n + k], [k, n + k])] for k in rank])
    spread = np.broadcast_to(modes.spread, (2, n))[:, rank].T
    covariance[:, (0, 1), (0, 1)] += spread**2
    n_channels = len(channels)
    values = values[:, modes.first :]
    time = np.arange(values.shape[1]) / rate
    fitted = values - modes.decay.residuals
    amplitude = modes.decay.amplitude[:n_channels, rank]
    amplitude_std = modes.decay.amplitude_std[:n_channels, rank]
    top = np.argmax(np.abs(amplitude), axis=0)
    n = len(rank)
    largest = amplitude[top, np.arange(n)]
    ratio = amplitude / largest
    shape_std = np.hypot(amplitude_std, np.abs(ratio) * amplitude_std[top, np.arange(n)])
    shape_std /= np.abs(largest)
    shape_std[top, np.arange(n)] = 0.0
    collinearity, _ = phase_collinearity(ratio)
    notes = list(modes.notes) + [
        Fact("complex_mode", mode=k + 1, frequency_hz=float(omega) / HERTZ, collinearity=value)
        for k, (omega, value) in enumerate(zip(unknowns[rank], collinearity.tolist(), strict=True))
        if value < REAL
    ]
    if not fit.status.found_minimum:
        notes.append(Fact("modal_fit_not_settled"))
    if fit.correlation.sum() > _CORRELATED:
        notes.append(Fact("decay_residuals_correlated"))
    return DecayModes(
        natural_frequency=unknowns[rank],
        damping_ratio=modes.decay.damping_ratio[rank],
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
