"""Cost of a response curve against harmonics and modes, and of ten thousand curves at once.

Run: python benchmarks/simulator_cost.py [--out FOLDER] [--members 10000]

A chain of Duffing-like modes (natural frequencies 80, 176, 272, … Hz, damping 1 %, a quartic
potential that couples neighbours) under one force: seconds a point of the continuation alone and of
`forced_response` without stability (medians of five warm runs), memory of the process, and the
seconds that its LU factorisations alone would take. Every size runs in a process of its own. One
JSON line each, and with --out a figure.
"""

import argparse
import json
import resource
import subprocess
import sys
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import snrmjax as sj

HARMONICS = (3, 5, 9, 15, 21, 31)
MODES = (1, 2, 4, 8, 16)
HZ = 2 * np.pi


def chain(n_modes: int) -> sj.model.Structure:
    """A structure of `n_modes` modes whose first one stiffens by a fifth under 1 N."""
    frequency = HZ * (80.0 + 96.0 * np.arange(n_modes))
    quartic = {(k, k, k, k): 2e11 * (k + 1) ** 2 for k in range(n_modes)}
    quartic |= {(k, k, k, k + 1): 1e11 for k in range(n_modes - 1)}
    quartic |= {(k, k, k + 1, k + 1): 3e11 for k in range(n_modes - 1)}
    shape = 2.0 * (-1.0) ** np.arange(n_modes)
    modes = sj.model.linear_modes(
        frequency, np.full(n_modes, 0.01), shape[None], 3.0 / (1.0 + np.arange(n_modes))
    )
    return sj.model.structure(modes, sj.model.polynomial_potential(quartic, n_modes))


