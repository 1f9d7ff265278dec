"""Records whose times have odd steps: resampled, or the first odd step named."""

from typing import Any, NamedTuple

import numpy as np
import scipy.interpolate
from jaxtyping import Float

from snrmjax.numerics.facts import Fact

_LONGEST = 3.5  # of the usual step: up to three lost samples in a row are interpolated
_ODD = 0.01  # of the usual step: deviation of an odd step
_MOST = 0.01  # fraction of odd steps: beyond it the times themselves are in doubt
_WHOLE = 1e-3  # relative distance within which a whole rate (Hz) is used


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
