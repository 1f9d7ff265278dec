"""Batches on this machine's accelerator beside its own CPU: seconds, and how far results are apart.

Run: python benchmarks/accelerator.py

Every platform of `--platforms` works in a process of its own, on all it has: the CPU's cores, or
one accelerator. Three kinds of work: forced responses of curved beams with a force of their own
each (stability and events included, curves not kept), measured states inverted point by point, and
the derivatives of ω̃ and ζ̃ by what was measured. Seconds are the median of warm runs, or the only
warm run where it takes long; `first_seconds` compiles too. `apart` is the largest relative
distance from the first platform's results, of the largest velocity of a response,
of ω̃ and ζ̃, or of the derivatives.
"""

import functools
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from harness import medians, options, seconds_of, teller

HERTZ = 2 * np.pi
RANGE, FORCE = (25.0 * HERTZ, 140.0 * HERTZ), 1.779e-3  # rad/s, N
SLOW_SECONDS = 20.0  # from here on one warm run is enough
PLATFORM, ASKED = "SNRMJAX_BENCHMARK_PLATFORM", "SNRMJAX_BENCHMARK_ASKED"


def timed(run: Callable[[], Any]) -> tuple[dict[str, float], Any]:
    """Seconds of the first run and of warm ones, and what they give."""
    first, _ = seconds_of(run)
    warm, result = seconds_of(run)
    if warm < SLOW_SECONDS:
        warm = medians(3, run=run)["run"]
    return {"first_seconds": first, "seconds": warm}, result


def responses(members: int) -> tuple[dict[str, Any], np.ndarray]:
    """Forced responses of so many curved beams."""
    import jax

    import snrmjax as sj

    models = [sj.model.curved_beam()] * members
    forces = np.geomspace(0.1, 1.0, members + 1)[1:] * FORCE
    # An accelerator wants more at once than fits a CPU's cache.
    chunk = 256 if jax.default_backend() == "cpu" else 4096
    respond = functools.partial(
        sj.simulate.forced_response_batch, models, forces, *RANGE, keep_curves=False, chunk=chunk
    )
    spent, found = timed(respond)
    failed = int(np.sum(found.status > sj.simulate.CurveStatus.LOWER_END))
    return {**spent, "points": int(np.sum(found.n_points)), "failed": failed}, found.peak_velocity


def measured(states: int) -> tuple[np.ndarray, ...]:
    """Modal constants, frequencies and velocities of states whose ω̃ is 500 rad/s and ζ̃ 1 %."""
    draw = np.random.default_rng(0)
    omega, constant = 500.0 * (1 + 0.01 * draw.normal(size=states)), draw.uniform(1, 9, states)
    mode = 1j * omega * constant / (500.0**2 - omega**2 + 2j * 0.01 * 500.0 * omega)
    beside = 0.01j * constant / omega
    noise = 1e-3 * (draw.normal(size=states) + 1j * draw.normal(size=states))
    return constant, omega, (mode + beside) * (1 + noise), beside


def points(states: int) -> tuple[dict[str, Any], np.ndarray]:
    """So many states inverted."""
    import jax

    import snrmjax as sj

    given = [jax.device_put(part) for part in measured(states)]
    spent, found = timed(lambda: jax.block_until_ready(sj.identify.invert_phasor(*given)))
    return spent, np.concatenate([found.natural_frequency, found.damping_ratio])


def derivatives(states: int) -> tuple[dict[str, Any], np.ndarray]:
    """Of the sums of all ω̃ and of all ζ̃ by every force and frequency, in reverse mode."""
    import jax

    import snrmjax as sj

    constant, omega, velocity, beside = (jax.device_put(part) for part in measured(states))

    @jax.jit
    def slopes(constant: jax.Array, omega: jax.Array) -> jax.Array:
        def both(constant: jax.Array, omega: jax.Array) -> tuple[jax.Array, jax.Array]:
            found = sj.identify.invert_phasor(constant, omega, velocity, beside)
            return found.natural_frequency.sum() / 500.0, found.damping_ratio.sum() / 0.01

        _, pulled = jax.vjp(both, constant, omega)
        units = [(1.0, 0.0), (0.0, 1.0)]
        parts = [pulled(tuple(map(jax.numpy.asarray, unit))) for unit in units]
        return jax.numpy.stack([part for pair in parts for part in pair])

    spent, found = timed(lambda: jax.block_until_ready(slopes(constant, omega)))
    return spent, np.asarray(found) * np.array([constant, omega] * 2)  # relative


WORK: dict[str, Callable[[int], tuple[dict[str, Any], np.ndarray]]] = {
    "responses": responses,
    "points": points,
    "derivatives": derivatives,
}


def work(platform: str, asked: dict[str, list[int]], folder: Path) -> None:
    """All that is asked, on one platform: lines to the standard output, results to a folder."""
    import jax

    device = {"platform": platform, "device": jax.devices()[0].device_kind}
    if platform == "cpu":
        device["device"] = f"{len(os.sched_getaffinity(0))} cores"
    for kind, counts in asked.items():
        for count in counts:
            line, result = WORK[kind](count)
            np.save(folder / f"{platform}-{kind}-{count}.npy", result)
            print(json.dumps({"work": kind, "count": count, **device, **line}), flush=True)


def main() -> None:
    """Measure every platform in turn and print."""
    asked = options(
        __doc__,
        platforms=["cpu", "cuda"],
        responses=[100, 1000, 10000],
        points=[1000, 100_000, 1_000_000],
        derivatives=[100_000],
    )
    tell = teller(__file__)
    counts = {kind: getattr(asked, kind) for kind in WORK}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for platform in asked.platforms:
            more = {"JAX_PLATFORMS": platform, PLATFORM: platform, ASKED: json.dumps(counts)}
            command = [sys.executable, __file__, name]
            process = subprocess.Popen(
                command, env=os.environ | more, stdout=subprocess.PIPE, text=True
            )
            assert process.stdout is not None
            for row in process.stdout:
                line = json.loads(row)
                of = f"{line['work']}-{line['count']}.npy"
                one, first = (np.load(folder / f"{p}-{of}") for p in (platform, asked.platforms[0]))
                both = np.isfinite(one) & np.isfinite(first)
                size = np.abs(first[both]).max(initial=1e-300)
                line["apart"] = float(np.max(np.abs(one - first)[both], initial=0.0) / size)
                line["answered_alike"] = bool(np.array_equal(np.isfinite(one), np.isfinite(first)))
                tell(**line)
            if process.wait():
                raise SystemExit(f"{platform} ended with {process.returncode}.")


if __name__ == "__main__":
    if PLATFORM in os.environ:
        work(os.environ[PLATFORM], json.loads(os.environ[ASKED]), Path(sys.argv[1]))
    else:
        main()
