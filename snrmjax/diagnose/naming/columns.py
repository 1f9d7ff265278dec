"""What every hypothesis of a diagnosis changes in the readings, to first order: one column each.

A parameter that is not linear (a gap, an exponent) has a column for each value of a grid.
"""

import itertools
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Complex, Float

from snrmjax.diagnose.naming import describing, priors
from snrmjax.diagnose.naming.readings import Readings
from snrmjax.model.effect_base import AbstractForce
from snrmjax.model.effect_shape import starts_of
from snrmjax.model.effects import EFFECTS, is_own, make_effect
from snrmjax.model.library.damping import (
    CubicDamping,
    QuadraticDamping,
    VanDerPolDamping,
)
from snrmjax.model.library.friction import (
    CoulombFriction,
    IwanMicroslip,
    JenkinsSlider,
)
from snrmjax.model.library.internal_resonances import (
    InternalResonanceOneToThree,
    InternalResonanceOneToTwo,
)
from snrmjax.model.library.linear_changes import (
    AddedMass,
    FrequencyDrift,
    LinearDampingChange,
    LinearFrequencyShift,
)
from snrmjax.model.library.measurement_chain import (
    CloseMode,
    ForceGainError,
    ForceOffsetError,
    ResidualMode,
    SensorGainError,
    SensorPhaseError,
)
from snrmjax.model.library.stiffness import (
    CubicStiffness,
    GapStiffness,
    OneSidedStop,
    QuadraticStiffness,
    QuinticStiffness,
)

_GAPS = np.linspace(0.05, 0.95, 19)  # over the largest amplitude
_STIFFNESSES = np.log([0.1, 1.0, 10.0, 100.0])  # ln, of a stop, over ω₀²
_QUADRATICS = np.log([0.02, 0.05, 0.12, 0.3])  # ln, over ω₀² and the largest amplitude
_SLIPS = np.linspace(np.log(0.02), np.log(0.95), 28)  # ln, over the largest amplitude
_EXPONENTS = np.linspace(1.1, 2.9, 10)
_DETUNINGS = np.linspace(-0.04, 0.04, 9)
_APART = np.array([-0.3, -0.1, -0.05, -0.02, 0.02, 0.05, 0.1, 0.3])  # of a close mode
_DAMPINGS = np.log([0.5, 2.0])  # ln, of a further mode, over the mode's own
_SAMPLES, _AMPLITUDES = 256, 60  # of a user's own force
_PARTS = 3  # that an interval of a shape is divided into, where it counts


class Column(NamedTuple):
    """One value of the shape parameters of one kind of effect."""

    kind: str
    shape: tuple[float, ...]  # in the units of `describing`
    change: Complex[np.ndarray, " state"]  # of the dynamic stiffness, over ω₀²; largest entry 1
    scale: float  # of that change over the one of strength 1 in the units of `describing`
    sign: int = 0  # that physics gives the strength; 0: either
    std: float | None = None  # 1σ of the strength where it is an instrument's; None: any size
    fraction: float = 1.0  # of its kind's prior
    widths: tuple[float, ...] = ()  # of the intervals that the shape stands for
    start: tuple[float, ...] = ()  # parameters of a user's own force at strength 1

    def divided(self, readings: Readings) -> "list[Column]":
        """Columns for the parts of its intervals."""
        steps = (np.arange(_PARTS) - (_PARTS - 1) / 2) / _PARTS
        parts = []
        for step in itertools.product(steps, repeat=len(self.shape)):
            shape = tuple(s + w * k for s, w, k in zip(self.shape, self.widths, step, strict=True))
            widths = tuple(w / _PARTS for w in self.widths)
            fraction = self.fraction / _PARTS ** len(self.shape)
            parts += _column(readings, self.kind, shape, fraction, widths)
        return parts


class _Law(NamedTuple):
    change: Callable[..., Complex[np.ndarray, " state"]]  # of the readings and a shape
    axes: tuple[np.ndarray, ...] = ()  # values of the shape
    sign: int = 0
    std: float | None = None
    odds: float = 1.0  # over those of a law
    of_instrument: bool = False
    # Parameters of the effect by ω₀, the largest modal amplitude, strength and shape.
    parameters: Callable[..., tuple[float, ...]] | None = None


def _stiffness(power: int) -> Callable[[Readings], np.ndarray]:
    return lambda r: r.relative_amplitude**power + 0j


def _damping(power: int, frequency_power: int) -> Callable[[Readings], np.ndarray]:
    """Of a force ∝ a^(power + 1) Ω^frequency_power."""
    return lambda r: 1j * r.relative_amplitude**power * r.relative_frequency**frequency_power


def _slider(r: Readings, log_slip: float) -> np.ndarray:
    lost, damping = describing.slider(r.relative_amplitude, np.exp(log_slip))
    return lost + 1j * damping


