"""Resonant decay: frequency and damping against amplitude from a free decay after resonance.

The force is removed at resonance, and the motion decays along the backbone of one mode. There are
three readings of the record. *peaks* fits a parabola to every extreme of the velocity for its time
and amplitude; *zero_crossings* takes times from the zeros and amplitudes from the extremes between
them; *hilbert* takes phase and envelope of the analytic signal, without some cycles of end effects.
Local straight lines of phase and log envelope, over a window of cycles, then give ω̃ and
2ζ̃ω̃ = −2 d(ln v)/dt + d(ln ω̃)/dt with the fundamental velocity v (half the last term for the peak
velocity).

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
from snrmjax.numerics.rules import InputError

Reading = Literal["peaks", "zero_crossings", "hilbert"]

_WINDOW = (2.5, 8.0)  # range of the cycles of a local line, by default those of a decay to 1/4
_HILBERT_ENDS = 4  # cycles of end effects of the analytic signal
_MIRRORED = 3  # 1/3 of the record is mirrored at each end
_FILTER_ENDS = 8.0  # times 1/bandwidth (s): the filter has settled to e^(−19)
_FILTER_ORDER = 4
_MEDIAN_OF_NORMAL = 0.6745  # median |x| of a normal variable over its 1σ


class _Envelope(NamedTuple):
    """Phase and log amplitude of the velocity at some times."""

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

    Arguments: `time` in s, evenly spaced; `velocity` in m/s, from the removal of the force on;
    `reading` is how phase and amplitude are determined; `band`, two frequencies in Hz, sets a
    zero-phase Butterworth filter of order 4 (forwards and backwards, its ends are cut); `window`
    is the number of cycles of a local straight line, by default eight, or those of a decay to a
    quarter if fewer; the record is used down to `least_amplitude` (m/s), the noise level.
    Returns a `MethodResult` with a point every half window: the velocity is that of the peak, for
    *hilbert* and with a `band` without harmonics that of the fundamental; 1σ is from the scatter
    between windows, increasing as the amplitude decreases. Where the amplitude rises (the mode
    gains energy) the point is `NOT_A_MODE`. The filter's bias of frequency and damping is
    estimated by filtering the identified decay again; a note states it, and 1σ includes it.
    Raises `ValueError` for uneven times, a rate below eight samples a cycle, fewer than twelve
    cycles (five where the motion falls to a quarter), a clipped record and numbers that are not
    finite.
    Validity: one mode (in a record of several use `isolate_decay` and `decay_of_mode`), light
    damping, no force; a filter whose impulse response lasts while the frequency changes by its
    bandwidth smooths both curves more than the note states.
    """
    times, signal = checked_record(time, velocity)
    if reading not in get_args(Reading):
        raise InputError(f"`reading` must be one of {get_args(Reading)}, but is {reading!r}.")
    step = float(np.mean(np.diff(times)))
    whole, settled = times, slice(None)
    if band is not None:
        signal, settled = _filtered(signal, step, band)
        times, signal = times[settled], signal[settled]
    envelope = _ENVELOPES[reading](times, signal)
    kept = envelope.log_amplitude >= np.log(max(least_amplitude, np.finfo(float).tiny))
    # After the first time below it the record is noise.
    end = len(kept) if kept.all() else int(np.argmin(kept))
    window = _window(envelope, end) if window is None else window
    lines = _local_lines(envelope, end, window)
    bias = np.zeros_like(lines)
    notes = [Fact("decay_read_by", reading=reading)]
    if band is not None:
        # The identified decay, read with and without the filter: the difference is the bias.
        decay = _fitted_decay(lines, whole)
        with_filter, without = (
            _interpolated_lines(
                _local_lines(_ENVELOPES[reading](times, record[settled]), None, window), lines
            )
            for record in (_filtered(decay, step, band)[0], decay)
        )
        bias = with_filter - without
        notes.append(_bias_note(bias, lines))
    fundamental = band is not None or reading == "hilbert"
    return method_result("resonant_decay", _points(lines, bias, fundamental), 0, notes)


