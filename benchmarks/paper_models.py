"""The method paper's two numerical beams, condensed anew and set beside every printed coefficient.

Run: python benchmarks/paper_models.py [--scale S] [--folder FOLDER] [--table TABLE.md] [--only X]

Kwarta & Allen, Tabs. 1 to 4 and A.1: a flat clamped beam (40 elements, bending modes 1, 3, 5 and 7)
and a curved one (400 shell elements, mode 1). Each is condensed from CalculiX beams and shells of
several kinds, with and without Poisson's effect across the width, and from the built-in elements.
Loads move single modes by `--scale` thicknesses (default: the package's own rule, the nonlinear
force 2 % of the linear one). One JSON line a model: frequencies, ratios to the print, misfit,
seconds; `--table` writes all coefficients side by side. Jobs found in the folder are not run again.
Without CalculiX its columns are left out.
"""

import shutil
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from harness import options, teller

from snrmjax.condense import Beam as FiniteElements
from snrmjax.condense import (
    ReductionBasis,
    StaticCases,
    beam_modes,
    displacement_for_ratio,
    modal_loads,
    reduced_model,
    rise_of_radius,
    shape_at,
    static_cases,
)
from snrmjax.io import calculix
from snrmjax.model.builders.beams import curved_beam, flat_beam
from snrmjax.model.potential import monomial_key
from snrmjax.model.structures import Structure

tell = teller(__file__)

HERTZ = 2 * np.pi


class PaperBeam(NamedTuple):
    """A beam of the paper: geometry (m), material, and what is printed of its model."""

    length: float
    width: float
    thickness: float
    radius: float  # m; infinite: straight
    young: float
    density: float
    poisson: float
    printed: Structure


BEAMS = {
    # Tab. 1 gives the shear modulus, 80 GPa.
    "flat": PaperBeam(
        *(0.2286, 0.0127, 0.787e-3, np.inf, 204.8e9, 7870.0, 204.8 / 160 - 1), flat_beam()
    ),
    "curved": PaperBeam(
        *(0.3048, 0.0127, 0.508e-3, 11.43, 204e9, 7860.0, 0.29), curved_beam("as_printed")
    ),
}


class Condensed(NamedTuple):
    """A beam condensed anew; modes signed as the paper's."""

    frequency: np.ndarray  # Hz
    midspan: np.ndarray  # kg^-1/2
    participation: np.ndarray  # of one newton on every free node, kg^-1/2
    force: dict[str, float]  # coefficients of the potential by monomial
    misfit: float
    cases: int
    seconds: float  # of all, load cases included
    job_seconds: float  # of one load case


def strip_deck(beam: PaperBeam, kind: str, along: int, across: int, poisson: float) -> str:
    """A clamped strip of beam (B32R) or shell elements (S4, S8R), its middle bulging to -z."""
    quadratic = kind != "S4"
    nx, ny = (2 * along if quadratic else along), (2 * across if quadratic else across)
    is_beam = kind.startswith("B")
    number: dict[tuple[int, int], int] = {}
    rows = []
    for i in range(nx + 1):
        for j in [0] if is_beam else range(ny + 1):
            if quadratic and i % 2 and j % 2:
                continue
            number[i, j] = len(number) + 1
            s = beam.length * (i / nx - 0.5)
            x, z = s, 0.0
            if np.isfinite(beam.radius):
                half = beam.length / 2 / beam.radius
                x = beam.radius * np.sin(s / beam.radius)
                z = -beam.radius * (np.cos(s / beam.radius) - np.cos(half))
            y = 0.0 if is_beam else beam.width * (j / ny - 0.5)
            rows.append(f"{number[i, j]}, {x:.10g}, {y:.10g}, {z:.10g}")
    elements = []
    for i in range(along):
        for j in [0] if is_beam else range(across):
            if is_beam:
                corners = [(2 * i, 0), (2 * i + 1, 0), (2 * i + 2, 0)]
            elif quadratic:
                a, b = 2 * i, 2 * j
                corners = [(a, b), (a + 2, b), (a + 2, b + 2), (a, b + 2)]
                corners += [(a + 1, b), (a + 2, b + 1), (a + 1, b + 2), (a, b + 1)]
            else:
                corners = [(i, j), (i + 1, j), (i + 1, j + 1), (i, j + 1)]
            elements.append(", ".join(str(number[c]) for c in corners))
    section = f"*SHELL SECTION, ELSET=ALL, MATERIAL=STEEL\n{beam.thickness}"
    if is_beam:
        section = "*BEAM SECTION, ELSET=ALL, MATERIAL=STEEL, SECTION=RECT\n"
        section += f"{beam.thickness}, {beam.width}\n0., 0., 1."
        if np.isfinite(beam.radius):  # along y, which every element has at a right angle
            section = section.replace(f"{beam.thickness}, {beam.width}\n0., 0., 1.", "")
            section += f"{beam.width}, {beam.thickness}\n0., 1., 0."
    ends = [str(n) for (i, _), n in number.items() if i in (0, nx)]
    return "\n".join(
        [
            *("*NODE, NSET=ALL", *rows, f"*ELEMENT, TYPE={kind}, ELSET=ALL"),
            *(f"{e + 1}, {row}" for e, row in enumerate(elements)),
            *("*MATERIAL, NAME=STEEL", "*ELASTIC", f"{beam.young}, {poisson}"),
            *("*DENSITY", f"{beam.density}", section, "*BOUNDARY"),
            *(f"{n}, 1, 6" for n in ends),
            "",
        ]
    )


