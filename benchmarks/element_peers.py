"""Structures with elements at points, beside pyHarm-os, NLvib-py and tmdsimpy.

Run: OMP_NUM_THREADS=1 python benchmarks/element_peers.py --python PYTHON --clones DIR [--write]

`PYTHON` has pyHarm-os 1.2.2; `DIR` holds clones `nlvib` (julianjurai/NLvib-py 64ad450) and `tmd`
(tmd-lab/tmdsimpy 17d5fc3). A program that fails says so and is left out. All get the same matrices,
forces and harmonics; ours works in as many modes as the matrices have, and, of the beam, in eight
with residual flexibility as well. Seconds are medians of warm runs, stability and events included
in ours unless it says "bare". `error` is the largest distance of a point from our curve in fine
steps in the plane of frequency over its range and amplitude over its peak, below the peak's half
left out; `chords` the opposite distance, from that curve to the chords between the points.

Problems: the pair of Volvert and Kerschen (J. Sound Vib. 511 (2021) 116355), NLvib's two masses
with cubic springs, and its cantilever with a Jenkins element (examples 2 and 10; the beam as in the
RubBeR rig, Scheel et al., J. Sound Vib. 487 (2020) 115580) with ζ = 1 % and 5 N at the tip.
"""

import os
import pickle
import subprocess
import tempfile
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np
from harness import options, teller

import snrmjax as sj
from snrmjax.simulate.continuation.continuation import StepControl

tell = teller(__file__)
RUNS = 3
LIMIT = 600  # seconds that a program has for its runs of one problem
FINE = StepControl(max_points=8000, largest=0.01)


def problems() -> dict[str, dict[str, Any]]:
    """The problems as numbers."""
    pair = {
        "mass": np.eye(2),
        "damping": np.array([[0.02, -0.01], [-0.01, 0.11]]),
        "stiffness": np.array([[2.0, -1.0], [-1.0, 2.0]]),
        "elements": [("cubic_stiffness", np.array([1.0, 0.0]), {"coefficient": 1.0})],
        **{"force": 1.5, "driven": 0, "watched": 0, "low": 0.3, "high": 1.4, "harmonics": 8},
        **{"size": 1.0, "unit": 1.0, "samples": 128, "nlvib_tolerance": 1e-8},
        **{"pyharm_step": 0.05, "nlvib_step": 0.05, "tmdsimpy_step": 0.02},
    }
    mass, damping, stiffness, _ = sj.model.chain(
        [1.0, 0.05], [1.0, 0.0453, 0.0], [0.002, 0.013, 0.0]
    )
    two = {
        **{"mass": mass, "damping": damping, "stiffness": stiffness},
        "elements": [
            ("cubic_stiffness", np.array([1.0, 0.0]), {"coefficient": 1.0}),
            ("cubic_stiffness", np.array([1.0, -1.0]), {"coefficient": 0.0042}),
        ],
        **{"force": 0.11, "driven": 0, "watched": 0, "low": 0.8, "high": 1.4, "harmonics": 7},
        **{"size": 1.0, "unit": 1.0, "samples": 128, "nlvib_tolerance": 1e-8},
        **{"pyharm_step": 0.05, "nlvib_step": 0.05, "tmdsimpy_step": 0.01},
    }
    bending = 0.6725 * 210e9 * 0.06 * 0.05**3 / 12
    beam = sj.model.beam(bending, 7850.0 * 0.06 * 0.05, 0.71, 14)
    natural, shapes = _modes(np.asarray(beam.mass), np.asarray(beam.stiffness))
    inner = np.asarray(beam.mass) @ shapes
    node = np.zeros(len(natural))
    node[list(beam.points).index("w5")] = 1.0
    tip = list(beam.points).index("w14")
    slider = {"stiffness": 1e7, "slip_displacement": 1.5e-6}
    rod = {
        **{"mass": np.asarray(beam.mass), "stiffness": np.asarray(beam.stiffness)},
        "damping": inner @ np.diag(0.02 * natural) @ inner.T,
        "elements": [("jenkins_slider", node, slider)],
        **{"force": 5.0, "driven": tip, "watched": tip, "harmonics": 7, "samples": 256},
        **{"low": 2 * np.pi * 55.0, "high": 2 * np.pi * 110.0, "size": 1e-4},
        **{"unit": natural[0], "nlvib_tolerance": 1e-6},
        **{"pyharm_step": 0.05, "nlvib_step": 2.0, "tmdsimpy_step": 0.01},
    }
    return {"pair": pair, "two masses": two, "beam with a slider": rod}


