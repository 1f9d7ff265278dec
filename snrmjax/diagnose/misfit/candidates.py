"""Every effect as a candidate: where its fit starts, and what tells it from the others."""

from collections.abc import Callable, Iterable, Mapping
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from snrmjax.model.averaging import averaged_effect
from snrmjax.model.effect_base import AbstractForce
from snrmjax.model.effects import EFFECTS, effect_parameters, make_effect

CLOSE = "close_mode"
"""The kind that is no candidate of a search but a question to what it found."""

RESONANCE_ORDER = {"internal_resonance_1_2": 2, "internal_resonance_1_3": 3}
"""Cycles of the further mode to one of the mode of interest."""

_LIGHT = 1e-3  # damping ratio of a mode close by, where the model itself has none
_WIDE = 0.15  # relative distance of a close mode, beyond which it is one far away
_CHANGE = 0.05  # of the dynamic stiffness near resonance, that a start makes


class Scales(NamedTuple):
    """What is typical of the measured motions."""

    amplitude: float  # median Q of the mode of interest, kg^1/2 m
    largest: float
    frequency: float  # rad/s
    stiffness: float  # median |modal force|/Q, 1/s²
    receptance: float  # median |X/F| at the sensor, m/N
    smallest_force: float  # N
    damping_ratio: float

    @property
    def change(self) -> float:
        """A change of the dynamic stiffness that is plainly seen, 1/s²."""
        return _CHANGE * self.stiffness


class EffectCandidate(NamedTuple):
    """Starts of one kind of effect; parameters in the order of its constructor."""

    kind: str
    starts: tuple[tuple[float, ...], ...]
    unit: tuple[float, ...]  # a step that is plainly seen
    lower: tuple[float, ...]
    upper: tuple[float, ...]


_Start = Callable[[Scales], list[tuple[float, ...]]]
_INF = np.inf


def _one(size: Callable[[Scales], float]) -> _Start:
    return lambda s: [(size(s),)]


def _threshold(s: Scales, share: float) -> list[tuple[float, ...]]:
    return [(share * s.change, g * s.largest) for g in (0.3, 0.55, 0.75, 0.9)]


def _softening(s: Scales) -> float:
    """a₂ that softens by the change: Δω̃² = −(5/6)a₂²Q²/ω₀²."""
    return float(np.sqrt(1.2 * s.change) * s.frequency / s.amplitude)


def _resonance(s: Scales, order: int) -> list[tuple[float, ...]]:
    # q_new ~ bQⁿ/(2ⁿ⁻¹·2ζω²) where it resonates, and acts back like n b Qⁿ⁻² q_new.
    hz = s.frequency / (2 * np.pi)
    size = np.sqrt(s.change * 0.02 * (order * s.frequency) ** 2) / s.amplitude ** (order - 1)
    return [
        (size, order * hz * share, s.damping_ratio) for share in (0.95, 0.985, 1.0, 1.015, 1.05)
    ]


def _close(s: Scales) -> list[tuple[float, ...]]:
    """Modes some half-power bandwidths away, as strong as a plain change at the resonance."""
    starts: list[tuple[float, ...]] = []
    ratio = max(s.damping_ratio, _LIGHT)
    for away in (-8.0, -3.0, 3.0, 8.0):
        share = 1 + float(np.clip(away * ratio, -_WIDE, _WIDE))
        distance = abs(share**2 - 1 + 2j * ratio * share) * s.frequency**2
        hz = share * s.frequency / (2 * np.pi)
        starts.append((_CHANGE * s.receptance * distance, hz, ratio))
    return starts