def by_calculix(
    beam: PaperBeam,
    kind: str,
    mesh: tuple[int, int],
    poisson: float,
    scale: float | None,
    folder: Path,
) -> Condensed:
    """Condense a beam from CalculiX's elements."""
    begin = time.perf_counter()
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "deck.inp"
    path.write_text(strip_deck(beam, kind, *mesh, poisson), encoding="utf-8")
    deck = calculix.read_deck(path)
    n = beam.printed.n_modes
    # Symmetric bending: those that a uniform acceleration in z drives, and that bend in z only.
    survey = calculix.survey_modes(deck, 3 if n == 1 else 16, folder)
    mass = survey.effective_mass
    driven = np.flatnonzero((survey.carried > 0.9) & (mass[:, 2] > 1e-4 * mass[:, 2].max()))
    modes = calculix.modes_of_deck(deck, [int(k) + 1 for k in driven[:n]], folder)
    runs = []

    def solve(forces: np.ndarray) -> StaticCases:
        runs.append(calculix.run_static_cases(modes, forces, folder))
        return runs[-1].cases

    middle = deck.nearest_node((0.0, 0.0, float(deck.coordinates[:, 2].min())))
    found = condensed(beam, modes.basis, solve, modes.shape_at(middle, "z"), scale)
    return found._replace(
        participation=modes.participation("z") * _signs(beam, modes.shape_at(middle, "z")),
        seconds=time.perf_counter() - begin,
        job_seconds=float(np.median(runs[-1].seconds)),
    )


def built_in(beam: PaperBeam, scale: float | None) -> Condensed:
    """Condense a beam from the built-in elements, 40 of them; it bulges to +y."""
    begin = time.perf_counter()
    rise = 0.0 if np.isinf(beam.radius) else rise_of_radius(beam.length, beam.radius)
    made = FiniteElements(
        *(beam.length, beam.width, beam.thickness),
        rise=rise,
        young=beam.young,
        density=beam.density,
    )
    n = beam.printed.n_modes
    basis = beam_modes(made, range(1, 2 * n, 2))
    midspan = -np.asarray(shape_at(made, basis, 0.5))  # inwards

    def solve(forces: np.ndarray) -> StaticCases:
        return static_cases(made, basis, forces)

    found = condensed(beam, basis, solve, midspan, scale)
    return found._replace(seconds=time.perf_counter() - begin)


def _signs(beam: PaperBeam, midspan: np.ndarray) -> np.ndarray:
    """What turns modes to the signs of the paper."""
    return np.sign(midspan) * np.sign(np.asarray(beam.printed.modes.mode_shape)[0])


def condensed(
    beam: PaperBeam,
    basis: ReductionBasis,
    solve: Callable[[np.ndarray], StaticCases],
    midspan: np.ndarray,
    scale: float | None,
) -> Condensed:
    """Load cases and fit of any finite elements."""
    if scale is None:
        size = displacement_for_ratio(basis, solve, start=0.1 * beam.thickness)
    else:
        size = np.full(len(basis.numbers), scale * beam.thickness)
    loads = modal_loads(basis, size)
    found = reduced_model(basis, solve(np.asarray(loads.force)))
    signs = _signs(beam, midspan)
    coefficients = np.asarray(found.potential.coefficient)
    force = {
        monomial_key(m): float(c * np.prod(signs[list(m)]))
        for m, c in zip(found.potential.monomials, coefficients, strict=True)
    }
    hertz = np.asarray(basis.frequency) / HERTZ
    misfit, cases = found.quality.cross_validated, len(loads.force)
    return Condensed(hertz, midspan * signs, np.array([]), force, misfit, cases, 0.0, 0.0)


def printed_of(beam: PaperBeam) -> dict[str, float]:
    """The coefficients of the printed potential by monomial."""
    potential = beam.printed.potential
    values = np.asarray(potential.coefficient)
    return {monomial_key(m): float(c) for m, c in zip(potential.monomials, values, strict=True)}


# Name: (element, elements along and across, whether it has Poisson's ratio).
MODELS = {
    "flat": {
        "beams": ("B32R", (40, 1), True),
        "beams, no Poisson": ("B32R", (40, 1), False),
        "shells S8R": ("S8R", (60, 2), True),
    },
    "curved": {
        "shells S4, 400": ("S4", (100, 4), True),
        "shells S8R": ("S8R", (60, 2), True),
        "beams, no Poisson": ("B32R", (60, 1), False),
    },
}


