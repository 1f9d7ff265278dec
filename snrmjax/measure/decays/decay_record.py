"""What a record of a free decay must be to be read: even, finite, not clipped, long enough."""

import numpy as np
from jaxtyping import Float

FEWEST_SAMPLES = 8  # a cycle: a parabola through an extreme is then within 2 % of a cosine
_FEWEST_CYCLES = 12
_FEWEST_FALLING = 5  # cycles, of a decay to a quarter
QUARTER = 1.4  # of the logarithm of an amplitude
_CLIPPED = 4  # neighbouring samples at the largest value that a free decay does not have
_EVEN = 1e-3  # largest relative deviation of a sampling interval


def even_record(
    time: Float[np.ndarray, " sample"], velocity: Float[np.ndarray, " sample"]
) -> tuple[Float[np.ndarray, " sample"], Float[np.ndarray, " sample"]]:
    """A finite, evenly spaced record that is not clipped; raises `ValueError` of others."""
    times, signal = np.asarray(time, dtype=float), np.asarray(velocity, dtype=float)
    if times.ndim != 1 or times.shape != signal.shape or len(times) < FEWEST_SAMPLES:
        raise ValueError(
            f"`time` and `velocity` must be of one length, but have shapes {times.shape} and "
            f"{signal.shape}."
        )
    if not (np.isfinite(times).all() and np.isfinite(signal).all()):
        raise ValueError("the record must be of finite numbers, but has NaN or inf.")
    steps = np.diff(times)
    if steps.min() <= 0 or np.ptp(steps) > _EVEN * steps.mean():
        raise ValueError("times must be evenly spaced and rise, but are not.")
    largest = np.abs(signal).max()
    flat = np.abs(signal) >= largest * (1 - 1e-9)
    ends = np.flatnonzero(np.diff(np.concatenate([[0], flat, [0]])))
    run = int(np.max(ends[1::2] - ends[::2]))
    if largest > 0 and run >= _CLIPPED + _at_an_extreme(signal, largest):
        raise ValueError(
            f"the record stays at its largest value, {largest:.4g}, for {run} samples: it is "
            "clipped."
        )
    return times, signal


def _at_an_extreme(signal: Float[np.ndarray, " sample"], largest: float) -> float:
    """Samples for which a cosine stays within one digit of its extreme, as converters round it."""
    steps, crossings = np.abs(np.diff(signal)), np.sum(np.diff(signal > 0))
    digit = np.min(steps[steps > 0], initial=largest)
    cycle = 2 * len(signal) / max(crossings, 1)
    return cycle / np.pi * float(np.sqrt(2 * digit / largest))


def require_cycles(signal: Float[np.ndarray, " sample"], cycles: float) -> None:
    """Raise `ValueError` unless a record has twelve cycles, or five in which it falls enough."""
    part = max(1, int(len(signal) / max(cycles, 1.0)))
    first, last = np.abs(signal[:part]).max(), np.abs(signal[-part:]).max()
    if not enough_cycles(cycles, np.log(max(first, 1e-300) / max(last, 1e-300))):
        raise ValueError(
            f"{_FEWEST_CYCLES} cycles are needed, or {_FEWEST_FALLING} in which the motion falls "
            f"to a quarter, but the record has {cycles:.3g}."
        )


def enough_cycles(cycles: float, fall: float) -> bool:
    """Whether there are twelve cycles, or five in which the amplitude falls by e^(−`QUARTER`)."""
    return cycles >= _FEWEST_CYCLES or (cycles >= _FEWEST_FALLING and fall >= QUARTER)


def require_samples(samples: float, why: str = "") -> None:
    """Raise `ValueError` where a record has fewer than eight samples a cycle."""
    if samples < FEWEST_SAMPLES:
        raise ValueError(
            f"{FEWEST_SAMPLES} samples a cycle are needed, but the record has {samples:.1f}: the "
            f"sampling rate is too low{why}."
        )
