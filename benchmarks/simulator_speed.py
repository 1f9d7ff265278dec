"""Seconds a point of a forced response, against other programs and against the LU solves alone.

Run: python benchmarks/simulator_speed.py [--without-peers] [--out DIR] [--environments DIR]

Two curves with nine harmonics around all their folds: the flat beam (77 unknowns with the
frequency) and the monostable curved beam (20). The peers are jaxcont and a plain
NumPy/SciPy program (`peers/`). They get the equations as numbers, not the package, and run in
environments of their own. The limit is as many LU factorisations as snrmjax used, and nothing else.
All methods take turns; times are medians of several warm runs, with the compile time of the first
run apart. `forced_response` also locates events and computes stability, which no peer does:
"snrmjax, no stability" leaves out the latter. The limit does not count the factorisations that
locate events.

Every curve is compared with snrmjax's of 31 harmonics (which shows the truncation error of nine)
and of nine in fine steps (which shows errors of the method): the largest distance of a point from
the reference, in the plane of frequency over the first natural frequency and velocity over its
peak. `reference_not_covered` is the opposite distance, from the reference to the chords between the
points: about the square of a step, unless a method left out a part of the curve.

Also: the first curve of a cold process, with and without a compilation cache; a second model of
the same size; 64 forces one by one and as one batch. One JSON line each, ratios last; the curves
go to `--out` as .npz.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import threading
import time
from importlib.metadata import version
from pathlib import Path
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from scipy.interpolate import CubicSpline

import snrmjax as sj

HERTZ = 2 * np.pi
PEERS = Path(__file__).parent / "peers"
HARMONICS, REFERENCE_HARMONICS = 9, 31
ROUNDS = {"snrmjax": 5, "numpy_scipy": 5, "jaxcont": 5, "lu": 5}
PEER_TOLERANCE = 1e-8  # on the last step or the residual, in scaled unknowns
PEER_LIMIT_SECONDS = 300.0  # for one answer of a peer
ONE_THREAD = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}  # faster at these sizes


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


def tell(**fields: object) -> None:
    """One JSON line."""
    rounded = {k: float(f"{v:.4g}") if isinstance(v, float) else v for k, v in fields.items()}
    print(json.dumps({"benchmark": "simulator_speed", **rounded}), flush=True)


# snrmjax itself -----------------------------------------------------------------------------


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


def without_stability(case: Case) -> list[sj.simulate.ResponseCurve]:
    """The same without stability, which the peers do not compute either."""
    return respond(case, stability=False)


METHODS = {"snrmjax": respond, "snrmjax, no stability": without_stability}


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


# The peers ----------------------------------------------------------------------------------


def write_problem(case: Case, scale: float, target: Path) -> None:
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
    problem = {
        "natural_frequency": modes.natural_frequency.tolist(),
        "damping_ratio": modes.damping_ratio.tolist(),
        "participation": modes.participation.tolist(),
        "mode_shape": modes.mode_shape[0].tolist(),
        "monomials": list(force),
        "coefficient": [row.tolist() for row in force.values()],
        "force": case.force,
        "from_hz": ends[0],
        "to_hz": ends[1],
        "harmonic_order": HARMONICS,
        "n_samples": 4 * HARMONICS + 4,
        "displacement_scale": scale,
        "first_step": steps.first,
        "largest_step": steps.largest,
        "smallest_step": steps.smallest,
        "angle": steps.angle,
        "tolerance": PEER_TOLERANCE,
    }
    target.write_text(json.dumps(problem))


def environment(folder: Path, peer: str) -> Path | None:
    """The Python of a peer's own environment, made on first use; None when it cannot be."""
    python = folder / peer / "bin" / "python"
    requirements = PEERS / f"requirements_{peer}.txt"
    try:
        if not python.exists():
            subprocess.run([sys.executable, "-m", "venv", folder / peer], check=True)
        install = [python, "-m", "pip", "install", "-qq", "-r", requirements]
        subprocess.run(install, check=True, stdout=sys.stderr)
    except subprocess.CalledProcessError as error:
        tell(measurement="environment", method=peer, status=f"skipped: not installed ({error})")
        return None
    return python