def decay_of_mode(decay: IsolatedDecay) -> MethodResult:
    """Natural frequency and damping against velocity along the decay of an isolated mode.

    Argument: the result of `isolate_decay`. Returns a `MethodResult` as `resonant_decay` does, of
    points four cycles apart; the velocity is that of the fundamental. 1σ includes noise,
    interfering modes and scatter inside the filter's band, and the amplitude error times the
    slopes of the curves.
    """
    omega, slope, smooth = decay.rate.imag, decay.rate.real, decay.smooth_rate
    frequency_rate = decay.smooth_bend.imag / smooth.imag
    displacement_rate = frequency_rate - smooth.real
    squared = (
        displacement_rate**2
        + np.gradient(displacement_rate, decay.at)
        - displacement_rate * frequency_rate
    )
    natural = np.sqrt(np.maximum(omega**2 + squared, 0.0))
    ratio = (frequency_rate / 2 - slope) / natural
    # Slopes of both curves over the log amplitude, along the smooth decay.
    along_omega = decay.smooth_bend.imag / smooth.real
    along_ratio = np.gradient((frequency_rate / 2 - smooth.real) / smooth.imag, decay.level.real)
    points = points_of_curves(
        np.exp(decay.level.real),
        natural,
        np.hypot(decay.rate_std.imag, along_omega * decay.level_std),
        ratio,
        np.hypot(decay.rate_std.real / natural, along_ratio * decay.level_std),
    )
    apart = float(np.max(np.abs(frequency_rate / 2 / smooth.real)))
    notes = [
        Fact("decay_read_by", reading="a filter that moves with it"),
        Fact("decrement_apart", fraction=apart),
    ]
    return method_result("resonant_decay", points, 0, notes)


def checked_record(
    time: Float[np.ndarray, " sample"], velocity: Float[np.ndarray, " sample"]
) -> tuple[Float[np.ndarray, " sample"], Float[np.ndarray, " sample"]]:
    """A record of one channel as arrays. Raises `ValueError` where no method can use it."""
    times, signal = even_record(time, velocity)
    signal = signal - signal.mean()
    ups = np.count_nonzero((signal[:-1] < 0) & (signal[1:] >= 0))
    require_cycles(signal, float(ups))
    require_samples(len(signal) / ups, ", or noise crosses zero (state `band`)")
    return times, signal


def _filtered(
    signal: np.ndarray, step: float, band: tuple[float, float]
) -> tuple[np.ndarray, slice]:
    """The band-passed record, and its part without end effects."""
    from scipy.signal import butter, sosfiltfilt

    low, high = band
    if not 0 < low < high < 0.5 / step:
        raise InputError(
            f"`band` must rise between 0 and half the sampling rate, {0.5 / step:.4g} Hz, but is "
            f"{low:g} to {high:g} Hz."
        )
    sections = butter(_FILTER_ORDER, band, "bandpass", fs=1 / step, output="sos")
    ends = int(np.ceil(_FILTER_ENDS / ((high - low) * step)))
    if 3 * ends > len(signal):
        raise InputError(
            f"a band of {high - low:g} Hz takes {ends * step:.3g} s to settle at each end, "
            f"but the record has {len(signal) * step:.3g} s: widen the band."
        )
    return sosfiltfilt(sections, signal), slice(ends, len(signal) - ends)


