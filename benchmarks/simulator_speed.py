"""Seconds a point of a forced response, against other programs and against the LU solves alone.

Run: OMP_NUM_THREADS=1 python benchmarks/simulator_speed.py --environments DIR

Two curves with nine harmonics around all their folds: the flat beam (77 unknowns with the
frequency) and the monostable curved beam (20). The peers are a plain NumPy/SciPy program
(`simulator_peer.py`), jaxcont and pyHarm-os (`simulator_peer_*.py`, in environments of their own,
made in the given folder on first use; without one, left out). They get the equations as numbers,
not the package. The limit is as many LU factorisations (LAPACK) as snrmjax used, and nothing else.
All take turns; times are medians of warm runs, with the compile time of the first run apart.
`forced_response` also locates events and computes stability, which no peer does: "no_stability"
leaves out the latter.

Every curve is compared with snrmjax's of 31 harmonics (which shows the truncation error of nine)
and of nine in fine steps (which shows errors of the method): the largest distance of a point from
the reference, in the plane of frequency over the first natural frequency and velocity over its
peak. `reference_not_covered` is the opposite distance, from the reference to the chords between the
points: about the square of a step, unless a method left out a part of the curve.

Also: the first curve of a cold process, with and without a compilation cache; 64 forces one by one
and as one batch, with and without stability, beside jaxcont's engine, one by one and under `vmap`.
"""

import json
import os
import pickle
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
import simulator_peer
from harness import HERE, medians, options, seconds_of, teller
from scipy.interpolate import CubicSpline
from scipy.linalg.lapack import dgetrf
from simulator_peer import Problem

import snrmjax as sj

tell = teller(__file__)

HERTZ = 2 * np.pi
HARMONICS, REFERENCE_HARMONICS = 9, 31
ROUNDS = 5
PEER_TOLERANCE = 1e-8  # on the last step or the residual, in scaled unknowns
MEMBERS = 64
PLAIN = {k: v for k, v in os.environ.items() if k != "JAX_COMPILATION_CACHE_DIR"}
REQUIREMENTS = {"jaxcont": "jaxcont==0.4.0", "pyharm": "pyHarm-os==1.2.2"}


class Case(NamedTuple):
    """One curve to follow."""

    beam: str
    model: sj.model.Structure
    force: float  # N
    from_hz: float
    to_hz: float
    downward: bool  # the peers start where the linear response is a good guess

    @property
    def unknowns(self) -> int:
        """Coefficients and the frequency."""
        return (2 * HARMONICS + 1) * self.model.n_modes + 1


CASES = (
    Case("flat", sj.model.flat_beam(), 1.334e-2, 60.0, 120.0, downward=False),
    Case("curved", sj.model.curved_beam("monostable"), 1.779e-3, 25.0, 140.0, downward=True),
)


def respond(
    case: Case, model: sj.model.Structure | None = None, **settings: object
) -> list[sj.simulate.ResponseCurve]:
    """The response of one case; two parts where neither end is reached from the other."""
    return sj.forced_response(
        model or case.model,
        [case.force],
        case.from_hz * HERTZ,
        case.to_hz * HERTZ,
        **{"harmonic_order": HARMONICS, **settings},
    )


def midspan(curves: list[sj.simulate.ResponseCurve]) -> tuple[np.ndarray, np.ndarray]:
    """Frequency (Hz) and velocity amplitude of the fundamental (m/s) along the curve."""
    frequency = np.concatenate([np.asarray(c.frequency) for c in curves]) / HERTZ
    return frequency, np.concatenate([np.abs(np.asarray(c.velocity)[:, 1, 0]) for c in curves])