def path_of(beam: PaperBeam, folder: Path) -> dict[str, object]:
    """Static path of the curved beam along mode 1 by S8R shells, jumps included.

    Loads f/ω² and displacements q in thicknesses at midspan, inwards positive, and the lowest load
    between one and four thicknesses of a force of degree nine through all of them.
    """
    deck = calculix.read_deck(folder / "deck.inp")
    modes = calculix.modes_of_deck(deck, (1,), folder)
    one = beam.thickness / float(modes.basis.largest[0])
    loads = np.array([0.1, 0.2, 0.28, 0.3, 0.35, 0.6, 0.8, 1.5, 2.5])
    loads = np.concatenate([-loads[::-1], loads])
    squared = float(modes.basis.frequency[0]) ** 2
    run = calculix.run_static_cases(modes, loads[:, None] * squared * one, folder)
    moved = np.asarray(run.cases.modal_displacement)[:, 0] / one
    there = np.isfinite(moved)
    powers = np.arange(2, 10)
    terms = moved[there, None] ** powers
    fitted = np.linalg.lstsq(terms, (loads - moved)[there], rcond=None)[0]
    between = np.linspace(1.0, 4.0, 301)
    line: dict[str, object] = {
        "beam": "curved",
        "model": "path by shells S8R",
        "load": loads[there],
        "displacement": moved[there],
        "lowest_between": float(np.min(between + between[:, None] ** powers @ fitted)),
    }
    return line


def line_of(name: str, model: str, beam: PaperBeam, found: Condensed) -> dict[str, object]:
    """What is printed of a model."""
    printed = printed_of(beam)
    cubic = {key: found.force[key] / printed[key] for key in printed if len(key) == 4}
    large = [cubic[key] for key in cubic if len(set(key)) <= 2]
    values = beam.printed.modes
    line: dict[str, object] = {
        "beam": name,
        "model": model,
        "frequency_ratio": found.frequency / np.asarray(values.natural_frequency) * HERTZ,
        "midspan_ratio": found.midspan / np.asarray(values.mode_shape)[0],
        "cubic_ratio_first": cubic["1111"],
        "cubic_ratio_median": np.median(large),
        "cubic_ratio_range": [min(large), max(large)],
        "misfit_cross_validated": found.misfit,
        "load_cases": found.cases,
        "seconds": found.seconds,
        "seconds_a_case": found.job_seconds,
    }
    if len(found.participation):
        line["participation"] = found.participation
    if name == "curved":
        line["quadratic_ratio"] = found.force["111"] / printed["111"]
    return line


def table_of(name: str, beam: PaperBeam, found: dict[str, Condensed]) -> str:
    """All coefficients of the force ∂V/∂q₁... side by side, with ratios to the print."""
    printed = printed_of(beam)
    heads = "".join(f" {model} | ratio |" for model in found)
    lines = [f"## {name} beam: potential V(q)", "", f"| monomial | paper |{heads}"]
    lines.append("|---|---|" + "---|---|" * len(found))
    for key, value in printed.items():
        cells = "".join(
            f" {one.force[key]:.4g} | {one.force[key] / value:.3g} |" for one in found.values()
        )
        lines.append(f"| {key} | {value:.5g} |{cells}")
    for k, hertz in enumerate(np.asarray(beam.printed.modes.natural_frequency) / HERTZ):
        cells = "".join(
            f" {one.frequency[k]:.2f} | {one.frequency[k] / hertz:.4f} |" for one in found.values()
        )
        lines.append(f"| frequency {k + 1} (Hz) | {hertz:.2f} |{cells}")
    return "\n".join([*lines, "", ""])


def main() -> None:
    """Every beam by every kind of element."""
    chosen = options(__doc__, scale=float, folder=Path, table=Path, only=list(BEAMS))
    folder = chosen.folder or Path(tempfile.mkdtemp(prefix="paper-models-"))
    tables = []
    for name, beam in BEAMS.items():
        if name not in chosen.only:
            continue
        found: dict[str, Condensed] = {}
        if shutil.which("ccx") is not None:
            for model, (kind, mesh, has_poisson) in MODELS[name].items():
                place = folder / f"{name}-{kind}-{mesh[0]}-{'p' if has_poisson else '0'}"
                poisson = beam.poisson if has_poisson else 0.0
                found[model] = by_calculix(beam, kind, mesh, poisson, chosen.scale, place)
                tell(**line_of(name, model, beam, found[model]))
            if name == "curved":
                place = folder / "curved-S8R-60-p"
                tell(**path_of(beam, place))
        found["built-in"] = built_in(beam, chosen.scale)
        tell(**line_of(name, "built-in", beam, found["built-in"]))
        tables.append(table_of(name, beam, found))
    if chosen.table is not None:
        chosen.table.write_text("\n".join(tables), encoding="utf-8")
    if chosen.folder is None:
        shutil.rmtree(folder)


if __name__ == "__main__":
    main()
