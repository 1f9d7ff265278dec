"""Structures of other authors' reduced models, condensed anew and set beside what they publish.

    python benchmarks/peer_structures.py [--folder FOLDER] [--only NAME] [--deck DECK]

A clamped beam and a MEMS arch are examples 01 and 03 of MORFEFerrite.jl
(github.com/MORFEproject/MORFEFerrite.jl, MIT, commit cb4d910; the dimensions of the arch are read
off its mesh). It reduces them by another method, the direct parametrisation of invariant manifolds
(A. Vizzaccaro, A. Opreni, L. Salles, A. Frangi & C. Touzé, Nonlinear Dyn. 110 (2022) 525,
doi:10.1007/s11071-022-07651-9), and publishes the coefficients of a normal form,
ż = iω₀z + iR₂₁z²z̄ + iR₃₂z³z̄² + …, hence of the backbone ω = ω₀ + R₂₁ρ² + R₃₂ρ⁴ + … over ρ = |z|.
The same coefficients are fitted to the backbones of our condensed models: z is the projection of
the motion on the master mode, (q + q̇/iω₀)/2, so that ρ = a(1 + ω/ω₀)/4 with a the fundamental of q.
R₂₁ depends on how the master mode is normalised, which the examples do not state; the backbone's
shape R₃₂ω₀/R₂₁² and R₄₃ω₀²/R₂₁³ does not. `amplitude_scale` is the factor of normalisation that
makes R₂₁ equal; that of the beam has a closed form, too (a slender one: `r21_slender`).

The decks are written here, of quadratic solids (C3D20R), and go through `snrmjax rom --calculix`;
straight beams also through the built-in elements.
"""

import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
from harness import options, teller

import snrmjax as sj
from snrmjax.io import calculix

tell = teller(__file__)

HERTZ = 2 * np.pi
_MICRO = {"young": 160e9, "poisson": 0.22, "density": 2320.0}  # polysilicon
_MESH = (40, 1, 2)  # elements along, through the thickness, across
_FAR = 0.01  # of ω₀, up to which a backbone is fitted


class Strip(NamedTuple):
    """A clamped strip whose middle line rises from its ends; metres."""

    length: float
    width: float
    thickness: float
    young: float
    poisson: float
    density: float
    rise: float = 0.0

    def height(self, along: float) -> float:
        """Height of the middle line, a full cosine, over the fraction of the length."""
        return float(self.rise / 2 * (1 - np.cos(2 * np.pi * along)))


class Published(NamedTuple):
    """ω₀ (rad/µs) and R₂₁, R₃₂, … of a published normal form; µm, µs and 10⁻¹² kg."""

    frequency: float
    backbone: tuple[float, ...]


class Case(NamedTuple):
    """A structure, how many symmetric bending modes are kept, and what is published of it."""

    strip: Strip
    counts: tuple[int, ...]
    published: Published


CASES = {
    "MORFE beam": Case(
        Strip(1000e-6, 24e-6, 10e-6, **_MICRO),
        (1, 2, 3),
        # The published form is damped by one per cent: ω₀² = Re² + Im².
        Published(
            float(np.hypot(0.005374121535453259, 0.5373851813555319)),
            (2.4472423863127043e-5, -1.770432606091127e-9, 2.0557114174180192e-13),
        ),
    ),
    "MORFE arch": Case(
        Strip(640e-6, 32e-6, 6.4e-6, **_MICRO, rise=3.84e-6),
        (1, 2, 3),
        Published(1.0327416573066432, (-5.230243682388068e-5, 1.9875349919184666e-8)),
    ),
}
_MICRO_MODAL = 1e-12  # of kg^1/2 m: one µm of 10⁻¹² kg