def reference(case: Case, harmonics: int) -> tuple[np.ndarray, np.ndarray]:
    """The curve in fine steps, and between them by a spline: its chords do not matter."""
    fine = sj.simulate.StepControl(largest=0.01, angle=0.02, tolerance=1e-10, max_points=8000)
    curves = respond(case, harmonic_order=harmonics, steps=fine)
    frequency, velocity = midspan(curves)
    # The spline runs along the arc of all unknowns: in the plane alone the curve may have cusps.
    x = np.concatenate([np.asarray(c.coefficients).reshape(len(c.frequency), -1) for c in curves])
    natural = float(case.model.modes.natural_frequency[0]) / HERTZ
    unknowns = np.concatenate([x / np.max(np.abs(x)), frequency[:, None] / natural], axis=1)
    chord = np.linalg.norm(np.diff(unknowns, axis=0), axis=1)
    apart = np.concatenate([[True], chord > 1e-7])
    arc = np.concatenate([[0.0], np.cumsum(chord)])[apart]
    between = np.interp(np.arange(8 * len(arc) - 7) / 8, np.arange(len(arc)), arc)
    spline = CubicSpline(arc, np.stack([frequency, velocity], axis=1)[apart])
    return tuple(spline(between).T)


def distance(case: Case, curve: tuple, target: tuple, unit: np.ndarray) -> float:
    """Largest distance of a curve's points within the range to the polyline of the target."""
    inside = (curve[0] >= case.from_hz) & (curve[0] <= case.to_hz)
    points = np.stack(curve, axis=1)[inside] / unit
    nodes = np.stack(target, axis=1) / unit
    begin, along = nodes[:-1], np.diff(nodes, axis=0)
    length = np.maximum(np.sum(along**2, axis=1), 1e-300)
    worst = 0.0
    for point in points:
        fraction = np.clip(np.sum((point - begin) * along, axis=1) / length, 0, 1)
        gaps = np.linalg.norm(begin + fraction[:, None] * along - point, axis=1)
        worst = max(worst, float(np.min(gaps)))
    return worst


def problem_of(case: Case, scale: float) -> Problem:
    """The equations of a case as numbers."""
    modes, potential = case.model.modes, case.model.potential
    force: dict[tuple[int, ...], np.ndarray] = {}
    for monomial, value in zip(potential.monomials, np.asarray(potential.coefficient), strict=True):
        for mode in sorted(set(monomial)):
            rest = list(monomial)
            rest.remove(mode)
            entry = force.setdefault(tuple(rest), np.zeros(case.model.n_modes))
            entry[mode] += monomial.count(mode) * value
    steps = sj.simulate.StepControl()
    ends = (case.to_hz, case.from_hz) if case.downward else (case.from_hz, case.to_hz)
    linear = (modes.natural_frequency, modes.damping_ratio, modes.participation)
    return Problem(
        *(np.asarray(one) for one in (*linear, modes.mode_shape[0])),
        monomials=tuple(force),
        coefficient=np.array(list(force.values())),
        force=case.force,
        from_hz=ends[0],
        to_hz=ends[1],
        harmonic_order=HARMONICS,
        n_samples=4 * HARMONICS + 4,
        displacement_scale=scale,
        first_step=steps.first,
        largest_step=steps.largest,
        smallest_step=steps.smallest,
        angle=steps.angle,
        tolerance=PEER_TOLERANCE,
    )


class Peer:
    """A program in an environment of its own that follows its curve whenever asked."""

    def __init__(self, folder: str, name: str, problem: Problem):
        python = Path(folder, name, "bin", "python").absolute()
        if not python.exists():
            subprocess.run([sys.executable, "-m", "venv", python.parents[1]], check=True)
            subprocess.run([python, "-m", "pip", "install", "-qq", REQUIREMENTS[name]], check=True)
        # A home of its own: numba compiles in this run too, and settings go nowhere else.
        self.home = tempfile.TemporaryDirectory()
        given = Path(self.home.name, "problem.pickle")
        given.write_bytes(pickle.dumps(problem))
        with Path(self.home.name, "log").open("w") as log:
            self.process = subprocess.Popen(
                [python, HERE / f"simulator_peer_{name}.py", given],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=log,
                text=True,
                cwd=self.home.name,
                env=PLAIN | {"HOME": self.home.name, "NUMBA_CACHE_DIR": self.home.name},
            )

    def ask(self, way: str) -> dict:
        """Its answer to the name of a way to run."""
        self.process.stdin.write(f"{way}\n")
        self.process.stdin.flush()
        line = self.process.stdout.readline()
        if not line:
            raise RuntimeError(Path(self.home.name, "log").read_text(encoding="utf-8"))
        return json.loads(line)

    def close(self) -> None:
        """Let it end."""
        self.process.stdin.close()
        self.process.wait(timeout=30)
        self.home.cleanup()