class Peer:
    """A peer that has followed its curve once and follows it again whenever asked."""

    def __init__(self, python: Path, script: str, case: Case, out: Path):
        name = f"{script.removesuffix('_peer.py')}_{case.beam}"
        self.curve = out / f"{name}.npz"
        variables = {k: v for k, v in os.environ.items() if k != "JAX_COMPILATION_CACHE_DIR"}
        # A home of its own: numba compiles in this run too.
        self.home = tempfile.TemporaryDirectory()
        variables |= {"HOME": self.home.name, "NUMBA_CACHE_DIR": self.home.name}
        with (out / f"{name}.log").open("w") as log:
            self.process = subprocess.Popen(
                [python, PEERS / script, out / f"problem_{case.beam}.json", self.curve],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=log,
                text=True,
                env=variables | ONE_THREAD,
                cwd=self.home.name,
            )
        default = {"method": script.removesuffix("_peer.py"), "version": "unknown"}
        self.first = default | self.answer()
        self.seconds: list[float] = []

    def answer(self) -> dict:
        """The next line of the peer, or a status that says that none came."""
        timer = threading.Timer(PEER_LIMIT_SECONDS, self.process.kill)
        timer.start()
        line = self.process.stdout.readline()
        timer.cancel()
        return json.loads(line) if line else {"status": "ended or ran too long without an answer"}

    def run(self) -> None:
        """One more timed run."""
        if "points" not in self.first or self.process.poll() is not None:
            return
        self.process.stdin.write("\n")
        self.process.stdin.flush()
        reply = self.answer()
        if "seconds" in reply:
            self.seconds.append(reply["seconds"])

    def close(self) -> None:
        """Let it end."""
        self.process.stdin.close()
        self.process.wait(timeout=30)
        self.home.cleanup()


# The limit ----------------------------------------------------------------------------------


@eqx.filter_jit
def _factorise(matrix: jax.Array, repeats: int) -> jax.Array:
    def body(_: int, carry: jax.Array) -> jax.Array:
        # The next matrix depends on the last factors, so that none is left out.
        return matrix + 1e-30 * jax.lax.linalg.lu(carry)[0][0, 0]

    return jax.lax.fori_loop(0, repeats, body, matrix)


def lu_seconds_jax(size: int, repeats: int = 2000) -> float:
    """Seconds of one LU factorisation inside one compiled loop."""
    matrix = jnp.asarray(np.random.default_rng(0).normal(size=(size, size)))
    return timed(lambda: jax.block_until_ready(_factorise(matrix, repeats)))[0] / repeats


def lu_seconds_lapack(size: int) -> float:
    """Seconds of one call of LAPACK's dgetrf from Python."""
    command = [sys.executable, PEERS / "scipy_peer.py", "--lu", str(size)]
    done = subprocess.run(
        command, check=True, capture_output=True, text=True, env=os.environ | ONE_THREAD
    )
    return json.loads(done.stdout)["seconds"]


def timed(function) -> tuple[float, object]:
    """Seconds of a call, and what it gave."""
    begin = time.perf_counter()
    result = function()
    return time.perf_counter() - begin, result


# The measurements ---------------------------------------------------------------------------


