"""Beams and arches as TOML: what `snrmjax rom beam.toml` reads.

name = "flat beam"
[material]
young_pa = 204.8e9
density_kg_m3 = 7870.0
poisson = 0.29
[section]
width_m = 0.0127
thickness_m = 0.000508
[geometry]
length_m = 0.2286
radius_m = 11.43                     # or rise_m, height over the chord; neither: straight
elements = 40
[supports]
left = "clamped"                     # "clamped", "pinned", "free" or stiffnesses (inf: fixed)
right = { axial_n_m = 1e6, transverse_n_m = inf, rotation_nm_rad = 50.0 }
[condense]
modes = [1, 3, 5]
load_scale = 0.3                     # thicknesses, optional
degree = 3
damping_ratio = [0.05, 0.001, 0.001] # optional, one number or one a mode
[sensors]
midspan = 0.5                        # fraction of the length
[force]
distribution = "uniform"             # or: at = 0.5
[[point_mass]]                       # optional, any number of them
at = 0.25                            # fraction of the length
mass_kg = 1e-3
inertia_kg_m2 = 2e-8                 # optional, about the axis of bending
"""

import numpy as np

from snrmjax.condense.beam_models import BeamModels
from snrmjax.condense.beam_parameters import (
    LENGTH,
    MAX_RISE,
    POISSON,
    RADIUS,
    RISE,
    SIDES,
    STIFFNESSES,
    THICKNESS,
    BeamDescription,
    unconstrained_motion,
)
from snrmjax.condense.beam_source import beam_source
from snrmjax.condense.reduction import ReductionSource, run_load_cases
from snrmjax.io.files import FilePath, file_name, read_text
from snrmjax.io.toml_table import TomlTable, parsed_toml
from snrmjax.numerics.rules import BELOW_ONE, FRACTION, NOT_NEGATIVE, POSITIVE, InputError

MOST_ELEMENTS = 400
SUPPORTS = ("clamped", "pinned", "free")
_TABLES = ("material", "section", "geometry", "supports", "condense", "sensors", "force")
_POINT_MASS = "point_mass"


def read_beam_description(path: FilePath) -> BeamDescription:
    """Read a beam from a TOML in the format at the top of this module.

    Raises `ValueError` that names file, table, key, value and expectation, with a suggestion for a
    misspelt key.
    """
    file = file_name(path)
    top = parsed_toml(read_text(path), file)
    top.check_keys(_TABLES[:5], ("name", *_TABLES[5:], _POINT_MASS))
    material, section, geometry, supports, of_modes, sensors, force = (
        top.table(name, f"[{name}] of {file}") for name in _TABLES
    )
    material.check_keys(("young_pa", "density_kg_m3"), ("poisson",))
    section.check_keys(("width_m", "thickness_m"))
    geometry.check_keys(("length_m", "elements"), ("radius_m", "rise_m"))
    supports.check_keys(("left", "right"))
    of_modes.check_keys(("modes",), ("load_scale", "degree", "damping_ratio"))
    numbers = {
        "material.young_pa": material.number("young_pa", POSITIVE),
        "material.density_kg_m3": material.number("density_kg_m3", POSITIVE),
    }
    if "poisson" in material.entries:
        numbers["material.poisson"] = material.number("poisson", POISSON)
    numbers["section.width_m"] = section.number("width_m", POSITIVE)
    numbers |= _geometry(geometry, section)
    for side in SIDES:
        springs = zip(STIFFNESSES, _support(supports, side), strict=True)
        numbers |= {f"supports.{side}.{key}": stiffness for key, stiffness in springs}
    missing = unconstrained_motion(numbers)  # a mechanism has no static load cases
    if missing is not None:
        raise InputError(f"{supports.location} leave a mechanism: {missing}.")
    masses_at = []
    for k, mass in enumerate(top.tables(_POINT_MASS, file), 1):
        mass.check_keys(("at", "mass_kg"), ("inertia_kg_m2",))
        masses_at.append(mass.number("at", FRACTION))
        numbers[f"point_mass_{k}.mass_kg"] = mass.number("mass_kg", NOT_NEGATIVE)
        inertia = mass.number("inertia_kg_m2", NOT_NEGATIVE, default=0.0)
        numbers[f"point_mass_{k}.inertia_kg_m2"] = inertia
    elements = geometry.whole("elements", 2)
    if elements > MOST_ELEMENTS:
        raise geometry.refusal("elements", f"at most {MOST_ELEMENTS}", elements)
    modes = of_modes.mode_numbers("modes")
    if len(modes) > 8:
        raise of_modes.refusal("modes", "at most 8 modes", list(modes))
    if max(modes) > elements:
        expected = f"mode numbers that {elements} elements can represent (at most {elements})"
        raise of_modes.refusal("modes", expected, max(modes))
    degree = of_modes.whole("degree", 2, 3)
    if degree > 7:
        raise of_modes.refusal("degree", "from 2 to 7", degree)
    scaled = "load_scale" in of_modes.entries
    positions = tuple((name, sensors.number(name, FRACTION)) for name in sensors.entries)
    damping = of_modes.numbers_of_modes("damping_ratio", len(modes), BELOW_ONE)
    return BeamDescription(
        name=top.text("name", file.removesuffix(".toml")),
        numbers=tuple(numbers.items()),
        elements=elements,
        modes=modes,
        load_scale=of_modes.number("load_scale", POSITIVE) if scaled else None,
        degree=degree,
        damping_ratio=None if damping is None else tuple(damping),
        sensors=positions or (("midspan", 0.5),),
        force_at=_force(force),
        masses_at=tuple(masses_at),
    )