def lu_limit(case: Case, solves: int) -> Callable[[], list]:
    """Nothing but as many factorisations."""
    matrix = np.random.default_rng(0).normal(size=(case.unknowns, case.unknowns))
    factorised = np.asfortranarray(matrix)
    return lambda: [dgetrf(factorised) for _ in range(solves)]


def compare(case: Case, folder: str | None) -> Problem:
    """All methods on one beam; prints their lines, the ratios last. Returns the peers' problem."""
    first, curves = seconds_of(lambda: respond(case))
    motion = np.concatenate([np.asarray(c.coefficients)[:, 1:3] for c in curves])
    problem = problem_of(case, float(np.max(np.abs(motion))))
    peer = simulator_peer.solver(problem)
    peers = {name: Peer(folder, name, problem) for name in REQUIREMENTS if folder}
    solves = sum(int(c.n_solves) for c in curves)
    seconds = medians(
        ROUNDS,
        snrmjax=lambda: respond(case),
        no_stability=lambda: respond(case, stability=False),
        numpy_scipy=peer,
        lu_limit=lu_limit(case, solves),
        **{name: lambda other=other: other.ask("curve") for name, other in peers.items()},
    )
    followed = peer()
    found = {
        "snrmjax": (midspan(curves), solves, "events and stability"),
        "no_stability": (midspan(respond(case, stability=False)), solves, "events"),
        "numpy_scipy": (simulator_peer.midspan(problem, followed), followed.n_solves, ""),
    }
    for name, other in peers.items():
        told = other.ask("points")
        found[name] = (tuple(np.array(told["curve"])), told["n_solves"], told["version"])
        other.close()
    targets = {h: reference(case, h) for h in (HARMONICS, REFERENCE_HARMONICS)}
    natural = float(case.model.modes.natural_frequency[0]) / HERTZ
    unit = np.array([natural, np.max(targets[REFERENCE_HARMONICS][1])])
    for method, (curve, n_solves, settings) in found.items():
        tell(
            measurement="forced_response",
            method=method,
            settings=settings,
            beam=case.beam,
            unknowns=case.unknowns,
            points=len(curve[0]),
            n_solves=n_solves,
            compile_seconds=first - seconds["snrmjax"] if method == "snrmjax" else None,
            seconds=seconds[method],
            seconds_per_point=seconds[method] / len(curve[0]),
            distance_to_31_harmonics=distance(case, curve, targets[REFERENCE_HARMONICS], unit),
            distance_to_9_harmonics=distance(case, curve, targets[HARMONICS], unit),
            reference_not_covered=distance(case, targets[HARMONICS], curve, unit),
        )
    per_point = {name: seconds[name] / len(found[name][0][0]) for name in found}
    ratios = {
        f"{name}_over_{ours}": per_point[name] / per_point[ours]
        for name in ("numpy_scipy", *peers)
        for ours in ("snrmjax", "no_stability")
    }
    over = {f"{name}_over_lu_limit": seconds[name] / seconds["lu_limit"] for name in found}
    tell(measurement="ratios", beam=case.beam, **ratios, **over)
    return problem


COLD_PROCESS = """
import json, sys, time
begin = time.perf_counter()
import snrmjax as sj
if len(sys.argv) > 1:
    sj.use_compilation_cache(sys.argv[1])
imported = time.perf_counter()
sj.forced_response(sj.model.flat_beam(), [{force}], {lower}, {upper}, harmonic_order={harmonics})
print(json.dumps([imported - begin, time.perf_counter() - imported]))
"""