def _iwan(r: Readings, exponent: float) -> np.ndarray:
    lost, damping = describing.masing(exponent)
    return (lost + 1j * damping) * r.relative_amplitude ** (exponent - 1)


def _resonance(order: int) -> Callable[[Readings, float, float], np.ndarray]:
    def change(r: Readings, detuning: float, log_times: float) -> np.ndarray:
        ratio = np.exp(log_times) * max(r.damping_ratio, 1e-4)
        return describing.resonant(
            *(r.relative_amplitude, r.relative_frequency, order, detuning, ratio)
        )

    return change


def _close_mode(r: Readings, apart: float, log_times: float) -> np.ndarray:
    """Of a mode at (1 + `apart`) ω₀ that the force drives too."""
    own, omega = 1 + apart, r.relative_frequency
    ratio = np.exp(log_times) * max(r.damping_ratio, 1e-4)
    return _relative(r) ** 2 / (own**2 - omega**2 + 2j * ratio * own * omega)


def _relative(r: Readings) -> np.ndarray:
    return r.dynamic_stiffness / r.natural_frequency**2


_INSTRUMENT: dict[str, Any] = {"odds": priors.INSTRUMENT, "of_instrument": True}

LAWS: dict[str, _Law] = {
    LinearFrequencyShift.kind: _Law(
        _stiffness(0), parameters=lambda _, b, s: (float(np.sqrt(max(1 + s, 0.0))) - 1,)
    ),
    CubicStiffness.kind: _Law(
        _stiffness(2), parameters=lambda w, b, s: (s * w**2 / (0.75 * b**2),)
    ),
    QuinticStiffness.kind: _Law(
        _stiffness(4), parameters=lambda w, b, s: (s * w**2 / (0.625 * b**4),)
    ),
    QuadraticStiffness.kind: _Law(
        lambda r, log_s: describing.quadratic(
            *(r.relative_amplitude, r.relative_frequency, r.damping_ratio, np.exp(log_s))
        ),
        (_QUADRATICS,),
        1,
        parameters=lambda w, b, s, log_s: (float(np.exp(log_s) * np.sqrt(s)) * w**2 / b,),
    ),
    GapStiffness.kind: _Law(
        lambda r, width: describing.gap(r.relative_amplitude, width) + 0j,
        (_GAPS,),
        1,
        parameters=lambda w, b, s, width: (s * w**2, width * b),
    ),
    OneSidedStop.kind: _Law(
        lambda r, width, log_k: describing.stop(r.relative_amplitude, width, np.exp(log_k)) + 0j,
        (_GAPS[::3], _STIFFNESSES),
        1,
        parameters=lambda w, b, s, width, _: (s * w**2, width * b),
    ),
    LinearDampingChange.kind: _Law(_damping(0, 1), parameters=lambda w, b, s: (s / 2,)),
    QuadraticDamping.kind: _Law(
        _damping(1, 2), sign=1, parameters=lambda w, b, s: (s * 3 * np.pi / (8 * b),)
    ),
    CubicDamping.kind: _Law(_damping(2, 3), parameters=lambda w, b, s: (s / (0.75 * b**2 * w),)),
    VanDerPolDamping.kind: _Law(_damping(2, 1), parameters=lambda w, b, s: (4 * s * w / b**2,)),
    CoulombFriction.kind: _Law(
        _damping(-1, 0), sign=1, parameters=lambda w, b, s: (s * w**2 * np.pi * b / 4,)
    ),
    JenkinsSlider.kind: _Law(
        *(_slider, (_SLIPS,), 1),
        parameters=lambda w, b, s, log_slip: (s * w**2, float(np.exp(log_slip)) * b),
    ),
    IwanMicroslip.kind: _Law(
        *(_iwan, (_EXPONENTS,), 1), parameters=lambda w, b, s, p: (s * w**2 / b ** (p - 1), p)
    ),
    InternalResonanceOneToTwo.kind: _Law(
        _resonance(2), (_DETUNINGS, _DAMPINGS), 1, odds=priors.RESONANCE
    ),
    InternalResonanceOneToThree.kind: _Law(
        _resonance(3), (_DETUNINGS, _DAMPINGS), 1, odds=priors.RESONANCE
    ),
    AddedMass.kind: _Law(
        lambda r: -(r.relative_frequency**2) * priors.ADDED_MASS + 0j,
        std=1.0,
        odds=priors.INSTRUMENT,
    ),
    ForceGainError.kind: _Law(lambda r: _relative(r) * priors.GAIN, std=1.0, **_INSTRUMENT),
    SensorGainError.kind: _Law(
        lambda r: -(r.dynamic_stiffness + r.slope) / r.natural_frequency**2 * priors.GAIN,
        std=1.0,
        **_INSTRUMENT,
    ),
    CloseMode.kind: _Law(_close_mode, (_APART, _DAMPINGS), **_INSTRUMENT),
    ResidualMode.kind: _Law(lambda r: _relative(r) ** 2, **_INSTRUMENT),
    SensorPhaseError.kind: _Law(
        lambda r: -1j * _relative(r) * priors.INSTRUMENT_PHASE, std=1.0, **_INSTRUMENT
    ),
    ForceOffsetError.kind: _Law(
        lambda r: _relative(r) * np.min(r.force) / r.force * priors.FORCE_OFFSET,
        std=1.0,
        **_INSTRUMENT,
    ),
    FrequencyDrift.kind: _Law(lambda r: 2 * r.order * priors.DRIFT + 0j, std=1.0, **_INSTRUMENT),
}
"""Of every kind what it changes in the dynamic stiffness, over ω₀²."""


