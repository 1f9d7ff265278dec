"""Times of a record: the sampling rate from few printed digits, and odd steps.

Records with a few odd steps are resampled; of others the first odd step is named.
"""

import math
from typing import Any, NamedTuple

import numpy as np
import scipy.interpolate
from jaxtyping import Float, Int

from snrmjax.numerics.facts import Fact

_LONGEST = 3.5  # of the usual step: up to three lost samples in a row are interpolated
_ODD = 0.01  # of the usual step: deviation of an odd step
_MOST = 0.01  # fraction of odd steps: beyond it the times themselves are in doubt
_WHOLE = 1e-3  # relative distance within which a whole rate (Hz) is used
_MOST_DIGITS = 12  # more digits come from a computation, not from printing
_ROUND_STEP = 3  # digits of a step that a user may have chosen
_ROUNDED = 1e-5  # relative uncertainty of a rate that needs no note
_FEW_DIGITS = 0.02  # relative uncertainty above which the times are uneven
_HALVINGS = 60


class Resampled(NamedTuple):
    """Channels at an even rate (Hz) from `start` (s), with a note on the odd steps."""

    rate: float
    start: float
    values: Float[np.ndarray, "channel sample"]
    note: Fact


def resampled(
    time: Float[np.ndarray, " row"], values: Float[np.ndarray, "channel row"], name: str
) -> Resampled | None:
    """Samples at times (s) with a few odd steps as samples at an even rate, by cubic splines.

    Samples at even times keep their values. None where the times do not rise, where more than 1 %
    of the steps are odd or one is longer than three and a half of the usual ones, and where a
    number is missing: `odd_step` names the place.
    Arguments: `name` of the time for the note.
    """
    steps = np.diff(time)
    if not (np.isfinite(time).all() and np.isfinite(values).all() and np.all(steps > 0)):
        return None
    where = _where(time)
    usual = where["usual"]
    if steps.max() > _LONGEST * usual or where["n"] > max(1, _MOST * steps.size):
        return None
    rate, whole = 1 / usual, round(1 / usual)
    rate = float(whole) if whole and abs(rate / whole - 1) < _WHOLE else rate
    even = time[0] + np.arange(int((time[-1] - time[0]) * rate + _ODD) + 1) / rate
    even[-1] = min(even[-1], time[-1])
    spline = scipy.interpolate.CubicSpline(time, values, axis=1)
    note = Fact("time_resampled", name=name, rate=rate, **where)
    return Resampled(rate, float(time[0]), spline(even), note)


def odd_step(time: Float[np.ndarray, " row"], name: str) -> Fact:
    """A note on the first step that falls, else on the one farthest from the usual step."""
    return Fact("uneven_time", name=name, **_where(time))


def _where(time: Float[np.ndarray, " row"]) -> dict[str, Any]:
    """Number of odd steps, sample (from 1) after one, its time, that step, and the usual step."""
    steps = np.diff(time)
    usual = float(np.nanmedian(steps))
    falls = np.flatnonzero(~(steps > 0))
    k = int(falls[0]) if falls.size else int(np.argmax(np.abs(steps - usual)))
    n = int(np.sum(~(np.abs(steps - usual) <= _ODD * usual)))
    at, step = float(time[k + 1]), float(steps[k])
    return {"n": n, "sample": k + 2, "at": at, "step": step, "usual": usual}


class PrintedRate(NamedTuple):
    """A sampling rate (Hz), with a note where it was inferred."""

    rate: float
    note: Fact | None = None


def rate_between(lowest: float, highest: float, word: str, step: float = 0.0) -> PrintedRate:
    """The sampling rate (Hz) that printed digits bound by two values.

    The unique whole rate in the interval or, without one, the rate of the round `step` (s) if it is
    inside; else the middle, with a note on the uncertainty and the roundest rate inside.
    Arguments: `word` is the step as printed.
    """
    least, most = math.ceil(lowest * (1 - 1e-12)), math.floor(highest * (1 + 1e-12))
    middle = 2 / (1 / lowest + 1 / highest)
    is_round = step > 0 and lowest <= 1 / step <= highest and not (1 / step).is_integer()
    if least == most and not is_round:
        return PrintedRate(float(least), Fact("whole_rate_of_digits", step=word, rate=least))
    half = 0.5 * (highest - lowest) / middle
    if least > most and is_round:
        return PrintedRate(1 / step)
    likely = max(range(least, most + 1), key=_roundness) if least <= most else middle
    if half <= _ROUNDED:
        return PrintedRate(middle)
    return PrintedRate(middle, Fact("rate_left_open", step=word, rate=likely, off=100 * half))


