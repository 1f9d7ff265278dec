"""Speed of forced responses on one core: stability, batches, a bare LU, jaxcont, a cold process.

Run: python benchmarks/speed_per_core.py [--environments DIR] [--without-peers] [--before PATH]

All processes run on one core. In every comparison the methods take turns; times are medians of warm
runs. The curves are those of simulator_speed.py (nine harmonics, around all folds) and, as a small
problem, one mode with five harmonics. One JSON line each:

- `stability`: seconds a point of one curve with stability over without;
- `batch_of_64`: seconds a curve of 64 single calls over one batch, without and with stability; over
  the LU factorisations (LAPACK's dgetrf) that the batch made, and nothing else; and jaxcont's
  seconds a curve for the same forces, by `jax.vmap` as its documentation has it and one by one;
- `first_curve_of_a_cold_process`: import and first curve, stability included, without a compilation
  cache, with an empty one and with a filled one of `snrmjax.use_compilation_cache`; jaxcont's
  import and first curve (without stability, which it does not compute).

With `--before` the measurements of snrmjax alone run with another checkout too (its folder).
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from scipy.linalg.lapack import dgetrf
from simulator_cost import chain
from simulator_speed import CASES, HARMONICS, HERTZ, ONE_THREAD, PEERS, environment, write_problem

import snrmjax as sj

MEMBERS = 64
ROUNDS = 5
SMALL = ("one mode", chain(1), 1.0, 60.0, 110.0, 5)
CURVES = (SMALL, *((c.beam, c.model, c.force, c.from_hz, c.to_hz, HARMONICS) for c in CASES))


def tell(**fields: object) -> None:
    """One JSON line."""
    rounded = {k: float(f"{v:.4g}") if isinstance(v, float) else v for k, v in fields.items()}
    print(json.dumps({"benchmark": "speed_per_core", **rounded}), flush=True)


def medians(**functions: object) -> dict[str, float]:
    """Median seconds of functions that take turns, after one run of each."""
    seconds: dict[str, list[float]] = {name: [] for name in functions}
    for turn in range(ROUNDS + 1):
        for name, function in functions.items():
            begin = time.perf_counter()
            function()
            if turn:
                seconds[name].append(time.perf_counter() - begin)
    return {name: float(np.median(times)) for name, times in seconds.items()}


def lu_seconds(size: int, repeats: int = 500) -> float:
    """Seconds of one factorisation by LAPACK."""
    matrix = np.asfortranarray(np.random.default_rng(0).normal(size=(size, size)))
    begin = time.perf_counter()
    for _ in range(repeats):
        dgetrf(matrix)
    return (time.perf_counter() - begin) / repeats


def stability() -> None:
    """One curve with and without stability."""
    for beam, model, force, lower, upper, order in CURVES:

        def respond(stable: bool, model=model, force=force, ends=(lower, upper), order=order):
            ends = tuple(end * HERTZ for end in ends)
            return sj.forced_response(model, [force], *ends, harmonic_order=order, stability=stable)

        points = sum(len(c.frequency) for c in respond(True))
        found = medians(bare=lambda r=respond: r(False), stable=lambda r=respond: r(True))
        tell(
            measurement="stability",
            beam=beam,
            points=points,
            seconds_per_point_without=found["bare"] / points,
            seconds_per_point_with=found["stable"] / points,
            with_over_without=found["stable"] / found["bare"],
        )


def batches(peer: dict[str, dict]) -> None:
    """Single calls against a batch; the batch against its LU factorisations and jaxcont."""
    for beam, model, force, lower, upper, order in CURVES:
        forces, ends = np.geomspace(0.1 * force, force, MEMBERS), (lower * HERTZ, upper * HERTZ)

        def single(stable: bool, model=model, forces=forces, ends=ends, order=order) -> None:
            for one in forces.tolist():
                sj.forced_response(model, [one], *ends, harmonic_order=order, stability=stable)

        def batch(stable: bool, model=model, forces=forces, ends=ends, order=order) -> object:
            settings = sj.simulate.ResponseSettings(harmonic_order=order, stability=stable)
            return sj.simulate.forced_response_batch(model, forces, *ends, settings=settings)

        size = (2 * order + 1) * model.n_modes + 1
        solves = sum(c.n_solves for parts in batch(False).curves for c in parts)
        found = medians(
            single=lambda s=single: s(False),
            batch=lambda b=batch: b(False),
            stable_single=lambda s=single: s(True),
            stable_batch=lambda b=batch: b(True),
            lu=lambda size=size: lu_seconds(size),
        )
        lu = float(np.median([lu_seconds(size) for _ in range(ROUNDS)])) * solves
        fields = {
            "single_over_batch": found["single"] / found["batch"],
            "single_over_batch_with_stability": found["stable_single"] / found["stable_batch"],
            "batch_over_lu": found["batch"] / lu,
            "batch_with_stability_over_lu": found["stable_batch"] / lu,
        }
        for name, seconds in peer.get(beam, {}).items():
            fields[f"jaxcont_{name}_seconds_per_curve"] = seconds / MEMBERS
        if beam in peer:
            best = min(v for v in peer[beam].values())
            fields["jaxcont_over_batch"] = best / found["batch"]
        tell(
            measurement="batch_of_64",
            beam=beam,
            unknowns=size,
            single_seconds_per_curve=found["single"] / MEMBERS,
            batch_seconds_per_curve=found["batch"] / MEMBERS,
            batch_with_stability_seconds_per_curve=found["stable_batch"] / MEMBERS,
            lu_seconds_per_curve=lu / MEMBERS,
            **fields,
        )


COLD = """
import time
begin = time.perf_counter()
import snrmjax as sj
import sys
if len(sys.argv) > 1:
    sj.use_compilation_cache(sys.argv[1])
