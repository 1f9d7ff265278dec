"""Resonant decay: frequency and damping against amplitude from a free decay after resonance.

The force is taken away at resonance, and the motion falls along the backbone of one mode. Three
readings of the record are offered. *peaks* fits a parabola to every extreme of the velocity and
takes times and sizes of extremes; *zero_crossings* takes times from the zeros and sizes from the
extremes between them; *hilbert* takes phase and envelope of the analytic signal, whose ends are
wrong for some cycles and are cut. Local straight lines of phase and of the logarithm of the
envelope, over a window of cycles, then give ω̃ and 2ζ̃ω̃ = −2 d(ln v)/dt + d(ln ω̃)/dt, v the
velocity of the fundamental (half the last term for that of the peak).

References: J. M. Londoño, S. A. Neild & J. E. Cooper, J. Sound Vib. 348 (2015) 224,
doi:10.1016/j.jsv.2015.03.015 (zero crossings); M. Jin, W. Chen, M. R. W. Brake & H. Song,
J. Vib. Acoust. 142 (2020) 051111 (peak finding and fitting); M. Feldman, Mech. Syst. Signal
Process. 8 (1994) 119, doi:10.1006/mssp.1994.1011 (Hilbert transform).
"""

import itertools
from typing import Literal, NamedTuple, get_args

import numpy as np
from jaxtyping import Float

from snrmjax.measure.decays.decay_record import (
    QUARTER,
    even_record,
    require_cycles,
    require_samples,
)
from snrmjax.measure.decays.isolated_decay import IsolatedDecay
from snrmjax.methods.result import MethodPoint, MethodResult, method_result, points_of_curves
from snrmjax.numerics.facts import Fact

Reading = Literal["peaks", "zero_crossings", "hilbert"]

_WINDOW = (2.5, 8.0)  # cycles that a local line spans: those of a fall to a quarter, if so many
_HILBERT_ENDS = 4  # cycles at each end at which the analytic signal is wrong
_MIRRORED = 3  # a part of the record, 1/3, is mirrored at each of its ends
_FILTER_ENDS = 8.0  # times 1/width (s), after which the filter has settled to e^(−19)
_FILTER_ORDER = 4
_MEDIAN_OF_NORMAL = 0.6745  # of the absolute value, over 1σ


class _Trace(NamedTuple):
    """Phase and logarithm of the velocity's amplitude at some times."""

    time: Float[np.ndarray, " k"]  # s
    phase: Float[np.ndarray, " k"]  # rad, rising
    log_amplitude: Float[np.ndarray, " k"]  # of m/s
    per_cycle: float  # entries a cycle


def resonant_decay(
    time: Float[np.ndarray, " sample"],
    velocity: Float[np.ndarray, " sample"],
    *,
    reading: Reading = "peaks",
    band: tuple[float, float] | None = None,
    window: float | None = None,
    least_amplitude: float = 0.0,
) -> MethodResult:
    """Natural frequency and damping against velocity along a free decay of one mode.

    Arguments: `time` in s, evenly spaced; `velocity` in m/s, from the moment on at which the force
    was gone; `reading` says how phase and amplitude are read; `band`, two frequencies in Hz, is
    passed by a Butterworth filter of order 4 run forwards and backwards (no phase shift; its
    ends are cut); `window` is how many cycles a local straight line spans, by default eight, or
    those in which a heavily damped motion falls to a quarter; the record is read down to
    `least_amplitude` (m/s), where noise takes over.
    Returns a `MethodResult` with a point every half window: the velocity is that of the peak, by
    *hilbert* and with a `band` without harmonics that of the fundamental; 1σ from how far the
    windows scatter about one another, growing as the amplitude falls. Where a line rises (the
    mode gains energy) the point is `NOT_A_MODE`. What a filter does to frequency and damping is
    estimated by filtering the decay that was read once more; a note states it, and 1σ holds it.
    Raises `ValueError` for uneven times, a rate below eight samples a cycle, fewer than twelve
    cycles (five where the motion falls to a quarter), a clipped record and numbers that are not
    finite.
    Validity: one mode (with others beside it `isolate_decay` and `decay_of_mode`), light damping,
    nothing driving; a filter as narrow as the frequency moves within its memory smooths both
    curves more than the note says.
    """
    times, signal = checked_record(time, velocity)
    if reading not in get_args(Reading):
        raise ValueError(f"`reading` must be one of {get_args(Reading)}, but is {reading!r}.")
    step = float(np.mean(np.diff(times)))
    whole, settled = times, slice(None)
    if band is not None:
        signal, settled = _filtered(signal, step, band)
        times, signal = times[settled], signal[settled]
    trace = _TRACES[reading](times, signal)
    kept = trace.log_amplitude >= np.log(max(least_amplitude, np.finfo(float).tiny))
    # The first time that it falls below: what comes after is noise.
    end = len(kept) if kept.all() else int(np.argmin(kept))
    window = _window(trace, end) if window is None else window
    lines = _local_lines(trace, end, window)
    bias = np.zeros_like(lines)
    notes = [Fact("decay_read_by", reading=reading)]
    if band is not None:
        # The decay that was read, read with and without the filter: nothing else differs.
        decay = _fitted_decay(lines, whole)
        with_filter, without = (
            _at_times(_local_lines(_TRACES[reading](times, record[settled]), None, window), lines)
            for record in (_filtered(decay, step, band)[0], decay)
        )
        bias = with_filter - without
        notes.append(_of_bias(bias, lines))
    fundamental = band is not None or reading == "hilbert"
    return method_result("resonant_decay", _points(lines, bias, fundamental), 0, notes)


