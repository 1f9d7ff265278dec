"""A beam or arch by its dimensions, and its parameters by their names in the file.

These names are what a study can vary.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float

from snrmjax.condense.elements.beam import rise_of_radius
from snrmjax.numerics.names import suggestion
from snrmjax.numerics.rules import NOT_NEGATIVE, POSITIVE, InputError, Rule

SIDES = ("left", "right")
STIFFNESSES = ("axial_n_m", "transverse_n_m", "rotation_nm_rad")

POISSON = Rule("above -1 and below 0.5", lambda value: -1 < value < 0.5)
MAX_RISE = 0.95  # limit of length over twice the radius: an arch below a half circle


RISE, RADIUS = "geometry.rise_m", "geometry.radius_m"
LENGTH, THICKNESS = "geometry.length_m", "section.thickness_m"
_FIXED = "it is fixed there; to vary its stiffness state one, such as {side} = {{ {key} = 1e6 }}"


class BeamDescription(NamedTuple):
    """A beam or arch as described by its file.

    `numbers` have the names of tables and keys ("section.thickness_m"), stiffnesses of a support
    "supports.left.rotation_nm_rad" (infinite: fixed) and point masses "point_mass_1.mass_kg".
    Optional ones not in the file are missing.
    """

    name: str
    numbers: tuple[tuple[str, float], ...]  # SI units
    elements: int
    modes: tuple[int, ...]  # counted from one
    load_scale: float | None  # thicknesses
    degree: int
    damping_ratio: tuple[float, ...] | None  # one a mode; None: not stated
    sensors: tuple[tuple[str, float], ...]  # names and fractions of the length
    force_at: float | None  # fraction of the length; None: uniform
    masses_at: tuple[float, ...] = ()  # fractions of the length


def unconstrained_motion(numbers: Mapping[str, float]) -> str | None:
    """A rigid-body motion that the two supports leave free, as text, or None."""
    axial, transverse, rotation = (
        [numbers[f"supports.{side}.{key}"] for side in SIDES] for key in STIFFNESSES
    )
    if not any(axial):
        return "nothing fixes the beam along its axis"
    if not any(transverse):
        return "nothing fixes the beam across its axis"
    if not (all(transverse) or any(rotation)):
        return "nothing prevents rotation of the beam"
    return None


def beam_parameters(beam: BeamDescription) -> dict[str, float]:
    """The parameters of a beam by name, in SI units.

    Those of its file, without the stiffness of fixed directions of a support. Every beam has a
    "geometry.rise_m", the height of the arc over its chord, zero if straight.
    """
    with jax.ensure_compile_time_eval():  # concrete within `jit`, too
        rise = float(rise_of(beam))
    return {name: value for name, value in (*beam.numbers, (RISE, rise)) if value != np.inf}


def rise_of(beam: BeamDescription) -> float | Float[Array, ""]:
    """Height of the arc over its chord, m."""
    numbers = dict(beam.numbers)
    if RADIUS in numbers:
        return rise_of_radius(numbers[LENGTH], numbers[RADIUS])
    return numbers[RISE]


def check_beam_name(beam: BeamDescription, name: str, file: str, further: tuple[str, ...]) -> None:
    """Check that a name is one of the beam's parameters or of `further` ones.

    Raises `ValueError` with the reason and a near miss.
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
    elif table == "supports" and side in SIDES and key in STIFFNESSES:
        why = f"{name} cannot vary in {file}: {_FIXED.format(side=side, key=key)}."
    else:
        # "thickness_m" alone, too, is near to "section.thickness_m".
        ends = {parameter.rpartition(".")[2]: parameter for parameter in reversed(known)}
        near = suggestion(ends.get(name, name), known, 0.5) or f"; it has {', '.join(known[:6])}, …"
        why = f"the beam of {file} does not have the parameter {name!r}{near}."
    raise InputError(why)


def beam_rules(beam: BeamDescription, name: str, varied: tuple[str, ...]) -> tuple[Rule, ...]:
    """Rules of a parameter, as in the file; relative to others that do not vary."""
    if name.startswith(("supports.", "point_mass_")) or name == RISE:
        return (NOT_NEGATIVE,)
    if name == "material.poisson":
        return (POISSON,)
    rules, numbers = [POSITIVE], dict(beam.numbers)
    if not {THICKNESS, LENGTH} <= set(varied):
        if name == THICKNESS:
            rules.append(_below("the length", numbers[LENGTH]))
        if name == LENGTH:
            rules.append(_above("the thickness", numbers[THICKNESS]))
    if RADIUS in numbers and not {RADIUS, LENGTH} <= set(varied):
        if name == LENGTH and RISE not in varied:
            rules.append(_below("what the radius allows", 2 * MAX_RISE * numbers[RADIUS]))
        if name == RADIUS:
            rules.append(_above("what the length allows", numbers[LENGTH] / (2 * MAX_RISE)))
    return tuple(rules)


def with_beam_parameters(beam: BeamDescription, values: Mapping[str, Any]) -> BeamDescription:
    """The beam with other parameter values, unchecked and differentiable.

    A rise replaces the radius.
    """
    numbers: dict[str, Any] = {**dict(beam.numbers), **values}
    if RISE in values:
        numbers.pop(RADIUS, None)
    return beam._replace(numbers=tuple(numbers.items()))


def require_beam(beam: BeamDescription) -> None:
    """Raises `ValueError` for inconsistent parameters."""
    numbers = dict(beam.numbers)
    length, thickness, radius = numbers[LENGTH], numbers[THICKNESS], numbers.get(RADIUS)
    if not thickness < length:
        raise InputError(f"the thickness ({thickness:g} m) is not below the length ({length:g} m).")
    if radius is not None and not length < 2 * MAX_RISE * radius:
        raise InputError(
            f"a radius of {radius:g} m is too small for a length of {length:g} m: the "
            "arch must stay below a half circle."
        )
    if not 2 * rise_of(beam) < length:
        raise InputError(
            f"a rise of {rise_of(beam):g} m is too large for a length of {length:g} m: the "
            "arch must stay below a half circle."
        )
    loose = unconstrained_motion(numbers)
    if loose is not None:
        raise InputError(f"the supports leave a mechanism: {loose}.")


def _below(what: str, limit: float) -> Rule:
    return Rule(f"below {what} ({limit:g})", lambda value: value < limit)


def _above(what: str, limit: float) -> Rule:
    return Rule(f"above {what} ({limit:g})", lambda value: value > limit)