sj.forced_response(sj.model.flat_beam(), [{force}], {lower}, {upper}, harmonic_order={order})
print(time.perf_counter() - begin)
"""


def seconds_of(command: list, **variables: str) -> float:
    """The last line of a process of its own, as a number."""
    hidden = ("JAX_COMPILATION_CACHE_DIR", "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS")
    plain = {k: v for k, v in os.environ.items() if k not in hidden}
    done = subprocess.run(
        command, check=True, capture_output=True, text=True, env=plain | ONE_THREAD | variables
    )
    return float(done.stdout.splitlines()[-1])


def cold(python: Path | None, problem: Path, repeats: int = 3) -> None:
    """From import to the first curve, everybody in turn."""
    _, _, force, lower, upper, order = CURVES[1]
    script = COLD.format(force=force, lower=lower * HERTZ, upper=upper * HERTZ, order=order)
    found: dict[str, list[float]] = {}
    for _ in range(repeats):
        with tempfile.TemporaryDirectory() as cache:
            rows = {"none": [], "empty": [cache], "filled": [cache]}
            for name, arguments in rows.items():
                seconds = seconds_of([sys.executable, "-c", script, *arguments])
                found.setdefault(name, []).append(seconds)
        if python:
            command = [python, PEERS / "jaxcont_peer.py", problem, "--cold"]
            found.setdefault("jaxcont", []).append(seconds_of(command))
    middle = {name: float(np.median(values)) for name, values in found.items()}
    over = {}
    if "jaxcont" in middle:
        over = {f"{k}_over_jaxcont": v / middle["jaxcont"] for k, v in middle.items()}
        over.pop("jaxcont_over_jaxcont")
    named = {f"{name}_seconds": value for name, value in middle.items()}
    tell(measurement="first_curve_of_a_cold_process", beam="flat", **named, **over)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--environments", type=Path, help="folder of the peers' environments")
    parser.add_argument("--without-peers", action="store_true")
    parser.add_argument("--before", help="PYTHONPATH of another checkout, measured alternately")
    options = parser.parse_args()
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    with tempfile.TemporaryDirectory() as scratch:
        python, peer = None, {}
        folder = (options.environments or Path(scratch) / "environments").resolve()
        problem = {case.beam: Path(scratch) / f"{case.beam}.json" for case in CASES}
        if not options.without_peers:
            python = environment(folder, "jaxcont")
        for case in CASES:
            ends = (case.from_hz * HERTZ, case.to_hz * HERTZ)
            curves = sj.forced_response(case.model, [case.force], *ends, stability=False)
            largest = max(float(np.max(np.abs(c.coefficients[:, 1:3]))) for c in curves)
            write_problem(case, largest, problem[case.beam])
            if python:
                command = [python, PEERS / "jaxcont_peer.py", problem[case.beam], "--batch"]
                done = subprocess.run(
                    [*command, str(MEMBERS)], capture_output=True, text=True, check=True
                )
                peer[case.beam] = json.loads(done.stdout.splitlines()[-1])
        stability()
        batches(peer)
        cold(python, problem["flat"])
    if options.before:
        again = [sys.executable, __file__, "--without-peers"]
        print(json.dumps({"benchmark": "speed_per_core", "checkout": "before"}), flush=True)
        subprocess.run(again, check=True, env=os.environ | {"PYTHONPATH": options.before})


if __name__ == "__main__":
    main()