def decay_of_mode(decay: IsolatedDecay) -> MethodResult:
    """Natural frequency and damping against velocity along a mode's decay apart from its company.

    Argument: what `isolate_decay` gives. Returns a `MethodResult` as `resonant_decay` does, of
    points four cycles apart; the velocity is that of the fundamental. 1σ holds noise, company and
    scatter inside the filter's band, and what the error of the amplitude makes of curves over it.
    """
    omega, slope, smooth = decay.rate.imag, decay.rate.real, decay.smooth_rate
    moves = decay.smooth_bend.imag / smooth.imag
    shrinks = moves - smooth.real
    squared = shrinks**2 + np.gradient(shrinks, decay.at) - shrinks * moves
    natural = np.sqrt(np.maximum(omega**2 + squared, 0.0))
    ratio = (moves / 2 - slope) / natural
    # What a relative error of the amplitude moves, along the smooth decay.
    along_omega = decay.smooth_bend.imag / smooth.real
    along_ratio = np.gradient((moves / 2 - smooth.real) / smooth.imag, decay.level.real)
    points = points_of_curves(
        np.exp(decay.level.real),
        natural,
        np.hypot(decay.rate_std.imag, along_omega * decay.level_std),
        ratio,
        np.hypot(decay.rate_std.real / natural, along_ratio * decay.level_std),
    )
    apart = float(np.max(np.abs(moves / 2 / smooth.real)))
    notes = [
        Fact("decay_read_by", reading="a filter that moves with it"),
        Fact("decrement_apart", fraction=apart),
    ]
    return method_result("resonant_decay", points, 0, notes)


def checked_record(
    time: Float[np.ndarray, " sample"], velocity: Float[np.ndarray, " sample"]
) -> tuple[Float[np.ndarray, " sample"], Float[np.ndarray, " sample"]]:
    """A record of one channel as arrays. Raises `ValueError` where no method can read it."""
    times, signal = even_record(time, velocity)
    signal = signal - signal.mean()
    ups = np.count_nonzero((signal[:-1] < 0) & (signal[1:] >= 0))
    require_cycles(signal, float(ups))
    require_samples(len(signal) / ups, ", or noise crosses zero (state `band`)")
    return times, signal


def _filtered(
    signal: np.ndarray, step: float, band: tuple[float, float]
) -> tuple[np.ndarray, slice]:
    """The band-passed record, and where its ends have settled."""
    from scipy.signal import butter, sosfiltfilt

    low, high = band
    if not 0 < low < high < 0.5 / step:
        raise ValueError(
            f"`band` must rise between 0 and half the sampling rate, {0.5 / step:.4g} Hz, but is "
            f"{low:g} to {high:g} Hz."
        )
    sections = butter(_FILTER_ORDER, band, "bandpass", fs=1 / step, output="sos")
    ends = int(np.ceil(_FILTER_ENDS / ((high - low) * step)))
    if 3 * ends > len(signal):
        raise ValueError(
            f"a band of {high - low:g} Hz spoils {ends * step:.3g} s at each end, "
            f"but the record has {len(signal) * step:.3g} s: widen the band."
        )
    return sosfiltfilt(sections, signal), slice(ends, len(signal) - ends)