def velocity_extremes(time: np.ndarray, signal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Times and amplitudes of the largest |velocity| between zeros, by parabolas."""
    crossings = np.flatnonzero(np.signbit(signal[:-1]) != np.signbit(signal[1:])) + 1
    magnitude = np.abs(signal)
    rows = [
        start + int(np.argmax(magnitude[start:stop]))
        for start, stop in itertools.pairwise(crossings)
    ]
    middle = np.array([k for k in rows if 0 < k < len(signal) - 1])
    before, at, after = magnitude[middle - 1], magnitude[middle], magnitude[middle + 1]
    curvature = before - 2 * at + after
    shift = np.where(curvature < 0, 0.5 * (before - after) / np.where(curvature, curvature, 1), 0)
    step = time[1] - time[0]
    return time[middle] + shift * step, at - 0.25 * (before - after) * shift


def _of_neighbours(values: np.ndarray) -> np.ndarray:
    """Means of neighbours, a positive and a negative extreme: an offset cancels."""
    return (values[1:] + values[:-1]) / 2


def _by_peaks(time: np.ndarray, signal: np.ndarray) -> _Envelope:
    at, amplitude = velocity_extremes(time, signal)
    at, log_peaks = _of_neighbours(at), np.log(_of_neighbours(amplitude))
    return _Envelope(at, np.pi * np.arange(len(at)), log_peaks, 2.0)


def _by_zero_crossings(time: np.ndarray, signal: np.ndarray) -> _Envelope:
    before = np.flatnonzero(np.signbit(signal[:-1]) != np.signbit(signal[1:]))
    fraction = signal[before] / (signal[before] - signal[before + 1])
    zeros = time[before] + fraction * (time[before + 1] - time[before])
    zeros = _of_neighbours(zeros)
    peaks, amplitude = velocity_extremes(time, signal)
    peaks = _of_neighbours(peaks)
    log_peaks = np.interp(zeros, peaks, np.log(_of_neighbours(amplitude)))
    inside = (zeros >= peaks[0]) & (zeros <= peaks[-1])
    return _Envelope(zeros[inside], np.pi * np.arange(inside.sum()), log_peaks[inside], 2.0)


def _by_hilbert(time: np.ndarray, signal: np.ndarray) -> _Envelope:
    from scipy.signal import hilbert

    # Odd reflection about zeros at both ends continues the motion without a jump.
    zeros = np.flatnonzero(np.signbit(signal[:-1]) != np.signbit(signal[1:]))
    time, signal = time[zeros[0] : zeros[-1] + 2], signal[zeros[0] : zeros[-1] + 2]
    beyond = len(signal) // _MIRRORED
    mirrored = np.pad(signal, beyond, mode="reflect", reflect_type="odd")
    analytic = hilbert(mirrored)[beyond : beyond + len(signal)]
    phase = np.unwrap(np.angle(analytic))
    per_cycle = 2 * np.pi * len(time) / (phase[-1] - phase[0])
    cut = int(np.ceil(_HILBERT_ENDS * per_cycle))
    inside = slice(cut, len(time) - cut)
    return _Envelope(time[inside], phase[inside], np.log(np.abs(analytic[inside])), per_cycle)


_ENVELOPES = {"peaks": _by_peaks, "zero_crossings": _by_zero_crossings, "hilbert": _by_hilbert}


# Columns of local lines.
_TIME, _PHASE, _LEVEL, _OMEGA, _SLOPE = range(5)
_NEIGHBOURS = 5  # lines over which a filter's error oscillates
_ENDS = (slice(0, 4), slice(-4, None))


def _window(envelope: _Envelope, end: int) -> float:
    """Number of cycles of a local line."""
    last = min(end, len(envelope.time)) - 1
    fall = envelope.log_amplitude[0] - envelope.log_amplitude[last] if last > 0 else 0.0
    cycles = last / envelope.per_cycle
    of_fall = QUARTER * cycles / fall if fall > 0 else np.inf
    return float(np.clip(min(of_fall, cycles), *_WINDOW))


def _local_lines(
    envelope: _Envelope, end: int | None, window: float
) -> Float[np.ndarray, "line 5"]:
    """Straight lines of phase and log amplitude, one every half window.

    Columns: time of the centre, phase and log amplitude there, and their slopes.
    """
    width = max(4, round(window * envelope.per_cycle))
    end = len(envelope.time) if end is None else end
    if end < width:
        raise InputError(
            f"{window:g} cycles above the least amplitude are needed, but the record has "
            f"{end / envelope.per_cycle:.3g}."
        )
    starts = np.arange(0, end - width + 1, max(1, width // 2))
    return _straightened(
        np.array([_line(envelope, slice(start, start + width)) for start in starts])
    )


def _straightened(lines: Float[np.ndarray, "line 5"]) -> Float[np.ndarray, "line 5"]:
    """Slopes corrected for the third derivative, which adds h²/10 of it, h half the window.

    Lines are h apart, so that second differences of the slopes are h² times this derivative.
    """
    if len(lines) < 3:
        return lines
    roughness = np.diff(lines, 2, axis=0)
    roughness = np.concatenate([roughness[:1], roughness, roughness[-1:]])
    straight = lines.copy()
    for slope in (_OMEGA, _SLOPE):
        straight[:, slope] -= roughness[:, slope] / 10
    return straight


def _line(envelope: _Envelope, part: slice) -> tuple[float, float, float, float, float]:
    """One local line; a curvature is fitted in addition, orthogonal to the slope."""
    middle = float(envelope.time[part].mean())
    away = envelope.time[part] - middle
    _, omega, phase = np.polyfit(away, envelope.phase[part], 2)
    decay = np.polyfit(away, envelope.log_amplitude[part], 2)[1]
    level = envelope.log_amplitude[part].mean()
    return middle, float(phase), float(level), float(omega), float(decay)


def _points(
    lines: Float[np.ndarray, "line 5"], bias: Float[np.ndarray, "line 5"], fundamental: bool
) -> list[MethodPoint]:
    """Points of local lines.

    The action v²/ω̃ of a mode, v its fundamental velocity, decays at the rate 2ζ̃ω̃; at a peak the
    energy is ½v², the integral of ω̃ over the action. A displacement e^{∫(−δ + iω)dt} satisfies
    the equation of motion with ω̃² = ω² + δ² + dδ/dt − δ (dω/dt)/ω.
    """
    from scipy.ndimage import maximum_filter1d

    speed, omega, decay = np.exp(lines[:, _LEVEL]), lines[:, _OMEGA], lines[:, _SLOPE]
    if len(lines) > 1:
        frequency_rate = np.gradient(np.log(omega), lines[:, _TIME])
        displacement_rate = frequency_rate - decay
        squared = (
            displacement_rate**2
            + np.gradient(displacement_rate, lines[:, _TIME])
            - displacement_rate * frequency_rate
        )
        decay = decay - frequency_rate * (0.5 if fundamental else 0.25)
        omega = np.sqrt(np.maximum(omega**2 + squared, 0.0))
    # Near the ends the filter's error oscillates from line to line: its envelope is used.
    bias = maximum_filter1d(np.abs(bias), _NEIGHBOURS, axis=0)
    omega_std = np.hypot(_scatter(omega, speed), bias[:, _OMEGA])
    decay_std = np.hypot(_scatter(decay, speed), bias[:, _SLOPE])
    return points_of_curves(speed, omega, omega_std, -decay / omega, decay_std / omega)


def _fitted_decay(
    lines: Float[np.ndarray, "line 5"], time: Float[np.ndarray, " sample"]
) -> Float[np.ndarray, " sample"]:
    """The decay along the local lines, extrapolated with the slopes at both ends."""
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


def _interpolated_lines(
    lines: Float[np.ndarray, "line 5"], reference: Float[np.ndarray, "line 5"]
) -> Float[np.ndarray, "line 5"]:
    """Lines interpolated at the times of `reference`."""
    return np.stack(
        [np.interp(reference[:, _TIME], lines[:, _TIME], column) for column in lines.T], axis=1
    )


def _bias_note(bias: Float[np.ndarray, "line 5"], lines: Float[np.ndarray, "line 5"]) -> Fact:
    omega = np.abs(bias[:, _OMEGA] / lines[:, _OMEGA]).max()
    decay = np.abs(bias[:, _SLOPE] / lines[:, _SLOPE]).max()
    return Fact("bias_of_filter", frequency=omega, damping=decay)


def _scatter(values: np.ndarray, amplitude: np.ndarray) -> np.ndarray:
    """1σ of values from second differences of windows that do not overlap.

    It is inversely proportional to the amplitude (constant noise). NaN for too few windows.
    """
    roughness = values[:-4] - 2 * values[2:-2] + values[4:]
    if not roughness.size:
        return np.full(len(values), np.nan)
    scale = np.median(np.abs(roughness * amplitude[2:-2])) / (_MEDIAN_OF_NORMAL * np.sqrt(6))
    return scale / amplitude