def hypothesis_columns(readings: Readings, kinds: Iterable[str]) -> list[Column]:
    """The columns of some kinds of effects; kinds that no column states are left out."""
    found: list[Column] = []
    for kind in kinds:
        if kind not in LAWS:
            found += _of_own_force(readings, kind)
            continue
        axes = LAWS[kind].axes
        intervals = [np.gradient(axis) for axis in axes]
        total = np.prod([np.sum(widths) for widths in intervals])
        for shape, widths in zip(
            itertools.product(*axes), itertools.product(*intervals), strict=True
        ):
            fraction = float(np.prod(widths) / total)
            found += _column(readings, kind, shape, fraction, widths)
    return found


def _of_own_force(readings: Readings, kind: str) -> list[Column]:
    """Columns of a force that a user registered, one for each set of parameters that it states.

    By quadrature of its cycle at the natural frequency, between amplitudes by interpolation.
    """
    effect = EFFECTS[kind]
    if not (is_own(kind) and issubclass(effect, AbstractForce)):
        return []
    angle = 2 * np.pi * np.arange(_SAMPLES) / _SAMPLES
    x = readings.relative_amplitude
    grid = np.geomspace(np.min(x), 1.0, _AMPLITUDES)
    q = readings.largest * grid[:, None] * np.cos(angle)
    rate = -readings.natural_frequency * readings.largest * grid[:, None] * np.sin(angle)
    names, starts = tuple(effect.parameters()), starts_of(effect, readings.scales)
    found = []
    for start in starts:
        law: Any = make_effect(kind, dict(zip(names, start, strict=True)))
        force = np.asarray(jax.jit(jax.vmap(law.cycle_force))(q, rate))
        change = 2 * np.mean(force * np.exp(-1j * angle), axis=1) / (readings.largest * grid)
        of_state = np.interp(np.log(x), np.log(grid), change) / readings.natural_frequency**2
        scale = float(np.max(np.abs(of_state), initial=0.0))
        if np.isfinite(scale) and scale > 0:
            fraction = 1 / len(starts)
            one = Column(kind, (), of_state / scale, scale, fraction=fraction, start=start)
            found.append(one)
    return found


def _column(
    readings: Readings,
    kind: str,
    shape: tuple[float, ...],
    fraction: float,
    widths: tuple[float, ...],
) -> list[Column]:
    """One column, or none where it changes nothing."""
    law = LAWS[kind]
    change = law.change(readings, *shape)
    scale = float(np.max(np.abs(change), initial=0.0)) if law.std is None else 1.0
    if not (scale > 0 and np.max(np.abs(change)) > 0):
        return []
    shape, widths = tuple(map(float, shape)), tuple(map(float, widths))
    return [Column(kind, shape, change / scale, scale, law.sign, law.std, fraction, widths)]


def rows_of_columns(readings: Readings, columns: list[Column]) -> Float[np.ndarray, "row column"]:
    """The columns in the units of the readings' rows."""
    changes = np.array([column.change for column in columns])
    return readings.whitened(readings.natural_frequency**2 * changes).T


def parameters_of(readings: Readings, column: Column, strength: float) -> dict[str, float] | None:
    """The effect's parameters by name, in modal units; None where the readings do not give them."""
    law, own = LAWS.get(column.kind), strength / column.scale
    if column.start:
        values: tuple[float, ...] = (own * column.start[0], *column.start[1:])
    elif law is None or law.parameters is None:
        return None
    else:
        values = law.parameters(readings.natural_frequency, readings.largest, own, *column.shape)
    return dict(zip(EFFECTS[column.kind].parameters(), map(float, values), strict=True))


def is_instrument(kind: str) -> bool:
    """Whether a kind is an error of a test and no property of the structure."""
    return kind in LAWS and LAWS[kind].of_instrument


def odds_of(kind: str) -> float:
    """How likely a kind is before a test is seen, over a law of the library."""
    return LAWS[kind].odds if kind in LAWS else 1.0
