"""Seconds a point of a forced response, against other programs and against the LU solves alone.

Run: OMP_NUM_THREADS=1 python benchmarks/simulator_speed.py

Two curves with nine harmonics around all their folds: the flat beam (77 unknowns with the
frequency) and the monostable curved beam (20). The peer is a plain NumPy/SciPy program
(`simulator_peer.py`), which gets the equations as numbers, not the package. The limit is as many LU
factorisations (LAPACK) as snrmjax used, and nothing else. All take turns; times are medians of warm
runs, with the compile time of the first run apart. `forced_response` also locates events and
computes stability, which the peer does not: "no_stability" leaves out the latter.

Every curve is compared with snrmjax's of 31 harmonics (which shows the truncation error of nine)
and of nine in fine steps (which shows errors of the method): the largest distance of a point from
the reference, in the plane of frequency over the first natural frequency and velocity over its
peak. `reference_not_covered` is the opposite distance, from the reference to the chords between the
points: about the square of a step, unless a method left out a part of the curve.

Also: the first curve of a cold process, with and without a compilation cache; 64 forces one by one
and as one batch, with and without stability.
"""

import json
import os
import subprocess
import sys
import tempfile
from typing import NamedTuple

import jax
import numpy as np
import simulator_peer
from harness import medians, options, seconds_of, teller
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
        share = np.clip(np.sum((point - begin) * along, axis=1) / length, 0, 1)
        gaps = np.linalg.norm(begin + share[:, None] * along - point, axis=1)
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


def compare(case: Case) -> None:
    """All methods on one beam; prints their lines, the ratios last."""
    first, curves = seconds_of(lambda: respond(case))
    motion = np.concatenate([np.asarray(c.coefficients)[:, 1:3] for c in curves])
    problem = problem_of(case, float(np.max(np.abs(motion))))
    peer = simulator_peer.solver(problem)
    matrix = np.random.default_rng(0).normal(size=(case.unknowns, case.unknowns))
    factorised = np.asfortranarray(matrix)
    solves = sum(int(c.n_solves) for c in curves)
    seconds = medians(
        ROUNDS,
        snrmjax=lambda: respond(case),
        no_stability=lambda: respond(case, stability=False),
        numpy_scipy=peer,
        lu_limit=lambda: [dgetrf(factorised) for _ in range(solves)],
    )
    followed = peer()
    found = {
        "snrmjax": (midspan(curves), solves, "events and stability"),
        "no_stability": (midspan(respond(case, stability=False)), solves, "events"),
        "numpy_scipy": (simulator_peer.midspan(problem, followed), followed.n_solves, ""),
    }
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
        f"numpy_scipy_over_{ours}": per_point["numpy_scipy"] / per_point[ours]
        for ours in ("snrmjax", "no_stability")
    }
    over = {f"{name}_over_lu_limit": seconds[name] / seconds["lu_limit"] for name in found}
    tell(measurement="ratios", beam=case.beam, **ratios, **over)


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


def cold_process(repeats: int = 3) -> None:
    """From the start of a process to its first curve: no cache, an empty one, a filled one."""
    case = CASES[0]
    ends = {"lower": case.from_hz * HERTZ, "upper": case.to_hz * HERTZ}
    script = COLD_PROCESS.format(force=case.force, harmonics=HARMONICS, **ends)
    plain = {k: v for k, v in os.environ.items() if k != "JAX_COMPILATION_CACHE_DIR"}
    found: dict[str, list] = {}
    for _ in range(repeats):
        with tempfile.TemporaryDirectory() as cache:
            for name, arguments in (("none", []), ("empty", [cache]), ("filled", [cache])):
                command = [sys.executable, "-c", script, *arguments]
                done = subprocess.run(
                    command, check=True, capture_output=True, text=True, env=plain
                )
                found.setdefault(name, []).append(json.loads(done.stdout.splitlines()[-1]))
    for name, rows in found.items():
        imports, first = np.median(rows, axis=0)
        tell(
            measurement="first_curve_of_a_cold_process",
            beam=case.beam,
            compilation_cache=name,
            import_seconds=imports,
            first_curve_seconds=first,
            repeats=repeats,
        )


def batch(case: Case) -> None:
    """Many forces as single calls and as one batch."""
    forces = np.geomspace(0.1 * case.force, case.force, MEMBERS).tolist()
    ends = case.from_hz * HERTZ, case.to_hz * HERTZ
    for stability in (False, True):
        settings = {"harmonic_order": HARMONICS, "stability": stability}

        def single(settings: dict = settings) -> None:
            for force in forces:
                sj.forced_response(case.model, [force], *ends, **settings)

        def together(settings: dict = settings) -> None:
            asked = sj.simulate.ResponseSettings(**settings)
            sj.simulate.forced_response_batch(case.model, forces, *ends, settings=asked)

        found = medians(3, single=single, together=together)
        tell(
            measurement="batch_of_forces",
            beam=case.beam,
            stability=stability,
            forces=MEMBERS,
            single_seconds_a_curve=found["single"] / MEMBERS,
            batch_seconds_a_curve=found["together"] / MEMBERS,
            single_over_batch=found["single"] / found["together"],
        )


def main() -> None:
    """Measure and print."""
    options(__doc__)
    tell(measurement="device", device=jax.devices()[0].device_kind, cores=os.cpu_count())
    for case in CASES:
        compare(case)
    cold_process()
    for case in CASES:
        batch(case)


if __name__ == "__main__":
    main()
