"""Starting values, steps and values at zero strength for the rows of `table`.

Starting values are of clearly visible strength: see `MotionScales.change`. Parameters are in the
order of the constructor.
"""

from collections.abc import Callable

import numpy as np

from snrmjax.diagnose.kinds.hypothesis import Start
from snrmjax.model.effect_metadata import VISIBLE_CHANGE, MotionScales
from snrmjax.numerics.units import HERTZ

_GAPS = (0.3, 0.55, 0.75, 0.9)  # over the largest amplitude
_SLIPS = (0.05, 0.15, 0.3, 0.5, 0.75)  # likewise
_LIGHT = 1e-3  # damping ratio of a close mode if that of the model is zero
_WIDE = 0.15  # relative distance in frequency, beyond which a mode counts as a residual one


def of_contact(factor: float) -> Callable[[MotionScales], list[Start]]:
    """Contacts with several gaps, their stiffness `factor` times the visible change."""
    return lambda scales: [(factor * scales.change, gap * scales.largest) for gap in _GAPS]


def of_bilinear_spring(scales: MotionScales) -> list[Start]:
    """A twentieth of the linear stiffness, with either sign."""
    return [(sign * 0.05 * scales.frequency**2,) for sign in (1.0, -1.0)]


def of_preload(scales: MotionScales) -> list[Start]:
    """A static displacement of a fifth of the amplitude, with either sign."""
    force = 0.2 * scales.frequency**2 * scales.amplitude
    return [(force,), (-force,)]


def of_slider(scales: MotionScales) -> list[Start]:
    """Slip at several fractions of the largest amplitude."""
    return [(3.0 * scales.change, fraction * scales.largest) for fraction in _SLIPS]


def of_microslip(scales: MotionScales) -> list[Start]:
    """Several exponents p, with Δ(ω̃²) ≈ −cQ^(p−1)."""
    return [(scales.change / scales.amplitude ** (p - 1), p) for p in (1.2, 1.5, 2.0, 2.6)]


def of_resonance(order: int) -> Callable[[MotionScales], list[Start]]:
    """Added modes at and near n times the frequency, n the `order`.

    At resonance q_new ~ bQⁿ/(2ⁿ⁻¹·2ζω²), with the reaction n b Qⁿ⁻² q_new on Q.
    """

    def starts(scales: MotionScales) -> list[Start]:
        coupling = np.sqrt(scales.change * 0.02 * (order * scales.frequency) ** 2)
        coupling = float(coupling / scales.amplitude ** (order - 1))
        hz = order * scales.frequency / HERTZ
        fractions = (0.95, 0.985, 1.0, 1.015, 1.05)
        return [(coupling, fraction * hz, scales.damping_ratio) for fraction in fractions]

    return starts


def steps_of_resonance(start: Start) -> Start:
    """A hundredth of the added mode's frequency, half its damping ratio."""
    coefficient, hz, ratio = start
    return coefficient, 0.01 * hz, 0.5 * ratio


def of_close_mode(scales: MotionScales) -> list[Start]:
    """Modes a few half-power bandwidths away, of a clearly visible amplitude at resonance."""
    starts: list[Start] = []
    ratio = max(scales.damping_ratio, _LIGHT)
    for away in (-8.0, -3.0, 3.0, 8.0):
        fraction = 1 + float(np.clip(away * ratio, -_WIDE, _WIDE))
        distance = abs(fraction**2 - 1 + 2j * ratio * fraction) * scales.frequency**2
        hz = fraction * scales.frequency / HERTZ
        starts.append((VISIBLE_CHANGE * scales.receptance * distance, hz, ratio))
    return starts


def steps_of_close_mode(start: Start) -> Start:
    """Half a half-power bandwidth in frequency."""
    constant, hz, ratio = start
    return constant, ratio * hz, 0.5 * ratio


def mode_above(order: int) -> Callable[[float, float], Start]:
    """A mode without coupling, a tenth above `order` times the frequency."""
    return lambda frequency, ratio: (0.0, 1.1 * order * frequency / HERTZ, ratio)
