"""Requirements on a free-decay record: even, finite, not clipped, long enough."""

import numpy as np
from jaxtyping import Float

from snrmjax.numerics.rules import InputError

FEWEST_SAMPLES = 8  # per cycle: a parabola through an extremum is then within 2 % of a cosine
_FEWEST_CYCLES = 12
_FEWEST_FALLING = 5  # cycles, for a decay to a quarter
QUARTER = 1.4  # decrease of the log amplitude, to a quarter
_CLIPPED = 4  # consecutive samples at the largest value that indicate clipping
_EVEN = 1e-3  # largest relative deviation of a sampling interval


def even_record(
    time: Float[np.ndarray, " sample"], velocity: Float[np.ndarray, " sample"]
) -> tuple[Float[np.ndarray, " sample"], Float[np.ndarray, " sample"]]:
    """Check a record: finite, evenly spaced and not clipped; raises `ValueError` otherwise."""
    times, signal = np.asarray(time, dtype=float), np.asarray(velocity, dtype=float)
    if times.ndim != 1 or times.shape != signal.shape or len(times) < FEWEST_SAMPLES:
        raise InputError(
            f"`time` and `velocity` must have the same length, but have shapes {times.shape} and "
            f"{signal.shape}."
        )
    if not (np.isfinite(times).all() and np.isfinite(signal).all()):
        raise InputError("the record must be of finite numbers, but has NaN or inf.")
    steps = np.diff(times)
    if steps.min() <= 0 or np.ptp(steps) > _EVEN * steps.mean():
        raise InputError("times must be ascending and evenly spaced, but are not.")
    largest = np.abs(signal).max()
    flat = np.abs(signal) >= largest * (1 - 1e-9)
    ends = np.flatnonzero(np.diff(np.concatenate([[0], flat, [0]])))
    run = int(np.max(ends[1::2] - ends[::2]))
    if largest > 0 and run >= _CLIPPED + _at_an_extreme(signal, largest):
        raise InputError(
            f"the record stays at its largest value, {largest:.4g}, for {run} samples: it is "
            "clipped."
        )
    return times, signal


def _at_an_extreme(signal: Float[np.ndarray, " sample"], largest: float) -> float:
    """Samples for which a quantised cosine stays within one digit of its extremum."""
    steps, crossings = np.abs(np.diff(signal)), np.sum(np.diff(signal > 0))
    digit = np.min(steps[steps > 0], initial=largest)
    cycle = 2 * len(signal) / max(crossings, 1)
    return cycle / np.pi * float(np.sqrt(2 * digit / largest))


def require_cycles(signal: Float[np.ndarray, " sample"], cycles: float) -> None:
    """Raise `ValueError` for fewer than twelve cycles, or five of sufficient decay."""
    part = max(1, int(len(signal) / max(cycles, 1.0)))
    first, last = np.abs(signal[:part]).max(), np.abs(signal[-part:]).max()
    if not enough_cycles(cycles, np.log(max(first, 1e-300) / max(last, 1e-300))):
        raise InputError(
            f"{_FEWEST_CYCLES} cycles are needed, or {_FEWEST_FALLING} in which the motion decays "
            f"to a quarter, but the record has {cycles:.3g}."
        )


def enough_cycles(cycles: float, fall: float) -> bool:
    """Whether there are twelve cycles, or five in which the amplitude decays by e^(−`QUARTER`)."""
    return cycles >= _FEWEST_CYCLES or (cycles >= _FEWEST_FALLING and fall >= QUARTER)


def require_samples(samples: float, why: str = "") -> None:
    """Raise `ValueError` for fewer than eight samples per cycle."""
    if samples < FEWEST_SAMPLES:
        raise InputError(
            f"{FEWEST_SAMPLES} samples a cycle are needed, but the record has {samples:.1f}: the "
            f"sampling rate is too low{why}."
        )