_STARTS: Mapping[str, _Start] = {
    "linear_frequency_shift": _one(lambda s: 0.5 * s.change / s.frequency**2),
    "linear_damping_change": _one(lambda s: 0.5 * s.change / s.frequency**2),
    "cubic_stiffness": _one(lambda s: s.change / (0.75 * s.amplitude**2)),
    "quadratic_stiffness": lambda s: [(_softening(s),), (-_softening(s),)],
    "quintic_stiffness": _one(lambda s: s.change / (0.625 * s.amplitude**4)),
    "bilinear_stiffness": lambda s: [(0.05 * s.frequency**2,), (-0.05 * s.frequency**2,)],
    "gap_stiffness": lambda s: _threshold(s, 3.0),
    "one_sided_stop": lambda s: _threshold(s, 6.0),
    "coulomb_friction": _one(lambda s: s.change * np.pi * s.amplitude / 4),
    "jenkins_slider": lambda s: [
        (3.0 * s.change, share * s.largest) for share in (0.05, 0.15, 0.3, 0.5, 0.75)
    ],
    "iwan_microslip": lambda s: [
        (s.change / s.amplitude ** (p - 1), p) for p in (1.2, 1.5, 2.0, 2.6)
    ],
    "quadratic_damping": _one(lambda s: s.change * 3 * np.pi / (8 * s.frequency**2 * s.amplitude)),
    "cubic_damping": _one(lambda s: s.change / (0.75 * s.frequency**3 * s.amplitude**2)),
    "van_der_pol_damping": _one(lambda s: 4 * s.change / (s.frequency * s.amplitude**2)),
    "frequency_drift": _one(lambda s: s.change / s.frequency**2),
    "added_mass": _one(lambda s: s.change / s.frequency**2),
    "force_gain_error": _one(lambda s: _CHANGE),
    "force_offset_error": _one(lambda s: _CHANGE * s.smallest_force),
    "sensor_gain_error": _one(lambda s: _CHANGE),
    "sensor_phase_error": _one(lambda s: float(np.degrees(_CHANGE))),
    "internal_resonance_1_3": lambda s: _resonance(s, 3),
    "internal_resonance_1_2": lambda s: _resonance(s, 2),
    "residual_mode": _one(lambda s: _CHANGE * s.receptance),
    CLOSE: _close,
    "mode_shape_change": _one(lambda s: _CHANGE / s.amplitude**2),
    "force_harmonics": lambda s: [(0.02, 0.02)],
    "static_preload": lambda s: [
        (sign * 0.2 * s.frequency**2 * s.amplitude,) for sign in (1.0, -1.0)
    ],
}

_NOT_NEGATIVE = frozenset(
    {
        *("coulomb_friction", "jenkins_slider", "iwan_microslip", "quadratic_damping"),
        *("gap_stiffness", "one_sided_stop"),
    }
)


def candidate(kind: str, scales: Scales) -> EffectCandidate:
    """Starts, units and bounds of a kind of effect."""
    own = _STARTS[kind](scales) if kind in _STARTS else [_of_ones_own(kind, scales)]
    starts = tuple(tuple(float(v) for v in start) for start in own)
    n = len(effect_parameters(kind))
    lower, upper = [-_INF] * n, [_INF] * n
    if kind in _NOT_NEGATIVE:
        lower[0] = 0.0
    if kind in ("gap_stiffness", "one_sided_stop"):
        lower[1], upper[1] = 0.0, 1.2 * scales.largest
    if kind == "jenkins_slider":
        lower[1], upper[1] = 1e-3 * scales.largest, 1.2 * scales.largest
    if kind == "iwan_microslip":
        lower[1], upper[1] = 1.02, 2.98
    if kind in RESONANCE_ORDER:
        hz = RESONANCE_ORDER[kind] * scales.frequency / (2 * np.pi)
        lower[1:], upper[1:] = [0.8 * hz, 1e-5], [1.2 * hz, 0.2]
    if kind == CLOSE:
        hz = scales.frequency / (2 * np.pi)
        lower[1:], upper[1:] = [(1 - 2 * _WIDE) * hz, 1e-5], [(1 + 2 * _WIDE) * hz, 0.2]
    unit = tuple(abs(v) if v else 1.0 for v in starts[0])
    if kind in RESONANCE_ORDER:
        unit = (unit[0], 0.01 * unit[1], 0.5 * unit[2])
    if kind == CLOSE:
        unit = (unit[0], unit[2] * unit[1], 0.5 * unit[2])
    return EffectCandidate(kind, starts, unit, tuple(lower), tuple(upper))


