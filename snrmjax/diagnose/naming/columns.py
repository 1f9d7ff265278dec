"""First-order change of the readings by every hypothesis of a diagnosis: one column each.

A nonlinear parameter (a gap, an exponent) has a column for each value of a grid.
"""

import itertools
from collections.abc import Iterable
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Complex

from snrmjax.diagnose.kinds.registry import hypothesis_of, starts_of
from snrmjax.diagnose.readings import Readings
from snrmjax.model.effect_base import AbstractForce
from snrmjax.model.effects import EFFECTS, is_own, make_effect
from snrmjax.numerics.compiled import compiled

_SAMPLES, _AMPLITUDES = 256, 60  # for a user's own force
_NO_STRENGTH = 1e-6  # shape below which a change is that of any small strength
_PARTS = 3  # of a shape's interval, when refined


class Column(NamedTuple):
    """One kind of effect at one value of its shape parameters."""

    kind: str
    shape: tuple[float, ...]  # in the units of `describing`
    change: Complex[np.ndarray, " state"]  # of the dynamic stiffness, over ω₀²; largest entry 1
    higher: Complex[np.ndarray, "order state"]  # of its other recorded harmonics, likewise
    scale: float  # divisor of that change: strength 1 in the units of `describing`
    limits: tuple[float, float] = (-np.inf, np.inf)  # of the strength
    std: float | None = None  # 1σ of the strength of an instrument error; None: over `STRENGTHS`
    fraction: float = 1.0  # weight within its kind's prior
    widths: tuple[float, ...] = ()  # of the intervals about the shape
    start: tuple[float, ...] = ()  # parameters of a user's own force at strength 1

    def divided(self, readings: Readings) -> "list[Column]":
        """Columns of the refined grid within its intervals."""
        n = len(self.widths)
        steps = (np.arange(_PARTS) - (_PARTS - 1) / 2) / _PARTS
        parts = []
        for step in itertools.product(steps, repeat=n):
            shifted = zip(self.shape[:n], self.widths, step, strict=True)
            shape = (*(s + w * k for s, w, k in shifted), *self.shape[n:])
            widths = tuple(w / _PARTS for w in self.widths)
            parts += _column(readings, self.kind, shape, self.fraction / _PARTS**n, widths)
        return parts

    def exact_at(self, readings: Readings, strength: float) -> "Column":
        """The column with the change exact for a strength within its limits, where that matters."""
        value = float(np.clip(strength, *self.limits)) * (hypothesis_of(self.kind).unit or 0.0)
        if abs(value) < _NO_STRENGTH:
            return self
        found = _column(readings, self.kind, (value,), self.fraction, ())
        return found[0]._replace(limits=self.limits) if found else self


def hypothesis_columns(readings: Readings, kinds: Iterable[str]) -> list[Column]:
    """The columns of some kinds of effects; kinds without columns are left out."""
    columns: list[Column] = []
    for kind in kinds:
        law = hypothesis_of(kind)
        if law.change is None:
            columns += _of_own_force(readings, kind)
            continue
        if law.unit is not None:
            columns += _by_strength(readings, kind, law.axes[0], law.unit)
            continue
        axes, choices = law.axes, law.choices if readings.harmonics else law.choices[:1]
        intervals = [np.gradient(axis) for axis in axes]
        total = np.prod([np.sum(widths) for widths in intervals]) * max(len(choices), 1)
        for shape, widths in zip(
            itertools.product(*axes), itertools.product(*intervals), strict=True
        ):
            fraction = float(np.prod(widths) / total)
            for last in ((choice,) for choice in choices) if choices else ((),):
                columns += _column(readings, kind, (*shape, *last), fraction, widths)
    return columns