def _roundness(rate: int) -> int:
    """The largest power of two or ten that divides a rate; usual rates have large ones."""
    return max(rate & -rate, 10 ** (len(str(rate)) - len(str(rate).rstrip("0"))))


def rate_of_printed_times(
    time: Float[np.ndarray, " row"], at: Int[np.ndarray, " row"] | None = None, unit: float = 1.0
) -> PrintedRate | None:
    """The rate (Hz) of times that are even to their printed digits, or None.

    All times share the largest numbers of decimals and significant digits that occur, and are
    rounded or truncated there. t₀ + kΔ within that resolution of every time bounds Δ.
    Arguments: `at` are the sample indices k, all in order by default; `unit` of the times
    in s.
    """
    at = np.arange(len(time)) if at is None else at
    resolution = _resolution(time)
    if resolution is None or not at[-1] > at[0]:
        return None
    for rounded in (0.5, 1.0):  # rounded, or truncated
        low, high = time - rounded * resolution, time + rounded * resolution
        steps = _steps_between(low, high, at)
        if steps is not None:
            break
    else:
        return None
    least, most = steps
    if not 0 < least <= most or (most - least) / (most + least) > _FEW_DIGITS:
        return None
    step = unit * 0.5 * (least + most)
    round_step = float(f"{step:.{_ROUND_STEP - 1}e}")
    return rate_between(1 / (unit * most), 1 / (unit * least), f"{step:.4g}", round_step)


def _resolution(time: Float[np.ndarray, " row"]) -> Float[np.ndarray, " row"] | None:
    """The unit of the last digit of every time; None if there are too many digits for a print."""
    significant, decimals = 1, 0
    for value in time.tolist():
        plain = f"{value:.{_MOST_DIGITS}e}"
        if not math.isfinite(value) or float(plain) != value:
            return None
        mantissa, _, power = plain.partition("e")
        count = len(mantissa.replace("-", "").replace(".", "").rstrip("0"))
        significant = max(significant, count)
        decimals = max(decimals, count - 1 - int(power))
    magnitude = np.abs(time)
    exponent = np.floor(np.log10(magnitude, out=np.full(len(time), -300.0), where=magnitude > 0))
    return np.maximum(10.0**-decimals, 10.0 ** (exponent - significant + 1))


def _steps_between(
    low: Float[np.ndarray, " row"], high: Float[np.ndarray, " row"], at: Int[np.ndarray, " row"]
) -> tuple[float, float] | None:
    """The least and the largest step Δ with low ≤ t₀ + kΔ ≤ high for some t₀, or None.

    max(low − kΔ) − min(high − kΔ) is convex in Δ and ≤ 0 exactly for these steps.
    """
    span = float(at[-1] - at[0])
    slack = 1e-9 * float(np.max(high - low))

    def excess(step: float) -> float:
        return float(np.max(low - at * step) - np.min(high - at * step)) - slack

    least = float(low[-1] - high[0]) / span
    most = float(high[-1] - low[0]) / span
    left, right = least, most
    for _ in range(_HALVINGS):
        first, second = left + (right - left) / 3, right - (right - left) / 3
        if excess(first) <= excess(second):
            right = second
        else:
            left = first
        if min(excess(left), excess(right)) <= 0:
            break
    inside = left if excess(left) <= excess(right) else right
    if excess(inside) > 0:
        return None
    ends = []
    for outside in (least, most):
        good, bad = inside, outside
        for _ in range(_HALVINGS):
            middle = 0.5 * (good + bad)
            good, bad = (middle, bad) if excess(middle) <= 0 else (good, middle)
        ends.append(good)
    return ends[0], ends[1]