def solid_deck(strip: Strip, along: int, through: int, across: int) -> str:
    """A deck of C3D20R elements: x along, y through the thickness, z across; ends clamped."""
    nx, ny, nz = 2 * along, 2 * through, 2 * across
    number: dict[tuple[int, int, int], int] = {}
    rows = []
    for i in range(nx + 1):
        for j in range(ny + 1):
            for k in range(nz + 1):
                if (i % 2) + (j % 2) + (k % 2) > 1:
                    continue  # quadratic bricks have nodes on corners and edges only
                number[i, j, k] = len(number) + 1
                x = strip.length * i / nx
                y = strip.thickness * (j / ny - 0.5) + strip.height(i / nx)
                z = strip.width * (k / nz - 0.5)
                rows.append(f"{number[i, j, k]}, {x:.12g}, {y:.12g}, {z:.12g}")
    corners = [(0, 0, 0), (2, 0, 0), (2, 2, 0), (0, 2, 0)]
    corners += [(x, y, 2) for x, y, _ in corners]
    edges = [(1, 0, 0), (2, 1, 0), (1, 2, 0), (0, 1, 0)]
    edges += [(x, y, 2) for x, y, _ in edges] + [(x, y, 1) for x, y, _ in corners[:4]]
    elements = []
    for i in range(0, nx, 2):
        for j in range(0, ny, 2):
            for k in range(0, nz, 2):
                nodes = [number[i + a, j + b, k + c] for a, b, c in corners + edges]
                text = ", ".join(str(n) for n in nodes[:15])
                elements.append(f"{text},\n{', '.join(str(n) for n in nodes[15:])}")
    ends = [n for (i, _, _), n in number.items() if i in (0, nx)]
    lines = ["*NODE, NSET=ALL", *rows, "*ELEMENT, TYPE=C3D20R, ELSET=ALL"]
    lines += [f"{e + 1}, {row}" for e, row in enumerate(elements)]
    lines += ["*MATERIAL, NAME=M", "*ELASTIC", f"{strip.young}, {strip.poisson}", "*DENSITY"]
    lines += [f"{strip.density}", "*SOLID SECTION, ELSET=ALL, MATERIAL=M", "*BOUNDARY"]
    return "\n".join([*lines, *(f"{n}, 1, 3" for n in ends), ""])


def symmetric_modes(deck: Path, count: int) -> list[int]:
    """Numbers of the first modes that a uniform acceleration in y drives."""
    found = calculix.survey_modes(calculix.read_deck(deck), 14, deck.with_suffix(".jobs"))
    mass = found.effective_mass
    driven = np.flatnonzero((found.carried > 0.9) & (mass[:, 1] > 1e-4 * mass[:, 1].max()))
    return [int(k) + 1 for k in driven[:count]]


def by_command(deck: Path, modes: list[int]) -> tuple[sj.model.Structure, float]:
    """The model that `snrmjax rom --calculix` writes, and the seconds it took."""
    begin = time.perf_counter()
    out = deck.with_suffix("") / "-".join(map(str, modes))
    program = Path(sys.executable).parent / "snrmjax"
    numbers = ",".join(map(str, modes))
    command = [str(program), "rom", "--calculix", str(deck), "--modes", numbers, "--no-study"]
    subprocess.run([*command, "--out", str(out)], check=True, capture_output=True)
    return sj.read_model(out / "model.toml"), time.perf_counter() - begin


def by_elements(strip: Strip, count: int) -> tuple[sj.model.Structure, float]:
    """The model of the built-in elements, which have no Poisson effect across the width."""
    begin = time.perf_counter()
    beam = sj.condense.Beam(
        *(strip.length, strip.width, strip.thickness), young=strip.young, density=strip.density
    )
    basis = sj.condense.beam_modes(beam, range(1, 2 * count, 2))

    def solve(force):
        return sj.condense.static_cases(beam, basis, force)

    size = sj.condense.displacement_for_ratio(basis, solve, start=strip.thickness / 10)
    found = sj.condense.reduced_model(basis, solve(sj.condense.modal_loads(basis, size).force))
    model = found.structure(
        0.01,
        sensors={"midspan": sj.condense.shape_at(beam, basis, 0.5)},
        participation=np.asarray(sj.condense.participation(beam, basis)),
    )
    return model, time.perf_counter() - begin


def backbone_of(model: sj.model.Structure, *, rises: bool) -> np.ndarray:
    """R₂₁, R₃₂ and R₄₃ (rad/s over powers of kg^1/2 m) of mode 1, near its natural frequency."""
    first = float(model.modes.natural_frequency[0])
    end = first * (1 + _FAR if rises else 1 - _FAR)
    mode = sj.nonlinear_normal_mode(model, end, tongues="skip")
    shift = mode.frequency - first
    # The first coefficients of a motion that begins at rest are those of cos Ωt.
    rho = np.abs(mode.coefficients[:, 1, 0]) * (1 + mode.frequency / first) / 4
    columns = rho[:, None] ** np.array([2, 4, 6])
    size = columns.max(axis=0)
    # Relative to the shift, so that small motions count as well.
    weight = 1 / np.maximum(np.abs(shift), 1e-3 * np.abs(shift).max())
    rows, right = columns / size * weight[:, None], shift * weight
    return np.linalg.lstsq(rows, right, rcond=None)[0] / size


