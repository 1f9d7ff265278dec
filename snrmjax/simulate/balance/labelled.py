"""Quantities of periodic motions as results label them: names, units, and lines of text."""

from collections import Counter
from collections.abc import Iterable

import numpy as np
from jaxtyping import Complex, Float

from snrmjax.measure.signals import peak_amplitude
from snrmjax.numerics.blocks import by_blocks
from snrmjax.numerics.result import Variable

HERTZ = 2 * np.pi
_BLOCK = 256  # points whose peaks are found at a time: one size compiles once


def motion_variables(
    frequency: Float[np.ndarray, " point"],
    velocity: Complex[np.ndarray, "point harmonic sensor"],
    sensors: tuple[str, ...],
) -> dict[str, Variable]:
    """Frequency (rad/s) and velocities (m/s) along a curve, by the names of the files' columns."""
    seen = np.asarray(velocity)
    fundamental, at = seen[:, 1], ("point", "sensor")
    return {
        "point": Variable(("point",), np.arange(len(seen)), "1", "number of the point"),
        "sensor": Variable(("sensor",), np.array(sensors), "", "sensor"),
        "frequency_hz": Variable(("point",), np.asarray(frequency) / HERTZ, "Hz", "frequency"),
        "velocity_h1_re_m_s": Variable(
            at, fundamental.real, "m/s", "velocity fundamental, in phase with the force"
        ),
        "velocity_h1_im_m_s": Variable(
            at, fundamental.imag, "m/s", "velocity fundamental, a quarter period ahead of the force"
        ),
        "velocity_peak_m_s": Variable(at, _peaks(seen), "m/s", "largest velocity over a period"),
    }


def range_text(values: Float[np.ndarray, " point"], unit: str, size: float = 1.0) -> str:
    """The smallest and the largest of some values, in words."""
    known = np.asarray(values)[np.isfinite(values)] / size
    if not known.size:
        return "none"
    low, high = known.min(), known.max()
    return f"{low:.4g} {unit}" if low == high else f"{low:.4g} to {high:.4g} {unit}"


def counted(kinds: Iterable[str]) -> str:
    """How often each kind comes: "2 folds, 1 peak"."""
    each = Counter(kinds)
    return ", ".join(
        f"{n} {kind.replace('_', ' ')}{'' if n == 1 else 's'}" for kind, n in each.items()
    )


def _peaks(velocity: Complex[np.ndarray, "point harmonic sensor"]) -> np.ndarray:
    """Peak of the time signal at every point and sensor, without the mean (which is 0)."""
    orders = tuple(range(1, velocity.shape[1]))
    harmonics = np.moveaxis(velocity[:, 1:], 1, 2)
    (peaks,) = by_blocks(lambda rows: (peak_amplitude(rows, orders),), _BLOCK, harmonics)
    return peaks