def cold_process(folder: str | None, problem: Problem, repeats: int = 3) -> None:
    """From the start of a process to its first curve: no cache, an empty one, a filled one."""
    case = CASES[0]
    ends = {"lower": case.from_hz * HERTZ, "upper": case.to_hz * HERTZ}
    script = COLD_PROCESS.format(force=case.force, harmonics=HARMONICS, **ends)
    found: dict[str, list] = {}
    for _ in range(repeats):
        with tempfile.TemporaryDirectory() as cache:
            for name, arguments in (("none", []), ("empty", [cache]), ("filled", [cache])):
                command = [sys.executable, "-c", script, *arguments]
                begin = time.perf_counter()
                done = subprocess.run(
                    command, check=True, capture_output=True, text=True, env=PLAIN
                )
                spent = [*json.loads(done.stdout.splitlines()[-1]), time.perf_counter() - begin]
                found.setdefault(name, []).append(spent)
        if folder:
            begin = time.perf_counter()
            peer = Peer(folder, "jaxcont", problem)
            peer.ask("curve")
            peer.close()
            spent = [np.nan, np.nan, time.perf_counter() - begin]
            found.setdefault("jaxcont", []).append(spent)
    for name, rows in found.items():
        imports, first, whole = np.median(rows, axis=0)
        tell(
            measurement="first_curve_of_a_cold_process",
            beam=case.beam,
            method="jaxcont" if name == "jaxcont" else "snrmjax",
            compilation_cache="none" if name == "jaxcont" else name,
            import_seconds=imports,
            first_curve_seconds=first,
            process_seconds=whole,
            repeats=repeats,
        )


def batch(case: Case, folder: str | None, problem: Problem) -> None:
    """Many forces as single calls and as one batch."""
    forces = np.geomspace(0.1 * case.force, case.force, MEMBERS).tolist()
    ends = case.from_hz * HERTZ, case.to_hz * HERTZ
    peer = Peer(folder, "jaxcont", problem) if folder else None
    ways = {"jaxcont": lambda: peer.ask("one_by_one")} if peer else {}
    vmap = [peer.ask("vmap")["seconds"] for _ in range(2)][1] if peer else np.nan
    for stability in (False, True):
        settings = {"harmonic_order": HARMONICS, "stability": stability}

        def single(settings: dict = settings) -> None:
            for force in forces:
                sj.forced_response(case.model, [force], *ends, **settings)

        def together(settings: dict = settings) -> Any:
            asked = sj.simulate.ResponseSettings(**settings)
            return sj.simulate.forced_response_batch(case.model, forces, *ends, settings=asked)

        solves = sum(int(part.n_solves) for parts in together().curves for part in parts)
        limit = lu_limit(case, solves)
        found = medians(3, single=single, together=together, lu_limit=limit, **ways)
        tell(
            measurement="batch_of_forces",
            beam=case.beam,
            stability=stability,
            forces=MEMBERS,
            single_seconds_a_curve=found["single"] / MEMBERS,
            batch_seconds_a_curve=found["together"] / MEMBERS,
            single_over_batch=found["single"] / found["together"],
            batch_over_lu_limit=found["together"] / found["lu_limit"],
            jaxcont_one_by_one_seconds_a_curve=found.get("jaxcont", np.nan) / MEMBERS,
            jaxcont_vmap_seconds_a_curve=vmap / MEMBERS,
        )
    if peer:
        peer.close()


def main() -> None:
    """Measure and print."""
    folder = options(__doc__, environments=str).environments
    tell(measurement="device", device=jax.devices()[0].device_kind, cores=os.cpu_count())
    problems = [compare(case, folder) for case in CASES]
    cold_process(folder, problems[0])
    for case, problem in zip(CASES, problems, strict=True):
        batch(case, folder, problem)


if __name__ == "__main__":
    main()