def velocity_extremes(time: np.ndarray, signal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Times and sizes of the largest |velocity| between zeros, by parabolas."""
    crossings = np.flatnonzero(np.signbit(signal[:-1]) != np.signbit(signal[1:])) + 1
    size = np.abs(signal)
    rows = [
        start + int(np.argmax(size[start:stop])) for start, stop in itertools.pairwise(crossings)
    ]
    middle = np.array([k for k in rows if 0 < k < len(signal) - 1])
    before, at, after = size[middle - 1], size[middle], size[middle + 1]
    curvature = before - 2 * at + after
    shift = np.where(curvature < 0, 0.5 * (before - after) / np.where(curvature, curvature, 1), 0)
    step = time[1] - time[0]
    return time[middle] + shift * step, at - 0.25 * (before - after) * shift


def _of_neighbours(values: np.ndarray) -> np.ndarray:
    """Means of neighbours, upper and lower half: an offset of the record moves both apart."""
    return (values[1:] + values[:-1]) / 2


def _by_peaks(time: np.ndarray, signal: np.ndarray) -> _Trace:
    at, size = velocity_extremes(time, signal)
    at, log_size = _of_neighbours(at), np.log(_of_neighbours(size))
    return _Trace(at, np.pi * np.arange(len(at)), log_size, 2.0)


def _by_zero_crossings(time: np.ndarray, signal: np.ndarray) -> _Trace:
    before = np.flatnonzero(np.signbit(signal[:-1]) != np.signbit(signal[1:]))
    fraction = signal[before] / (signal[before] - signal[before + 1])
    zeros = time[before] + fraction * (time[before + 1] - time[before])
    zeros = _of_neighbours(zeros)
    peaks, size = velocity_extremes(time, signal)
    peaks = _of_neighbours(peaks)
    log_size = np.interp(zeros, peaks, np.log(_of_neighbours(size)))
    inside = (zeros >= peaks[0]) & (zeros <= peaks[-1])
    return _Trace(zeros[inside], np.pi * np.arange(inside.sum()), log_size[inside], 2.0)


def _by_hilbert(time: np.ndarray, signal: np.ndarray) -> _Trace:
    from scipy.signal import hilbert

    # Mirrored through zeros at both ends the motion goes on without a jump.
    zeros = np.flatnonzero(np.signbit(signal[:-1]) != np.signbit(signal[1:]))
    time, signal = time[zeros[0] : zeros[-1] + 2], signal[zeros[0] : zeros[-1] + 2]
    beyond = len(signal) // _MIRRORED
    mirrored = np.pad(signal, beyond, mode="reflect", reflect_type="odd")
    analytic = hilbert(mirrored)[beyond : beyond + len(signal)]
    phase = np.unwrap(np.angle(analytic))
    per_cycle = 2 * np.pi * len(time) / (phase[-1] - phase[0])
    cut = int(np.ceil(_HILBERT_ENDS * per_cycle))
    inside = slice(cut, len(time) - cut)
    return _Trace(time[inside], phase[inside], np.log(np.abs(analytic[inside])), per_cycle)


_TRACES = {"peaks": _by_peaks, "zero_crossings": _by_zero_crossings, "hilbert": _by_hilbert}


# Columns of local lines.
_TIME, _PHASE, _LEVEL, _OMEGA, _SLOPE = range(5)
_SWING = 5  # lines over which a filter's error swings
_ENDS = (slice(0, 4), slice(-4, None))


def _window(trace: _Trace, end: int) -> float:
    """How many cycles a local line spans."""
    last = min(end, len(trace.time)) - 1
    fall = trace.log_amplitude[0] - trace.log_amplitude[last] if last > 0 else 0.0
    cycles = last / trace.per_cycle
    of_fall = QUARTER * cycles / fall if fall > 0 else np.inf
    return float(np.clip(min(of_fall, cycles), *_WINDOW))


def _local_lines(trace: _Trace, end: int | None, window: float) -> Float[np.ndarray, "line 5"]:
    """A straight line of phase and of log amplitude over every half window.

    Columns: time of the middle, phase and log amplitude there, and their slopes.
    """
    width = max(4, round(window * trace.per_cycle))
    end = len(trace.time) if end is None else end
    if end < width:
        raise ValueError(
            f"{window:g} cycles above the least amplitude are needed, but the record has "
            f"{end / trace.per_cycle:.3g}."
        )
    starts = np.arange(0, end - width + 1, max(1, width // 2))
    return _straightened(np.array([_line(trace, slice(start, start + width)) for start in starts]))


def _straightened(lines: Float[np.ndarray, "line 5"]) -> Float[np.ndarray, "line 5"]:
    """Without what a third derivative does to slopes: h²/10 of it, h half the window.

    Lines are h apart, so that their second differences are h² times it.
    """
    if len(lines) < 3:
        return lines
    bend = np.diff(lines, 2, axis=0)
    bend = np.concatenate([bend[:1], bend, bend[-1:]])
    straight = lines.copy()
    for slope in (_OMEGA, _SLOPE):
        straight[:, slope] -= bend[:, slope] / 10
    return straight


def _line(trace: _Trace, part: slice) -> tuple[float, float, float, float, float]:
    """One local line; a curvature is fitted beside each slope, which it does not move."""
    middle = float(trace.time[part].mean())
    away = trace.time[part] - middle
    _, omega, phase = np.polyfit(away, trace.phase[part], 2)
    decay = np.polyfit(away, trace.log_amplitude[part], 2)[1]
    level = trace.log_amplitude[part].mean()
    return middle, float(phase), float(level), float(omega), float(decay)


def _points(
    lines: Float[np.ndarray, "line 5"], bias: Float[np.ndarray, "line 5"], fundamental: bool
) -> list[MethodPoint]:
    """Points of local lines.

    The action v²/ω̃ of a mode decays by 2ζ̃ω̃, v the velocity of its fundamental; a peak has the
    energy ½v², which is the integral of ω̃ over the action. A displacement e^{∫(−δ + iω)dt} obeys
    the equation of motion with ω̃² = ω² + δ² + dδ/dt − δ (dω/dt)/ω.
    """
    from scipy.ndimage import maximum_filter1d

    speed, omega, decay = np.exp(lines[:, _LEVEL]), lines[:, _OMEGA], lines[:, _SLOPE]
    if len(lines) > 1:
        moves = np.gradient(np.log(omega), lines[:, _TIME])
        shrinks = moves - decay
        squared = shrinks**2 + np.gradient(shrinks, lines[:, _TIME]) - shrinks * moves
        decay = decay - moves * (0.5 if fundamental else 0.25)
        omega = np.sqrt(np.maximum(omega**2 + squared, 0.0))
    # At the ends a filter's error swings from line to line: its size around each counts.
    bias = maximum_filter1d(np.abs(bias), _SWING, axis=0)
    omega_std = np.hypot(_scatter(omega, speed), bias[:, _OMEGA])
    decay_std = np.hypot(_scatter(decay, speed), bias[:, _SLOPE])
    return points_of_curves(speed, omega, omega_std, -decay / omega, decay_std / omega)


def _fitted_decay(
    lines: Float[np.ndarray, "line 5"], time: Float[np.ndarray, " sample"]
) -> Float[np.ndarray, " sample"]:
    """The decay that local lines say; beyond the first and last their slopes go on as there."""
    from scipy.interpolate import CubicHermiteSpline

    if len(lines) < 2:
        away = time - lines[0, _TIME]
        level = lines[0, _LEVEL] + lines[0, _SLOPE] * away
        return np.exp(level) * np.cos(lines[0, _PHASE] + lines[0, _OMEGA] * away)
    ends = lines[0, _TIME], lines[-1, _TIME]
    inside = np.clip(time, *ends)
    beyond = time - inside
    late = beyond > 0

    def along(value: int, slope: int) -> Float[np.ndarray, " sample"]:
        curve = CubicHermiteSpline(lines[:, _TIME], lines[:, value], lines[:, slope])
        near = [np.polyfit(lines[rows, _TIME], lines[rows, slope], 1)[0] for rows in _ENDS]
        rate = np.where(late, lines[-1, slope], lines[0, slope])
        return curve(inside) + beyond * rate + beyond**2 / 2 * np.where(late, near[1], near[0])

    return np.exp(along(_LEVEL, _SLOPE)) * np.cos(along(_PHASE, _OMEGA))


def _at_times(
    lines: Float[np.ndarray, "line 5"], wanted: Float[np.ndarray, "line 5"]
) -> Float[np.ndarray, "line 5"]:
    """Lines of another reading at the times of `wanted`."""
    return np.stack(
        [np.interp(wanted[:, _TIME], lines[:, _TIME], column) for column in lines.T], axis=1
    )


def _of_bias(bias: Float[np.ndarray, "line 5"], lines: Float[np.ndarray, "line 5"]) -> Fact:
    omega = np.abs(bias[:, _OMEGA] / lines[:, _OMEGA]).max()
    decay = np.abs(bias[:, _SLOPE] / lines[:, _SLOPE]).max()
    return Fact("bias_of_filter", frequency=omega, damping=decay)


def _scatter(values: np.ndarray, amplitude: np.ndarray) -> np.ndarray:
    """1σ of values from how far windows that do not overlap are off their neighbours' mean.

    Noise of a record weighs as the inverse of the amplitude. NaN where there are too few windows.
    """
    bend = values[:-4] - 2 * values[2:-2] + values[4:]
    if not bend.size:
        return np.full(len(values), np.nan)
    size = np.median(np.abs(bend * amplitude[2:-2])) / (_MEDIAN_OF_NORMAL * np.sqrt(6))
    return size / amplitude