def _by_strength(readings: Readings, kind: str, axis: np.ndarray, unit: float) -> list[Column]:
    """Columns that are exact for a strength each, and stand for those nearest to it."""
    middles = (axis[:-1] + axis[1:]) / (2 * unit)
    limits = itertools.pairwise([-np.inf, *map(float, middles), np.inf])
    return [
        column._replace(limits=between)
        for value, between in zip(axis, limits, strict=True)
        for column in _column(readings, kind, (float(value),), 1.0, ())
    ]


def _of_own_force(readings: Readings, kind: str) -> list[Column]:
    """Columns of a user-registered force, one for each of its sets of starting parameters.

    By quadrature over a cycle at the natural frequency, interpolated between amplitudes.
    """
    effect = EFFECTS[kind]
    if not (is_own(kind) and issubclass(effect, AbstractForce)):
        return []
    angle = 2 * np.pi * np.arange(_SAMPLES) / _SAMPLES
    x = readings.relative_amplitude
    grid = np.geomspace(np.min(x), 1.0, _AMPLITUDES)
    q = readings.largest * grid[:, None] * np.cos(angle)
    rate = -readings.natural_frequency * readings.largest * grid[:, None] * np.sin(angle)
    names, starts = tuple(effect.parameters()), starts_of(kind, readings.scales)
    columns = []
    for start in starts:
        law: Any = make_effect(kind, dict(zip(names, start, strict=True)))
        force = np.asarray(_cycle_forces(law, q, rate))
        unit = readings.natural_frequency**2 * readings.largest * grid
        of_states = []
        for order in (1, *(one.order for one in readings.harmonics)):
            change = 2 * np.mean(force * np.exp(-1j * order * angle), axis=1) / unit
            of_states.append(np.interp(np.log(x), np.log(grid), change))
        changes = of_states[0], np.array(of_states[1:]).reshape(-1, len(x))
        columns += _scaled(kind, *changes, fraction=1 / len(starts), start=start)
    return columns


@compiled
def _cycle_forces(law: AbstractForce, q: Array, rate: Array) -> Array:
    return jax.vmap(law.cycle_force)(q, rate)


def _column(
    readings: Readings,
    kind: str,
    shape: tuple[float, ...],
    fraction: float,
    widths: tuple[float, ...],
) -> list[Column]:
    """One column, or none if it changes nothing."""
    law = hypothesis_of(kind)
    higher = np.zeros((len(readings.harmonics), len(readings.force)), complex)
    if law.change is None:
        return []
    change = law.change(readings, *shape)
    if law.higher is not None:
        for index, one in enumerate(readings.harmonics):
            higher[index] = law.higher(readings, one, *shape)
    shapes = {"shape": tuple(map(float, shape)), "widths": tuple(map(float, widths))}
    limits = (-np.inf if law.sign <= 0 else 0.0, np.inf if law.sign >= 0 else 0.0)
    return _scaled(kind, change, higher, fraction=fraction, limits=limits, std=law.std, **shapes)


def _scaled(
    kind: str,
    change: Complex[np.ndarray, " state"],
    higher: Complex[np.ndarray, "order state"],
    *,
    std: float | None = None,
    shape: tuple[float, ...] = (),
    **numbers: Any,
) -> list[Column]:
    """A column scaled to a largest entry of 1, or none if it changes nothing."""
    largest = np.max(np.abs(change), initial=0.0) or np.max(np.abs(higher), initial=0.0)
    scale = 1.0 if std is not None else float(largest)
    if not (np.isfinite(scale) and largest > 0):
        return []
    return [Column(kind, shape, change / scale, higher / scale, scale, std=std, **numbers)]


def parameters_of(readings: Readings, column: Column, strength: float) -> dict[str, float] | None:
    """The effect's parameters by name, in modal units; None if readings do not determine them."""
    law, own = hypothesis_of(column.kind), strength / column.scale
    if column.start:
        values: tuple[float, ...] = (own * column.start[0], *column.start[1:])
    elif law.parameters is None:
        return None
    else:
        values = law.parameters(readings, own, *column.shape)
    return dict(zip(EFFECTS[column.kind].parameters(), map(float, values), strict=True))