def _of_ones_own(kind: str, scales: Scales) -> tuple[float, ...]:
    """A start for an effect that a user wrote: the first parameter makes the usual change."""
    typical = getattr(EFFECTS[kind], "typical", {})
    values = {name: float(typical.get(name, 1.0)) for name in effect_parameters(kind)}
    first = effect_parameters(kind)[0]
    effect = make_effect(kind, values)
    if isinstance(effect, AbstractForce):
        at = (jnp.asarray(scales.amplitude), jnp.asarray(scales.frequency))
        change = averaged_effect(effect, *at)
        size = float(jnp.hypot(change.stiffness, scales.frequency * change.damping))
        if size > 0:
            values[first] *= scales.change / size
    return tuple(values.values())


def parameter_labels(kind: str) -> tuple[str, ...]:
    """Names of a candidate's parameters as a diagnosis gives them."""
    return tuple(f"{kind}.{name}" for name in effect_parameters(kind))


SECOND_ORDER = frozenset(
    {"quadratic_stiffness", "static_preload", "bilinear_stiffness", *RESONANCE_ORDER}
)
"""Kinds that change the fundamental by the square of their strength."""

LIKE_A_MODE = frozenset(
    {
        *("residual_mode", "sensor_phase_error", "sensor_gain_error", "force_gain_error"),
        *("linear_frequency_shift", "linear_damping_change", "added_mass", "frequency_drift"),
    }
)
"""Kinds that change what a linear structure shows, as a further mode close by does."""

# What would settle which of two effects it is.
_HARMONICS = "the second and third harmonics of the velocity (with their noise floor)"
_DECIDES: tuple[tuple[frozenset[str], str], ...] = (
    (
        frozenset({"quadratic_stiffness", "cubic_stiffness", "static_preload"}),
        "record harmonic 2 or the mean displacement at the largest level",
    ),
    (
        frozenset({"gap_stiffness", "one_sided_stop"}),
        "record harmonic 2 at the largest level: only a one-sided contact makes it",
    ),
    (
        frozenset({"cubic_damping", "van_der_pol_damping", "quadratic_damping"}),
        "record harmonic 3 at the largest level, whose sign and size differ, and widen the range "
        "of levels",
    ),
    (
        frozenset({"bilinear_stiffness", "force_harmonics"}),
        "record harmonic 2 against level and the force's own spectrum",
    ),
    (
        frozenset({"force_gain_error", "sensor_gain_error", "mode_shape_change"}),
        "calibrate force and velocity statically, or repeat a level with a known added mass",
    ),
    (
        frozenset({"linear_frequency_shift", "added_mass"}),
        "add a known mass, or measure a second mode",
    ),
    (
        frozenset({"coulomb_friction", "force_offset_error"}),
        "measure at the smallest level 30° and more off resonance, on both sides",
    ),
    (
        frozenset({"frequency_drift"}),
        "repeat the first level last",
    ),
    (
        frozenset({"residual_mode", "sensor_phase_error"}),
        "measure 60° and more off resonance on both sides, or with a second sensor",
    ),
    (
        frozenset({CLOSE}),
        "measure with a second sensor, where a further mode has another shape, or sweep wider",
    ),
    (
        frozenset(RESONANCE_ORDER),
        f"step through the frequency of the disturbance and record {_HARMONICS}",
    ),
)


_STATIC = (
    frozenset({"force_gain_error", "sensor_gain_error"}),
    frozenset({"linear_frequency_shift", "added_mass"}),
)


def only_by_calibration(kinds: Iterable[str]) -> set[str]:
    """Those of some kinds of which another one does the same to every test of one mode."""
    return set().union(*(pair for pair in _STATIC if pair <= set(kinds)))


def decide_by(kinds: set[str], *, harmonics: bool) -> str:
    """A sentence: the measurement that would settle which of several kinds it is."""
    fitting = [sentence for group, sentence in _DECIDES if len(group & kinds) > 1 or group <= kinds]
    if not fitting and not harmonics:
        fitting.append(f"record {_HARMONICS} at the largest level")
    if not fitting:
        fitting.append("widen the range of levels and measure farther off resonance on both sides")
    text = "; ".join(fitting[:2])
    return f"{text[0].upper()}{text[1:]}."