def compare(case: Case, out: Path, pythons: dict[str, Path]) -> dict[str, object]:
    """All methods on one beam in turn; prints their lines and returns the ratios."""
    first, curves = {}, {}
    for name, method in METHODS.items():
        first[name], curves[name] = timed(lambda method=method: method(case))
    seconds: dict[str, list[float]] = {name: [] for name in METHODS}
    motion = np.concatenate([np.asarray(c.coefficients)[:, 1:3] for c in curves["snrmjax"]])
    write_problem(case, float(np.max(np.abs(motion))), out / f"problem_{case.beam}.json")
    peers = [Peer(python, f"{name}_peer.py", case, out) for name, python in pythons.items()]
    lu_seconds_jax(case.unknowns)
    lu = {"dgetrf": [], "jax": []}
    for turn in range(max(ROUNDS.values())):
        for name, method in METHODS.items():
            if turn < ROUNDS["snrmjax"]:
                seconds[name].append(timed(lambda method=method: method(case))[0])
        for peer in peers:
            if turn < ROUNDS.get(peer.first["method"], 0):
                peer.run()
        if turn < ROUNDS["lu"]:
            lu["dgetrf"].append(lu_seconds_lapack(case.unknowns))
            lu["jax"].append(lu_seconds_jax(case.unknowns))
    for peer in peers:
        peer.close()
    targets = {h: reference(case, h) for h in (HARMONICS, REFERENCE_HARMONICS)}
    np.savez(
        out / f"reference_{case.beam}.npz",
        frequency_hz=targets[REFERENCE_HARMONICS][0],
        velocity=targets[REFERENCE_HARMONICS][1],
    )
    natural = float(case.model.modes.natural_frequency[0]) / HERTZ
    unit = np.array([natural, np.max(targets[REFERENCE_HARMONICS][1])])

    def report(method: str, curve: tuple, compile_seconds: float | None, **fields: object) -> float:
        warm = fields["seconds"]
        tell(
            measurement="forced_response",
            method=method,
            beam=case.beam,
            unknowns=case.unknowns,
            points=len(curve[0]),
            compile_seconds=compile_seconds,
            seconds_per_point=warm / len(curve[0]),
            distance_to_31_harmonics=distance(case, curve, targets[REFERENCE_HARMONICS], unit),
            distance_to_9_harmonics=distance(case, curve, targets[HARMONICS], unit),
            reference_not_covered=distance(case, targets[HARMONICS], curve, unit),
            **fields,
        )
        return warm / len(curve[0])

    per_point: dict[str, float] = {}
    for name in METHODS:
        curve, warm = midspan(curves[name]), float(np.median(seconds[name]))
        np.savez(
            out / f"{name.replace(', ', '_').replace(' ', '_')}_{case.beam}.npz",
            frequency_hz=curve[0],
            velocity=curve[1],
        )
        per_point[name] = report(
            name,
            curve,
            first[name] - warm if name == "snrmjax" else None,  # the other shares its program
            seconds=warm,
            version=f"snrmjax {version('snrmjax')}, jax {jax.__version__}",
            settings="events and stability" if name == "snrmjax" else "events",
            status=" + ".join(sj.simulate.CurveStatus(int(c.status)).name for c in curves[name]),
            reached_hz=float(curve[0][-1]),
            n_solves=sum(int(c.n_solves) for c in curves[name]),
        )
    for peer in peers:
        answer = dict(peer.first)
        if not peer.seconds:
            tell(measurement="forced_response", beam=case.beam, **answer)
            continue
        saved, warm = np.load(peer.curve), float(np.median(peer.seconds))
        curve = (saved["frequency_hz"], saved["velocity"])
        per = report(
            answer["method"],
            curve,
            max(answer["prepare_seconds"] + answer["first_seconds"] - warm, 0.0),
            seconds=warm,
            **{k: answer[k] for k in ("version", "settings", "status", "reached_hz", "n_solves")},
        )
        if answer["status"] == "ok":
            per_point[answer["method"]] = per
    one = {name: float(np.median(times)) for name, times in lu.items()}
    count = sum(int(c.n_solves) for c in curves["snrmjax"])
    for name, each in one.items():
        tell(
            measurement="lu_limit",
            method=name,
            beam=case.beam,
            unknowns=case.unknowns,
            factorisations=count,
            seconds=each * count,
            seconds_per_factorisation=each,
        )
    peer_times = {k: v for k, v in per_point.items() if k not in METHODS}
    fastest = min(peer_times, key=peer_times.get, default=None)
    ratios: dict[str, object] = {"beam": case.beam, "fastest_peer": fastest}
    for name, label in (("snrmjax", "ours"), ("snrmjax, no stability", "no_stability")):
        ratios[f"{label}_over_lu_limit"] = float(np.median(seconds[name])) / (
            min(one.values()) * count
        )
        if fastest:
            ratios[f"fastest_peer_over_{label}"] = peer_times[fastest] / per_point[name]
    return ratios


COLD_PROCESS = """
import json, time
begin = time.perf_counter()
import snrmjax as sj
imported = time.perf_counter()
model = sj.model.flat_beam()
sj.forced_response(model, [{force}], {lower}, {upper}, harmonic_order={harmonics})
done = time.perf_counter()
sj.forced_response(model, [{force}], {lower}, {upper}, harmonic_order={harmonics})
again = time.perf_counter()
print(json.dumps([imported - begin, done - imported, again - done]))
"""