def slender_r21(strip: Strip) -> float:
    """R₂₁ = 3β/2ω₀ of a slender clamped beam, β = EA/2L (∫φ'²dx)² of its mass-normalised mode."""
    root = 4.730040744862704  # cos x cosh x = 1
    sigma = (np.cosh(root) - np.cos(root)) / (np.sinh(root) - np.sin(root))
    area = strip.width * strip.thickness
    slopes = sigma * root * (sigma * root - 2) / (strip.density * area * strip.length**2)
    cubic = strip.young * area / (2 * strip.length) * slopes**2
    radius = strip.thickness / np.sqrt(12)
    first = (root / strip.length) ** 2 * radius * np.sqrt(strip.young / strip.density)
    return float(1.5 * cubic / first)


def line_of(name: str, case: Case, model: sj.model.Structure, seconds: float) -> dict[str, object]:
    """Frequency, coefficients and backbone of a model, beside what is published."""
    frequency = np.asarray(model.modes.natural_frequency)
    terms = dict(
        zip(model.potential.monomials, np.asarray(model.potential.coefficient), strict=True)
    )
    largest = np.abs(np.asarray(model.modes.mode_shape)[0, 0])
    one = case.strip.thickness / largest  # modal displacement of one thickness
    squared = frequency[0] ** 2
    line: dict[str, object] = {
        "structure": name,
        "frequency_hz": frequency / HERTZ,
        "quadratic_force": 3 * terms.get((0, 0, 0), 0.0) * one / squared,
        "cubic_force": 4 * terms[(0, 0, 0, 0)] * one**2 / squared,
        "seconds": seconds,
    }
    published = np.array(case.published.backbone)
    power = 2 * np.arange(1, len(published) + 1)
    ours = backbone_of(model, rises=bool(published[0] > 0))[: len(published)]
    scaled = ours * _MICRO_MODAL**power / 1e6
    first = case.published.frequency
    order = np.arange(1, len(published))
    shape = scaled[1:] * (frequency[0] / 1e6) ** order / scaled[0] ** (order + 1)
    their_shape = published[1:] * first**order / published[0] ** (order + 1)
    line |= {
        "frequency_ratio": frequency[0] / 1e6 / first,
        "backbone": scaled,
        "published_backbone": published,
        "shape": shape,
        "published_shape": their_shape,
        "shape_ratio": shape / their_shape,
        "amplitude_scale": np.sqrt(published[0] / scaled[0]),
    }
    if not case.strip.rise:
        exact = slender_r21(case.strip) * _MICRO_MODAL**2 / 1e6
        line |= {"r21_slender": exact, "r21_over_slender": scaled[0] / exact}
    return line


def main() -> None:
    """Every structure by solids through the command, straight ones by built-in elements."""
    chosen = options(__doc__, folder=Path, only=list(CASES))
    folder = chosen.folder or Path(tempfile.mkdtemp(prefix="peer-structures-"))
    folder.mkdir(parents=True, exist_ok=True)
    for name, case in CASES.items():
        if name not in chosen.only:
            continue
        if shutil.which("ccx") is not None:
            deck = folder / f"{name.replace(' ', '_')}.inp"
            deck.write_text(solid_deck(case.strip, *_MESH), encoding="utf-8")
            modes = symmetric_modes(deck, max(case.counts))
            for count in case.counts:
                model, seconds = by_command(deck, modes[:count])
                kept = ", ".join(map(str, modes[:count]))
                tell(model=f"C3D20R, modes {kept}", **line_of(name, case, model, seconds))
        if not case.strip.rise:
            for count in case.counts:
                model, seconds = by_elements(case.strip, count)
                tell(model=f"built-in, {count} modes", **line_of(name, case, model, seconds))
    if chosen.folder is None:
        shutil.rmtree(folder)


if __name__ == "__main__":
    main()
