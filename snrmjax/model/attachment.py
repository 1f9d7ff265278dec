"""Attachment of a force: its influence vector over the points of a structure."""

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from snrmjax.numerics.rules import InputError

InfluenceVector = tuple[tuple[str, float], ...]
"""Points with their weights b: a force acts on x = Σ b x_point and exerts b f on every point."""


def between(point: str, other: str) -> InfluenceVector:
    """Influence vector of a force between two points, which acts on their relative motion.

    >>> between("tip", "root")
    (('tip', 1.0), ('root', -1.0))
    """
    return influence_vector({point: 1.0, other: -1.0} if point != other else [(point, 1.0)] * 2)


def influence_vector(
    at: str | Mapping[str, float] | Iterable[tuple[str, float]],
) -> InfluenceVector:
    """An influence vector from a point's name, or from points with their weights.

    Raises `ValueError` for no point, a repeated point and a weight that is zero or not a number.
    """
    pairs: Any = (
        [(at, 1.0)] if isinstance(at, str) else list(at.items() if isinstance(at, Mapping) else at)
    )
    if not pairs:
        raise InputError("`at` must name at least one point, but is empty.")
    influence: list[tuple[str, float]] = []
    for name, weight in pairs:
        if not isinstance(weight, float | int | np.number) or not 0 < abs(float(weight)) < np.inf:
            raise InputError(f"the weight of {name!r} in `at` must be a number, but is {weight!r}.")
        if any(name == other for other, _ in influence):
            raise InputError(
                f"`at` names the point {name!r} twice: a force needs two different points."
            )
        influence.append((str(name), float(weight)))
    return tuple(influence)


def checked_influence_vector(at: Any) -> InfluenceVector | None:
    """The influence vector, or None for a force on the mode of interest."""
    return None if at is None else influence_vector(at)


def influence_text(influence: InfluenceVector) -> str:
    """An influence vector as text: "tip", "tip - root" or "2 tip - root"."""
    parts = [
        ("- " if weight < 0 else "+ ") + ("" if abs(weight) == 1 else f"{abs(weight):g} ") + name
        for name, weight in influence
    ]
    return " ".join(parts).removeprefix("+ ")


_UNITS = {
    "1": "1",
    "kg^1/2 m": "m",
    "kg^1/2 m/s": "m/s",
    "kg^1/2 m/s²": "N",
    "1/s": "N s/m",
    "1/s²": "N/m",
    "1/(kg^1/2 m s²)": "N/m²",
    "1/(kg m² s²)": "N/m³",
    "1/(kg² m⁴ s²)": "N/m⁵",
    "1/(kg^1/2 m)": "N s²/m²",
    "s/(kg m²)": "N s³/m³",
    "1/(kg m² s)": "N s/m³",
    "(kg^1/2 m)^(1-exponent)/s²": "N/m^exponent",
}


def unit_at(influence: InfluenceVector | None, unit: str) -> str:
    """The unit of a parameter of a force at points, from its unit on the mode of interest.

    For a user's own effect, N replaces kg^1/2 m/s² and m replaces kg^1/2 m.

    >>> unit_at(between("tip", "root"), "1/s²")
    'N/m'
    """
    return unit if influence is None else _UNITS.get(unit, f"({unit}, in N and m)")
