"""The numbers of a beam by name, as its file names them: what a study of beams varies."""

from collections.abc import Mapping
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Float

from snrmjax.condense.elements.beam import rise_of_radius
from snrmjax.io.files import suggestion
from snrmjax.io.reduction.beam_file import (
    MOST_RISE,
    POISSON,
    STIFFNESSES,
    BeamDescription,
    what_is_loose,
)
from snrmjax.numerics.rules import NOT_NEGATIVE, POSITIVE, Rule

RISE, RADIUS = "geometry.rise_m", "geometry.radius_m"

_FIELDS = {
    "material.young_pa": "young",
    "material.density_kg_m3": "density",
    "material.poisson": "poisson",
    "section.width_m": "width",
    "section.thickness_m": "thickness",
    "geometry.length_m": "length",
    RADIUS: "radius",
}
_SIDES = ("left", "right")
_MASSES = {"mass_kg": "mass", "inertia_kg_m2": "inertia"}
_HELD = "it is held there; to vary its stiffness state one, such as {side} = {{ {key} = 1e6 }}"


def beam_parameters(beam: BeamDescription) -> dict[str, float]:
    """The numbers of a beam that may vary, by name.

    Tables and keys of the file ("section.thickness_m"), stiffnesses of a support as
    "supports.left.rotation_nm_rad" and point masses as "point_mass_1.mass_kg". Every beam has a
    "geometry.rise_m", the height of the arc over its chord, zero where it is straight. A direction
    in which a support holds the beam has no stiffness.

    Returns values in SI units.
    """
    values = {name: getattr(beam, field) for name, field in _FIELDS.items()}
    with jax.ensure_compile_time_eval():  # what the file states has a value within `jit`, too
        values[RISE] = float(rise_of(beam))
    for side, support in zip(_SIDES, beam.supports, strict=True):
        own = zip(STIFFNESSES, support, strict=True)
        values |= {f"supports.{side}.{key}": size for key, size in own if size != np.inf}
    for k, point in enumerate(beam.point_masses):
        values |= {f"point_mass_{k + 1}.{key}": getattr(point, f) for key, f in _MASSES.items()}
    return {name: value for name, value in values.items() if value is not None}


def rise_of(beam: BeamDescription) -> float | Float[Array, ""]:
    """Height of the arc over its chord, m."""
    return beam.rise if beam.radius is None else rise_of_radius(beam.length, beam.radius)


def check_beam_name(beam: BeamDescription, name: str, file: str, further: tuple[str, ...]) -> None:
    """Refuse a name that is none of the beam's numbers, nor among `further` ones.

    Raises `ValueError` that says why, with a near miss.
    """
    known = (*beam_parameters(beam), *further)
    if name in known:
        return
    table, _, rest = name.partition(".")
    side, _, key = rest.partition(".")
    if name == RADIUS:
        why = f"{name} cannot vary: the beam of {file} states none; vary {RISE}, or state a radius."
    elif name == "material.poisson":
        why = f"{name} cannot vary: {file} states none, which means no shear deformation."
    elif table == "supports" and side in _SIDES and key in STIFFNESSES:
        why = f"{name} cannot vary in {file}: {_HELD.format(side=side, key=key)}."
    else:
        # "thickness_m" alone, too, is near to "section.thickness_m".
        ends = {one.rpartition(".")[2]: one for one in reversed(known)}
        near = suggestion(ends.get(name, name), known, 0.5) or f"; it has {', '.join(known[:6])}, …"
        why = f"the beam of {file} does not have the parameter {name!r}{near}."
    raise ValueError(why)


def beam_rules(beam: BeamDescription, name: str, varied: tuple[str, ...]) -> tuple[Rule, ...]:
    """What a number of a beam must be, as in its file; against others that do not vary."""
    if name.startswith(("supports.", "point_mass_")) or name == RISE:
        return (NOT_NEGATIVE,)
    if name == "material.poisson":
        return (POISSON,)
    rules = [POSITIVE]
    if not {"section.thickness_m", "geometry.length_m"} <= set(varied):
        if name == "section.thickness_m":
            rules.append(_below("the length", beam.length))
        if name == "geometry.length_m":
            rules.append(_above("the thickness", beam.thickness))
    if beam.radius is not None and not {RADIUS, "geometry.length_m"} <= set(varied):
        if name == "geometry.length_m" and RISE not in varied:
            rules.append(_below("what the radius allows", 2 * MOST_RISE * beam.radius))
        if name == RADIUS:
            rules.append(_above("what the length allows", beam.length / (2 * MOST_RISE)))
    return tuple(rules)


def with_beam_parameters(beam: BeamDescription, values: Mapping[str, Any]) -> BeamDescription:
    """The beam with other numbers, which derivatives may be taken by; nothing is checked.

    A rise replaces the radius.
    """
    supports: list[Any] = list(beam.supports)
    points: list[Any] = list(beam.point_masses)
    fields: dict[str, Any] = {}
    for name, value in values.items():
        table, _, rest = name.partition(".")
        if table == "supports":
            side, _, key = rest.partition(".")
            k = _SIDES.index(side)
            supports[k] = supports[k]._replace(**{key.split("_")[0]: value})
        elif table.startswith("point_mass_"):
            k = int(table.rsplit("_", 1)[1]) - 1
            points[k] = points[k]._replace(**{_MASSES[rest]: value})
        elif name == RISE:
            fields |= {"rise": value, "radius": None}
        else:
            fields[_FIELDS[name]] = value
    left, right = supports
    return beam._replace(supports=(left, right), point_masses=tuple(points), **fields)


def require_beam(beam: BeamDescription) -> None:
    """Raises `ValueError` for numbers that no beam has together."""
    if not beam.thickness < beam.length:
        raise ValueError(
            f"the thickness ({beam.thickness:g} m) is not below the length ({beam.length:g} m)."
        )
    if beam.radius is not None and not beam.length < 2 * MOST_RISE * beam.radius:
        raise ValueError(
            f"a radius of {beam.radius:g} m is too small for a length of {beam.length:g} m: the "
            "arch must stay below a half circle."
        )
    if not 2 * rise_of(beam) < beam.length:
        raise ValueError(
            f"a rise of {rise_of(beam):g} m is too large for a length of {beam.length:g} m: the "
            "arch must stay below a half circle."
        )
    loose = what_is_loose(*beam.supports)
    if loose is not None:
        raise ValueError(f"the supports leave a mechanism: {loose}.")


def _below(what: str, limit: float) -> Rule:
    return Rule(f"below {what} ({limit:g})", lambda value: value < limit)


def _above(what: str, limit: float) -> Rule:
    return Rule(f"above {what} ({limit:g})", lambda value: value > limit)