def _modes(mass: np.ndarray, stiffness: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    import scipy.linalg

    squared, shapes = scipy.linalg.eigh(stiffness, mass)
    return np.sqrt(squared), shapes


def structure(of: dict[str, Any], n_modes: int | None) -> sj.model.Structure:
    """The problem as a structure of ours."""
    names = [f"x{k}" for k in range(len(of["mass"]))]
    elements = [
        sj.model.make_effect(
            kind, values, at={names[k]: float(row[k]) for k in np.flatnonzero(row)}
        )
        for kind, row, values in of["elements"]
    ]
    return sj.model.from_matrices(
        *(of["mass"], of["damping"], of["stiffness"], names),
        **{"force": names[of["driven"]], "effects": elements, "n_modes": n_modes},
        sensors=[names[of["watched"]]],
    )


def respond(of: dict[str, Any], model: sj.model.Structure, **settings: object) -> tuple:
    """Frequency and phasor of the displacement of the watched point, m."""
    curves = sj.forced_response(
        *(model, [of["force"]], of["low"], of["high"]), harmonic_order=of["harmonics"], **settings
    )
    frequency = np.concatenate([np.asarray(c.frequency) for c in curves])
    velocity = np.concatenate([np.asarray(c.velocity)[:, 1, 0] for c in curves])
    return frequency, velocity / (1j * frequency)


def distances(of: dict[str, Any], curve: tuple, fine: tuple) -> tuple[float, float]:
    """Largest distance of the points from the fine curve, and of that from the chords."""
    peak = np.abs(fine[1]).max()

    def plane(curve: tuple) -> np.ndarray:
        inside = (curve[0] >= of["low"]) & (curve[0] <= of["high"])
        x = (curve[0][inside] - of["low"]) / (of["high"] - of["low"])
        return np.stack([x, np.abs(curve[1][inside]) / peak], axis=1)

    points, wanted = plane(curve), plane(fine)
    high = points[:, 1] > 0.5
    return _away(points[high], wanted), _away(wanted[wanted[:, 1] > 0.5], points)


def _away(points: np.ndarray, line: np.ndarray) -> float:
    """Largest distance of points from a polygon."""
    begin, way = line[:-1], np.diff(line, axis=0)
    length = np.maximum(np.sum(way**2, axis=1), 1e-300)
    worst = 0.0
    for point in points:
        fraction = np.clip(np.sum((point - begin) * way, axis=1) / length, 0, 1)
        apart = point - begin - fraction[:, None] * way
        worst = max(worst, float(np.sqrt(np.min(np.sum(apart**2, axis=1)))))
    return worst


def ours(of: dict[str, Any], n_modes: int | None, **settings: object) -> tuple[float, tuple]:
    """Median seconds of warm runs, and the curve."""
    model = structure(of, n_modes)
    curve = respond(of, model, **settings)
    seconds = []
    for _ in range(RUNS):
        begin = time.perf_counter()
        curve = respond(of, model, **settings)
        seconds.append(time.perf_counter() - begin)
    return float(np.median(seconds)), curve


def theirs(name: str, of: dict[str, Any], python: str, clones: Path) -> tuple[float, tuple] | str:
    """Median seconds of warm runs and the curve, or the last line of what went wrong."""
    paths = [clones / "nlvib" / "src", clones / "tmd"]
    with tempfile.TemporaryDirectory() as folder:
        given, found = Path(folder) / "problem", Path(folder) / "curves"
        given.write_bytes(pickle.dumps({**of, "runs": RUNS + 1}))
        script = Path(__file__).with_name("element_peer_codes.py")
        try:
            done = subprocess.run(
                [python, str(script), name, str(given), str(found)],
                **{"capture_output": True, "text": True, "timeout": LIMIT, "cwd": folder},
                env={**os.environ, "PYTHONPATH": ":".join(map(str, paths))},
            )
        except subprocess.TimeoutExpired:
            return f"four runs took more than {LIMIT} s"
        if done.returncode:
            return done.stderr.strip().splitlines()[-1]
        runs = pickle.loads(found.read_bytes())
    return float(np.median([seconds for seconds, _ in runs[1:]])), runs[-1][1]


def main() -> None:
    """All programs on all problems."""
    chosen = options(__doc__, python="python with pyHarm-os", clones="folder with clones")
    for title, of in problems().items():
        fine = respond(of, structure(of, None), stability=False, steps=FINE)
        whole = len(of["mass"])
        runs = {"snrmjax": ours(of, None), "snrmjax, bare": ours(of, None, stability=False)}
        if whole > 8:
            runs["snrmjax, 8 modes"] = ours(of, 8)
            runs["snrmjax, 8 modes, bare"] = ours(of, 8, stability=False)
        for name in ("pyharm", "nlvib", "tmdsimpy"):
            runs[name] = theirs(name, of, chosen.python, Path(chosen.clones))
        for name, run in runs.items():
            if isinstance(run, str):
                tell(problem=title, program=name, failed=run)
                continue
            seconds, curve = run
            if np.sum((curve[0] >= of["low"]) & (curve[0] <= of["high"])) < 10:
                tell(problem=title, program=name, failed=f"{len(curve[0])} points: no curve")
                continue
            error, chords = distances(of, curve, fine)
            tell(
                **{"problem": title, "program": name, "seconds": seconds},
                **{"points": len(curve[0]), "milliseconds_a_point": 1e3 * seconds / len(curve[0])},
                **{"error": error, "chords": chords, "peak": np.abs(curve[1]).max()},
            )
        jax.clear_caches()


if __name__ == "__main__":
    main()