def read_beam(path: FilePath) -> ReductionSource:
    """Read a beam and prepare its finite elements, modes and load cases.

    Forces are transverse; a uniform force is one newton distributed over the length.
    Raises `ValueError` as `read_beam_description` does, and where the elements have no such modes
    or a sensor or force is at a node of all of them.
    """
    return beam_source(read_beam_description(path), file_name(path))


def read_beam_models(path: FilePath) -> BeamModels:
    """Read a beam file as a function from its numbers to reduced models.

    Typical use: `models = sj.io.read_beam_models("beam.toml")`, then
    `models({"section.thickness_m": 0.6e-3})`, directly, within `jax.grad`, in a study, or in
    `sj.identify.calibrate_to_backbone`.
    Returns the models. Raises `ValueError` as `read_beam` does, and where no load scale is stated
    and none can be determined for the beam.
    """
    stated, file = read_beam_description(path), file_name(path)
    source = beam_source(stated, file)
    displacement, _ = run_load_cases(source)
    thickness = dict(stated.numbers)[THICKNESS]
    return BeamModels(stated, file, tuple((np.asarray(displacement) / thickness).tolist()))


def is_beam_file(path: FilePath) -> bool:
    """Whether a TOML describes a beam and not a model, by its tables.

    Raises `ValueError` where it cannot be read.
    """
    top = parsed_toml(read_text(path), file_name(path))
    return "mode" not in top.entries and any(name in top.entries for name in _TABLES[:5])


def _geometry(geometry: TomlTable, section: TomlTable) -> dict[str, float]:
    """Length, thickness and the stated curvature."""
    length = geometry.number("length_m", POSITIVE)
    thickness = section.number("thickness_m", POSITIVE)
    if not thickness < length:
        raise section.refusal("thickness_m", f"below the length ({length:g})", thickness)
    rise = geometry.number("rise_m", NOT_NEGATIVE, default=0.0)
    if not 2 * rise < length:
        raise geometry.refusal("rise_m", f"below half of the length ({length / 2:.4g})", rise)
    known = {THICKNESS: thickness, LENGTH: length}
    if "radius_m" not in geometry.entries:
        return {**known, RISE: rise}
    if "rise_m" in geometry.entries:
        raise InputError(f"{geometry.location} has both `radius_m` and `rise_m`: one is enough.")
    radius = geometry.number("radius_m", POSITIVE)
    if not length < 2 * MAX_RISE * radius:
        raise geometry.refusal("radius_m", f"above {length / (2 * MAX_RISE):.4g}", radius)
    return {**known, RADIUS: radius}


def _support(table: TomlTable, side: str) -> tuple[float, ...]:
    """Stiffnesses along the chord, across it and in rotation; infinite is fixed, zero free."""
    value = table.entries[side]
    if isinstance(value, dict):
        springs = TomlTable(value, f"{side} of {table.location}")
        springs.check_keys((), STIFFNESSES)
        if not value:
            raise table.refusal(side, f"a support or stiffnesses ({', '.join(STIFFNESSES)})", value)
        return tuple(_stiffness(springs, key) for key in STIFFNESSES)
    kind = table.choice(side, SUPPORTS)
    translational = np.inf if kind != "free" else 0.0
    return translational, translational, np.inf if kind == "clamped" else 0.0


def _stiffness(springs: TomlTable, key: str) -> float:
    if springs.entries.get(key) == np.inf:
        return np.inf
    return springs.number(key, NOT_NEGATIVE, default=0.0)


def _force(table: TomlTable) -> float | None:
    table.check_keys((), ("distribution", "at"))
    if "distribution" in table.entries and "at" in table.entries:
        raise InputError(
            f"{table.location} has both `distribution` and `at`: one of them is enough."
        )
    if "at" in table.entries:
        return table.number("at", FRACTION)
    table.choice("distribution", ("uniform",), "uniform")
    return None