def cold_process(repeats: int = 3) -> None:
    """From the start of a process to its first curve: no cache, an empty one, a filled one."""
    case = CASES[0]
    script = COLD_PROCESS.format(
        force=case.force,
        lower=case.from_hz * HERTZ,
        upper=case.to_hz * HERTZ,
        harmonics=HARMONICS,
    )
    plain = {k: v for k, v in os.environ.items() if k != "JAX_COMPILATION_CACHE_DIR"}
    with tempfile.TemporaryDirectory() as cache:
        cached = plain | {
            "JAX_COMPILATION_CACHE_DIR": cache,
            "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0.3",  # as the commands set it
        }
        for name, variables, n in (
            ("none", plain, repeats),
            ("empty", cached, 1),
            ("filled", cached, repeats),
        ):
            rows = []
            for _ in range(n):
                command = [sys.executable, "-c", script]
                whole, done = timed(
                    lambda command=command, variables=variables: subprocess.run(
                        command, check=True, capture_output=True, text=True, env=variables
                    )
                )
                rows.append([*json.loads(done.stdout.splitlines()[-1]), whole])
            imports, first, second, whole = np.median(rows, axis=0).tolist()
            tell(
                measurement="first_curve_of_a_cold_process",
                beam=case.beam,
                compilation_cache=name,
                import_seconds=imports,
                first_curve_seconds=first,
                second_curve_seconds=second,
                process_seconds=whole - second,
                repeats=n,
            )


def second_model() -> None:
    """Another model of the same size: its first curve against a warm one, and compilations."""
    compiled: list[float] = []

    def listen(event: str, seconds: float, **_: object) -> None:
        if event.endswith("backend_compile_duration"):
            compiled.append(seconds)

    jax.monitoring.register_event_duration_secs_listener(listen)
    for case in CASES:
        respond(case)
        warm = float(np.median([timed(lambda case=case: respond(case))[0] for _ in range(3)]))
        potential = case.model.potential
        changed = sj.model.polynomial_potential(
            dict(zip(potential.monomials, 1.02 * np.asarray(potential.coefficient), strict=True)),
            case.model.n_modes,
        )
        other = eqx.tree_at(lambda m: m.potential, case.model, changed)
        compiled.clear()
        first, curves = timed(lambda case=case, other=other: respond(case, other))
        count = len(compiled)
        tell(
            measurement="second_model_of_the_same_size",
            beam=case.beam,
            warm_seconds=warm,
            first_seconds=first,
            compilations=count,
            points=sum(len(c.frequency) for c in curves),
            first_over_warm=first / warm,
        )


def batch(n_forces: int = 64) -> None:
    """Many forces as single calls and as one batch, without stability."""
    for case in CASES:
        settings = {"harmonic_order": HARMONICS, "stability": False}
        forces = np.geomspace(0.1 * case.force, case.force, n_forces).tolist()
        ends = (case.from_hz * HERTZ, case.to_hz * HERTZ)

        def one_by_one(
            case: Case = case, forces: list = forces, ends: tuple = ends, settings: dict = settings
        ) -> list:
            return [sj.forced_response(case.model, [force], *ends, **settings) for force in forces]

        def together(
            case: Case = case, forces: list = forces, ends: tuple = ends, settings: dict = settings
        ) -> object:
            return sj.simulate.forced_response_batch(
                case.model, forces, *ends, settings=sj.simulate.ResponseSettings(**settings)
            )

        first = {f.__name__: timed(f)[0] for f in (one_by_one, together)}
        runs = [(timed(one_by_one)[0], timed(together)[0]) for _ in range(3)]
        single, batched = np.median(runs, axis=0).tolist()
        tell(
            measurement="batch_of_forces",
            beam=case.beam,
            forces=n_forces,
            single_calls_seconds=single,
            batch_seconds=batched,
            batch_compile_seconds=first["together"] - batched,
            single_over_batch=single / batched,
        )


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--without-peers", action="store_true", help="NumPy/SciPy and LU only")
    parser.add_argument("--out", type=Path, help="folder for curves and logs (else temporary)")
    parser.add_argument(
        "--environments", type=Path, help="folder of the peers' environments (else temporary)"
    )
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        out = (options.out or Path(scratch) / "out").resolve()
        folder = (options.environments or Path(scratch) / "environments").resolve()
        out.mkdir(parents=True, exist_ok=True)
        pythons = {"scipy": Path(sys.executable)}
        if not options.without_peers:
            python = environment(folder, "jaxcont")
            if python:
                pythons["jaxcont"] = python
        ratios = [compare(case, out, pythons) for case in CASES]
    cold_process()
    second_model()
    batch()
    for row in ratios:
        tell(measurement="ratios", **row)


if __name__ == "__main__":
    main()