def peak_memory() -> float:
    """Largest memory of this process so far, in MiB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def median_of(function, repeats: int = 5) -> float:
    """Median seconds of warm runs."""
    times = []
    for _ in range(repeats):
        begin = time.perf_counter()
        function()
        times.append(time.perf_counter() - begin)
    return float(np.median(times))


def lu_seconds(size: int, count: int) -> float:
    """Seconds for so many LU factorisations of a matrix of this size, and nothing else."""
    matrix = jnp.asarray(np.random.default_rng(0).normal(size=(size, size)))

    @jax.jit
    def factorise(matrix: jax.Array) -> jax.Array:
        def body(_: int, total: jax.Array) -> jax.Array:
            return total + jax.lax.linalg.lu(matrix + 1e-300 * total)[0][0, 0]

        return jax.lax.fori_loop(0, count, body, jnp.zeros(()))

    factorise(matrix).block_until_ready()
    return median_of(lambda: factorise(matrix).block_until_ready())


def one_size(harmonics: int, n_modes: int) -> dict:
    """Cost of the curve of one size."""
    from snrmjax.simulate.continuation.curve_tracing import response_balances, trace_from_rest

    model, force, before = chain(n_modes), 1.0, peak_memory()
    balances = response_balances([model], np.array([force]), harmonics, None)
    ends, steps = jnp.asarray([60.0, 110.0]) * HZ, sj.simulate.StepControl()

    def trace() -> list:
        return trace_from_rest(balances, np.arange(1), ends, steps, downward=False)

    def respond() -> sj.simulate.ResponseCurve:
        return sj.forced_response(
            model, [force], 60 * HZ, 110 * HZ, harmonic_order=harmonics, stability=False
        )[0]

    begin = time.perf_counter()
    curve = trace()[0]
    compile_seconds = time.perf_counter() - begin
    points, size = len(curve.points), n_modes * (2 * harmonics + 1)
    bare = median_of(trace)
    respond()
    whole = median_of(respond)
    limit = lu_seconds(size + 1, curve.n_solves)
    return {
        "benchmark": "cost against size",
        "harmonics": harmonics,
        "modes": n_modes,
        "unknowns": size,
        "points": points,
        "status": curve.status.name,
        "factorisations": curve.n_solves,
        "compile_seconds": round(compile_seconds, 2),
        "ms_per_point": round(1e3 * bare / points, 4),
        "ms_per_point_with_events": round(1e3 * whole / points, 4),
        "ratio_to_lu": round(bare / limit, 2),
        "memory_MiB": round(peak_memory()),
        "memory_above_start_MiB": round(peak_memory() - before),
    }


def many_curves(members: int) -> dict:
    """A batch of single-mode curves whose models and forces all differ."""
    rng = np.random.default_rng(0)
    model = chain(1)
    coefficient = np.asarray(model.potential.coefficient)[0] * rng.uniform(0.5, 2.0, members)

    def with_coefficient(value: float) -> sj.model.Structure:
        potential = sj.model.polynomial_potential({"1111": float(value)}, 1)
        return sj.model.structure(model.modes, potential)

    models = [with_coefficient(value) for value in coefficient]
    forces = rng.uniform(0.2, 2.0, members)
    settings = {
        "settings": sj.simulate.ResponseSettings(harmonic_order=5, stability=False),
        "keep_curves": False,
    }
    sj.simulate.forced_response_batch(models[:64], forces[:64], 60 * HZ, 140 * HZ, **settings)
    before, begin = peak_memory(), time.perf_counter()
    batch = sj.simulate.forced_response_batch(models, forces, 60 * HZ, 140 * HZ, **settings)
    seconds = time.perf_counter() - begin
    return {
        "benchmark": "many single-mode curves",
        "members": members,
        "harmonics": 5,
        "points": int(batch.n_points.sum()),
        "failed": int(np.sum(batch.status != int(sj.simulate.CurveStatus.UPPER_END))),
        "seconds": round(seconds, 2),
        "ms_per_curve": round(1e3 * seconds / members, 3),
        "memory_MiB": round(peak_memory()),
        "memory_above_models_MiB": round(peak_memory() - before),
    }


def draw(rows: list[dict], out: Path) -> None:
    """Cost and memory against the number of unknowns."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 2, figsize=(9, 3.6), layout="constrained")
    for n_modes in MODES:
        mine = [row for row in rows if row["modes"] == n_modes]
        size = [row["unknowns"] for row in mine]
        label = "1 mode" if n_modes == 1 else f"{n_modes} modes"
        axes[0].loglog(size, [row["ms_per_point"] for row in mine], "o-", ms=4, label=label)
        axes[1].semilogx(size, [row["memory_above_start_MiB"] for row in mine], "o-", ms=4)
    axes[0].set(xlabel="unknowns", ylabel="time of a point (ms)")
    axes[1].set(xlabel="unknowns", ylabel="memory above the start (MiB)")
    axes[0].legend(frameon=False)
    figure.savefig(out / "simulator_cost.png", dpi=130)


def main() -> None:
    """All sizes, each in a process of its own; then the batch."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path)
    parser.add_argument("--members", type=int, default=10_000)
    parser.add_argument("--size", type=int, nargs=2, metavar=("HARMONICS", "MODES"))
    parser.add_argument("--batch-only", action="store_true")
    options = parser.parse_args()
    if options.size:
        print(json.dumps(one_size(*options.size)))
        return
    if options.batch_only:
        print(json.dumps(many_curves(options.members)))
        return
    rows = []
    for n_modes in MODES:
        for harmonics in HARMONICS:
            command = [sys.executable, __file__, "--size", str(harmonics), str(n_modes)]
            found = subprocess.run(command, capture_output=True, text=True, check=True)
            rows.append(json.loads(found.stdout.splitlines()[-1]))
            print(json.dumps(rows[-1]), flush=True)
    command = [sys.executable, __file__, "--batch-only", "--members", str(options.members)]
    print(subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip())
    if options.out:
        options.out.mkdir(parents=True, exist_ok=True)
        draw(rows, options.out)


if __name__ == "__main__":
    main()
