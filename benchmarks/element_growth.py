"""Cost of a response with elements at points, as points, modes and unknowns grow.

Run: OMP_NUM_THREADS=1 taskset -c 0 python benchmarks/element_growth.py --figure growth.png

Points and modes: a cantilever of 120 elements, cubic springs at as many points, so many modes,
seven harmonics, without stability; residual flexibility is left out, as many places would add as
many modes. Unknowns: the same beam with one cubic spring at its tip, finer and finer, matrices
sparse, reduced to eight modes with residual flexibility. Seconds are the median of warm runs;
memory is the largest of the process.
"""

import resource
from typing import Any

import numpy as np
import scipy.sparse
from harness import medians, options, seconds_of, teller
from matplotlib.figure import Figure

import snrmjax as sj

tell = teller(__file__)
BENDING, MASS, LENGTH = 205e9 * 0.014**4 / 12, 7800 * 0.014**2, 0.7  # of a square steel bar
DAMPING = 0.005


def sparse_beam(n_elements: int) -> tuple[Any, Any, list[str]]:
    """Mass, stiffness and points of a clamped–free beam, sparse."""
    h = LENGTH / n_elements
    bending = np.array(
        [
            [12, 6 * h, -12, 6 * h],
            [6 * h, 4 * h**2, -6 * h, 2 * h**2],
            [-12, -6 * h, 12, -6 * h],
            [6 * h, 2 * h**2, -6 * h, 4 * h**2],
        ]
    )
    inertia = np.array(
        [
            [156, 22 * h, 54, -13 * h],
            [22 * h, 4 * h**2, 13 * h, -3 * h**2],
            [54, 13 * h, 156, -22 * h],
            [-13 * h, -3 * h**2, -22 * h, 4 * h**2],
        ]
    )
    first = 2 * np.arange(n_elements)[:, None, None]
    row = (first + np.arange(4)[None, :, None] + np.zeros((1, 1, 4), int)).ravel()
    column = (first + np.arange(4)[None, None, :] + np.zeros((1, 4, 1), int)).ravel()
    size = 2 * n_elements + 2

    def assembled(part: np.ndarray) -> Any:
        values = np.tile(part.ravel(), n_elements)
        return scipy.sparse.coo_matrix((values, (row, column)), (size, size)).tocsc()[2:, 2:]

    points = [f"{kind}{k}" for k in range(1, n_elements + 1) for kind in "wr"]
    stiffness, mass = BENDING / h**3 * bending, MASS * h / 420 * inertia
    return assembled(mass), assembled(stiffness), points


def springs(points: list[str]) -> list[sj.model.AbstractForce]:
    """A cubic spring at each point, together as stiff as 6e9 N/m³ at the tip."""
    each = {"coefficient": 6e9 / len(points)}
    return [sj.model.make_effect("cubic_stiffness", each, at=point) for point in points]


def curve_of(model: sj.model.Structure) -> dict[str, float]:
    """Seconds and points of the response about the first resonance."""
    omega = float(model.modes.natural_frequency[0])

    def respond() -> list[sj.simulate.ResponseCurve]:
        ends = 0.7 * omega, 1.6 * omega
        return sj.forced_response(model, 2.0, *ends, harmonic_order=7, stability=False)

    first, curves = seconds_of(respond)
    seconds = medians(3, run=respond)["run"] if first < 60 else seconds_of(respond)[0]
    points = sum(len(curve.frequency) for curve in curves)
    return {
        "points_of_curve": points,
        "seconds": seconds,
        "milliseconds_a_point": 1e3 * seconds / points,
        "largest_velocity": float(max(np.abs(c.velocity[:, 1]).max() for c in curves)),
        "peak_megabytes": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
    }


def drawn(path: str, by_points: list[dict], by_unknowns: list[dict]) -> None:
    """Two panels: over points for every number of modes, and over unknowns."""
    figure = Figure(figsize=(7.0, 3.0), layout="constrained")
    left, right = figure.subplots(1, 2)
    for n_modes in sorted({row["n_modes"] for row in by_points}):
        rows = [row for row in by_points if row["n_modes"] == n_modes]
        x, y = [row["n_points"] for row in rows], [row["milliseconds_a_point"] for row in rows]
        left.loglog(x, y, "o-", markersize=3, label=f"{n_modes} modes")
    left.set(xlabel="Nonlinear points", ylabel="Time a point of the curve (ms)", title="(a)")
    left.legend(frameon=False, loc="center right", bbox_to_anchor=(1.0, 0.68))
    x = [row["unknowns"] for row in by_unknowns]
    for name, label in (("reduction_seconds", "reduction"), ("seconds", "response curve")):
        right.loglog(x, [row[name] for row in by_unknowns], "o-", markersize=3, label=label)
    right.set(xlabel="Unknowns of the matrices", ylabel="Time (s)", title="(b)")
    right.legend(frameon=False)
    figure.savefig(path, dpi=150)


def main() -> None:
    """Measure, print and draw."""
    asked = options(
        __doc__,
        modes=[10, 20, 50],
        points=[1, 3, 10, 30, 100],
        unknowns=[200, 1000, 5000, 10000],
        figure="",
    )
    mass, stiffness, names = sparse_beam(120)
    by_points, by_unknowns = [], []
    for n_modes in asked.modes:
        for count in asked.points:
            places = [f"w{k}" for k in np.unique(np.linspace(120, 21, count).round().astype(int))]
            model = sj.model.from_matrices(
                *(mass, DAMPING, stiffness, names),
                force="w120",
                effects=springs(places),
                n_modes=n_modes,
                residuals=False,
                sensors=["w120"],
            )
            row = {"n_modes": n_modes, "n_points": len(places)} | curve_of(model)
            by_points.append(row)
            tell(measurement="points", **row)
    for size in asked.unknowns:
        matrices = sparse_beam(size // 2)
        tip = matrices[2][-2]
        settings = {"force": tip, "effects": springs([tip]), "n_modes": 8, "sensors": [tip]}
        took, model = seconds_of(
            lambda m=matrices, s=settings: sj.model.from_matrices(*(m[0], DAMPING, m[1], m[2]), **s)
        )
        row = {"unknowns": size, "reduction_seconds": took} | curve_of(model)
        by_unknowns.append(row)
        tell(measurement="unknowns", **row)
    if asked.figure:
        drawn(asked.figure, by_points, by_unknowns)


if __name__ == "__main__":
    main()
