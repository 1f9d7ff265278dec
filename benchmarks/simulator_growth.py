"""Time a point and memory of forced responses as the problem grows: modes, harmonics, members.

Run: OMP_NUM_THREADS=1 taskset -c 0 python benchmarks/simulator_growth.py

Modes: a generated structure whose first mode stiffens and drives every other one by one monomial
(q₁³q_k), with three harmonics. Harmonics: the flat beam (four modes, 55 monomials). Members: a
batch of curved beams with stability, curves not kept; then a thousand flat beams, each with
frequencies, damping and force of its own, as in a study. Seconds are the median of warm runs;
`lu_fraction` is what as many LU factorisations (LAPACK) take of the time without stability,
`stability` the time with it over the time without. Memory is the largest of the process during a
warm run, all programs of earlier lines included, and how much that is above what it held before.
"""

import gc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import numpy as np
from harness import medians, options, seconds_of, teller
from scipy.linalg.lapack import dgetrf

import snrmjax as sj

tell = teller(__file__)

HERTZ = 2 * np.pi
RANGE, CURVED_RANGE = (60.0 * HERTZ, 120.0 * HERTZ), (25.0 * HERTZ, 140.0 * HERTZ)
FLAT_FORCE, CURVED_FORCE = 1.334e-2, 1.779e-3  # N
STABLE_MODES = 50  # of a hundred, stability takes many minutes
SLOW_SECONDS, SOME = 5.0, 20  # from here on one warm run is enough; factorisations timed


def generated(n_modes: int) -> sj.model.Structure:
    """As many modes, evenly spaced from 79 Hz; as many monomials as modes."""
    order = np.arange(n_modes)
    frequency, shape = HERTZ * 79.0 * (1 + 1.7 * order), 10.0 * (-1.0) ** order
    damping, driven = np.full(n_modes, 0.02), 20.0 * shape / (1 + order)
    modes = sj.model.linear_modes(frequency, damping, [shape], driven)
    terms = {(0, 0, 0, k): 2e13 / (1 + k) for k in range(n_modes)}
    potential = sj.model.polynomial_potential(terms, n_modes)
    return sj.model.structure(modes, potential, name="generated structure")


def held(what: str) -> float:
    """Megabytes of this process."""
    rows = Path("/proc/self/status").read_text(encoding="utf-8").splitlines()
    return next(float(row.split()[1]) for row in rows if row.startswith(what)) / 1024


def measured(function: Callable[[], Any]) -> tuple[float, Any, dict[str, float]]:
    """Seconds of a warm run, what it gave, its memory."""
    gc.collect()
    before = held("VmRSS")
    Path("/proc/self/clear_refs").write_text("5", encoding="utf-8")  # the maximum begins anew
    seconds, result = seconds_of(function)
    memory = {"peak_megabytes": held("VmHWM"), "added_megabytes": held("VmHWM") - before}
    if seconds < SLOW_SECONDS:
        seconds = medians(3, run=function)["run"]
    return seconds, result, memory


def one_curve(measurement: str, model: sj.model.Structure, force: float, harmonics: int) -> None:
    """A curve alone."""

    def respond(stability: bool) -> list[sj.simulate.ResponseCurve]:
        asked = {"harmonic_order": harmonics, "stability": stability}
        return sj.forced_response(model, [force], *RANGE, **asked)

    first, curves = seconds_of(lambda: respond(False))
    alone, _, memory = measured(lambda: respond(False))
    whole = np.nan
    if model.n_modes <= STABLE_MODES:
        respond(True)  # compiles
        whole, _, memory = measured(lambda: respond(True))
    points, solves = sum(len(c.frequency) for c in curves), sum(int(c.n_solves) for c in curves)
    unknowns = (2 * harmonics + 1) * model.n_modes + 1
    matrix = np.asfortranarray(np.random.default_rng(0).normal(size=(unknowns, unknowns)))
    lu = medians(3, some=lambda: [dgetrf(matrix) for _ in range(SOME)])
    tell(
        measurement=measurement,
        model=model.name,
        n_modes=model.n_modes,
        harmonics=harmonics,
        unknowns=unknowns,
        points=points,
        n_solves=solves,
        status=[c.status.name for c in curves],
        compile_seconds=first - alone,
        milliseconds_a_point=1e3 * alone / points,
        stability=whole / alone,
        lu_fraction=lu["some"] * solves / SOME / alone,
        **memory,
    )


def batch(measurement: str, models: list, forces: np.ndarray, ends: tuple) -> None:
    """Many members with stability; curves are not kept."""
    respond = sj.simulate.forced_response_batch
    respond(models[:300], forces[:300], *ends)  # compiles
    seconds, found, memory = measured(lambda: respond(models, forces, *ends, keep_curves=False))
    points = int(np.sum(found.n_points))
    tell(
        measurement=measurement,
        model=models[0].name,
        members=len(forces),
        points=points,
        failed=int(np.sum(found.status > sj.simulate.CurveStatus.LOWER_END)),
        milliseconds_a_curve=1e3 * seconds / len(forces),
        milliseconds_a_point=1e3 * seconds / points,
        **memory,
    )


def varied(model: sj.model.Structure, count: int) -> list[sj.model.Structure]:
    """Models with frequencies and damping of their own, two and ten per cent apart."""

    def parts(m: sj.model.Structure) -> list:
        return [m.modes.natural_frequency, m.modes.damping_ratio]

    draws = 1 + np.random.default_rng(0).normal(size=(count, 2)) * [0.02, 0.1]
    values = [np.asarray(value) for value in parts(model)]
    return [eqx.tree_at(parts, model, [values[0] * a, values[1] * b]) for a, b in draws]


def main() -> None:
    """Measure and print."""
    asked = options(
        __doc__,
        modes=[2, 4, 10, 20, 50, 100],
        harmonics=[1, 3, 7, 15, 31],
        members=[1, 10, 100, 1000, 10000],
        flat=1000,
    )
    tell(measurement="device", device=jax.devices()[0].device_kind)
    curved, flat = sj.model.curved_beam(), sj.model.flat_beam()
    for count in asked.modes:
        one_curve("modes", generated(count), 3e-3, 3)
    for count in asked.harmonics:
        one_curve("harmonics", flat, FLAT_FORCE, count)
    for count in asked.members:
        forces = np.geomspace(0.1, 1.0, count + 1)[1:] * CURVED_FORCE
        batch("members", [curved] * count, forces, CURVED_RANGE)
    forces = np.random.default_rng(1).uniform(0.3, 1.0, asked.flat) * FLAT_FORCE
    batch("study", varied(flat, asked.flat), forces, RANGE)


if __name__ == "__main__":
    main()
