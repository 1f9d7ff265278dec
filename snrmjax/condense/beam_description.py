"""A beam or arch by its numbers, before it has finite elements."""

from collections.abc import Mapping
from typing import NamedTuple

from snrmjax.numerics.rules import Rule

SIDES = ("left", "right")
STIFFNESSES = ("axial_n_m", "transverse_n_m", "rotation_nm_rad")

POISSON = Rule("above -1 and below 0.5", lambda value: -1 < value < 0.5)
MOST_RISE = 0.95  # of the length over twice the radius: an arch below a half circle


RISE, RADIUS = "geometry.rise_m", "geometry.radius_m"
LENGTH, THICKNESS = "geometry.length_m", "section.thickness_m"


class BeamDescription(NamedTuple):
    """A beam or arch as its file says.

    `numbers` have the names of tables and keys ("section.thickness_m"), stiffnesses of a support
    "supports.left.rotation_nm_rad" (infinite: held) and point masses "point_mass_1.mass_kg". Those
    that the file does not state are missing.
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


def what_is_loose(numbers: Mapping[str, float]) -> str | None:
    """Which rigid-body motion the two supports leave, in words, or nothing."""
    axial, transverse, rotation = (
        [numbers[f"supports.{side}.{key}"] for side in SIDES] for key in STIFFNESSES
    )
    if not any(axial):
        return "nothing holds the beam along its axis"
    if not any(transverse):
        return "nothing holds the beam across its axis"
    if not (all(transverse) or any(rotation)):
        return "nothing keeps the beam from turning"
    return None
