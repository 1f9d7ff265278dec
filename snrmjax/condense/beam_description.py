"""Description of a beam or arch by its dimensions, before meshing."""

from collections.abc import Mapping
from typing import NamedTuple

from snrmjax.numerics.rules import Rule

SIDES = ("left", "right")
STIFFNESSES = ("axial_n_m", "transverse_n_m", "rotation_nm_rad")

POISSON = Rule("above -1 and below 0.5", lambda value: -1 < value < 0.5)
MAX_RISE = 0.95  # limit of length over twice the radius: an arch below a half circle


RISE, RADIUS = "geometry.rise_m", "geometry.radius_m"
LENGTH, THICKNESS = "geometry.length_m", "section.thickness_m"


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
