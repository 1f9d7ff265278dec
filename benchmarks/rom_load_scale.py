"""Reduced models over the size of their load cases: where coefficients do not depend on it.

Run: python benchmarks/rom_load_scale.py [--structure NAME] [--elements N]

Static load cases of six structures by finite elements that the package does not have
(tests/truths/corotational_frame.py), condensed at 16 load scales from 1e-3 to 5.6 times the default
(nonlinear force 2 % of the linear one for each mode alone). One JSON line each: the default in
thicknesses, the plateau (every leading coefficient within 2 %), its decades, whether the default
lies inside, the misfit at the default, and the share by which coefficients at the default differ
from those in the middle of the plateau. Flat clamped beam: also the cubic coefficient of mode 1
over the closed form of the von Kármán beam, V = EA/(8L) (∫φ'² dx)² q⁴.
"""

import sys
import time
from pathlib import Path

import numpy as np

import snrmjax as sj

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from harness import options, teller
from truths.corotational_frame import Frame, Model, rectangle

tell = teller(__file__)

YOUNG, DENSITY = 204.8e9, 7870.0
WIDTH, THICKNESS, LENGTH = 12.7e-3, 0.508e-3, 0.2286
SECTION = rectangle(WIDTH, THICKNESS, YOUNG, DENSITY)
SCALES = tuple(float(one) for one in np.logspace(-3.0, 0.75, 16))
CLAMPED, PINNED = (0, 1, 2), (0, 1)


def line(nodes: np.ndarray, left: tuple, right: tuple, **settings: object) -> Frame:
    """Elements one after the other, held at both ends."""
    n = len(nodes) - 1
    elements = np.stack([np.arange(n), np.arange(1, n + 1)], axis=1)
    fixed = (*left, *(3 * n + k for k in right), *settings.pop("fixed", ()))
    return Frame(nodes, elements, *SECTION, fixed, **settings)


def straight(n: int) -> np.ndarray:
    """Nodes of a straight beam."""
    return np.stack([np.linspace(0, LENGTH, n + 1), np.zeros(n + 1)], axis=1)


def arch(n: int, rise: float) -> np.ndarray:
    """Nodes of a circular arch."""
    radius = (LENGTH**2 / 4 + rise**2) / (2 * rise)
    half = np.arcsin(LENGTH / (2 * radius))
    angle = np.linspace(-half, half, n + 1)
    y = radius * (np.cos(angle) - np.cos(half))
    return np.stack([radius * np.sin(angle) + LENGTH / 2, y], axis=1)


def portal(n: int) -> Frame:
    """Two columns and a beam, both feet clamped."""
    third = n // 3
    up = np.stack([np.zeros(third), np.linspace(0, LENGTH / 2, third + 1)[:-1]], axis=1)
    over = np.stack([np.linspace(0, LENGTH, third + 1), np.full(third + 1, LENGTH / 2)], axis=1)
    down = np.stack([np.full(third, LENGTH), np.linspace(LENGTH / 2, 0, third + 1)[1:]], axis=1)
    return line(np.concatenate([up, over, down]), CLAMPED, CLAMPED)


def structures(n: int) -> dict[str, tuple[Frame, tuple[int, ...]]]:
    """Frames and the modes to keep, by name."""
    stiffness = {3 * n: 2e5, 3 * n + 2: 1.0}  # N/m along the beam, N m/rad
    return {
        "flat_clamped": (line(straight(n), CLAMPED, CLAMPED), (1, 3)),
        "arch_clamped": (line(arch(n, 2 * THICKNESS), CLAMPED, CLAMPED), (1, 3)),
        "pinned_pinned": (line(straight(n), PINNED, PINNED), (1, 2, 3)),
        "elastic_support": (line(straight(n), CLAMPED, (1,), springs=stiffness), (1, 2)),
        "portal_frame": (portal(n), (1, 2)),
        "two_spans": (line(straight(n), CLAMPED, PINNED, fixed=(3 * (n // 2) + 1,)), (1, 2)),
    }


def closed_form(model: Model) -> float:
    """The quartic coefficient of mode 1 of a flat beam whose ends cannot approach each other."""
    size = 3 * len(model.frame.nodes)
    shape = np.zeros(size)
    shape[model.free] = model.shapes[:, 0]
    w, turn = shape[1::3], shape[2::3]
    h = np.diff(model.frame.nodes[:, 0])
    # ∫w'² of a cubic element between its ends' displacements and rotations.
    a, b, c, d = w[:-1], turn[:-1], w[1:], turn[1:]
    rise = c - a
    slope = 6 / 5 * rise**2 / h - rise * (b + d) / 5 + h * (2 * b**2 - b * d + 2 * d**2) / 15
    return float(model.frame.axial / (8 * LENGTH) * np.sum(slope) ** 2)


def measure(name: str, frame: Frame, modes: tuple[int, ...]) -> dict[str, object]:
    """The load-scale study of one structure."""
    model = Model(frame, modes)
    basis = sj.condense.ReductionBasis(
        model.frequency, model.shapes, model.filter, modes, model.translations
    )

    def solve(force: np.ndarray) -> sj.condense.StaticCases:
        u, left, energy = model.solve(force)
        good = left < 1e-7
        return sj.condense.StaticCases(force, u @ model.filter.T, good, energy, u)

    began = time.perf_counter()
    size = sj.condense.displacement_for_ratio(basis, solve, start=0.1 * THICKNESS)
    loads = sj.condense.modal_loads(basis, size)
    found = sj.condense.reduced_model(basis, solve(np.asarray(loads.force)))
    study = sj.condense.load_scale_study(basis, solve, size, scales=SCALES)
    leading = np.array(study.leading)
    result: dict[str, object] = {
        "structure": name,
        "modes": modes,
        "default_thicknesses": [round(float(one), 4) for one in size / THICKNESS],
        "solved_scales": int(np.isfinite(study.misfit).sum()),
        "plateau": study.plateau,
        "decades": study.decades,
        "default_inside": study.holds_default,
        "misfit": found.quality.misfit,
        "cross_validated": found.quality.cross_validated,
        "energy_error": float(np.max(np.abs(found.quality.energy_error))),
        "warnings": [one.kind for one in found.warnings],
    }
    if study.plateau is not None:
        middle = np.exp(np.mean(np.log(study.plateau)))
        row = int(np.argmin(np.abs(np.log(study.scale / middle))))
        values = np.asarray(found.potential.coefficient)[leading]
        off = values / study.coefficient[row, leading] - 1
        result["default_from_middle"] = float(np.max(np.abs(off)))
    if name == "flat_clamped":
        own = found.potential.monomials.index((0, 0, 0, 0))
        value = float(found.potential.coefficient[own])
        result["over_closed_form"] = value / closed_form(model)
    return result | {"seconds": time.perf_counter() - began}


def main() -> None:
    """Measure what the arguments ask for."""
    asked = options(__doc__, structure=list(structures(6)), elements=30)
    for name, (frame, modes) in structures(asked.elements).items():
        if name in asked.structure:
            tell(**measure(name, frame, modes))


if __name__ == "__main__":
    main()
