"""Do the 95 % bands of a joint fit contain the truth in 95 of 100 tests?

Run: python benchmarks/joint_fit_coverage.py [--tests 500] [--beam flat|curved] [--seed 0]
     [--pointwise]

Exact steady states of each beam (harmonic balance, 15 harmonics; flat beam: a stepped sine, stable
states within 60° of resonance; curved beam: a phase-locked loop, within 1.2°) get the errors of a
careful test: 1 % of amplitude, 0.7° of phase and 0.3 % of force at random, 1 % of gain for a whole
level. Every test is fitted jointly with smooth curves, and the bands are compared
with the truth: natural frequency and damping at 25 amplitudes between the lowest and the highest
level, resonance and fold at a force between two levels. The truth comes from the phase-locked
backbone and the response curve by harmonic balance, which do not use the fit. Then the same with
the gain error of levels left out of the model, unless `--level-known`. One JSON line each.
"""

import argparse
import json
import os
import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from typing import NamedTuple

import numpy as np

import snrmjax as sj

HERTZ = 2 * np.pi
ERRORS = {"amplitude": 0.01, "phase": np.radians(0.7), "force": 0.003, "gain": 0.01}
HARMONICS = 15
FAMILY: dict[str, str] = {}


class Case(NamedTuple):
    """A beam, the forces of its test and the force whose response is predicted."""

    model: sj.model.Structure
    forces: tuple[float, ...]  # N
    from_hz: float
    to_hz: float
    predicted: float  # N
    phases: tuple[float, ...]  # of a phase-locked loop, degrees; none: a stepped sine
    points_per_level: int = 12


CASES = {
    "flat": Case(
        sj.model.flat_beam(), (2.669e-3, 4.448e-3, 8.896e-3, 1.334e-2), 60, 120, 1.1e-2, ()
    ),
    # Far into softening and stiffening the method needs states near resonance: harmonics are large.
    # Around the lowest frequency a stepped sine jumps, in force as in frequency, and velocity has a
    # maximum: only a phase-locked loop reaches it. Levels lie closer, as the curve is steep.
    "curved": Case(
        sj.model.curved_beam("monostable"),
        tuple(
            np.concatenate(
                [
                    np.geomspace(3e-5, 1.7e-4, 6),
                    np.linspace(1.85e-4, 2.2e-4, 8),
                    np.geomspace(2.6e-4, 7e-4, 4),
                ]
            ).tolist()
        ),
        *(20, 140, 3.8e-4),
        tuple(np.linspace(-1.2, 1.2, 6).tolist()),
    ),
}


class Truth(NamedTuple):
    """Exact states of the test, and what its fit should find."""

    level: np.ndarray
    force: np.ndarray
    frequency: np.ndarray
    velocity: np.ndarray
    at: np.ndarray  # displacements on the backbone, m
    natural_frequency: np.ndarray
    damping: np.ndarray
    resonance: tuple[float, float]  # rad/s, m/s
    fold: float  # rad/s, the upper one


def truth_of(case: Case) -> Truth:
    """Exact states and values."""
    ends = (case.from_hz * HERTZ, case.to_hz * HERTZ)
    if case.phases:
        test = sj.simulate.phase_controlled_test(
            case.model, case.forces, np.radians(case.phases), harmonic_order=HARMONICS
        ).steady_states
    else:
        test = sj.phase_resonance_test(
            case.model, case.forces, *ends, points_per_level=case.points_per_level,
            appropriation=(0.5, 1.0),
            simulation=sj.simulate.SweepSimulation(harmonic_order=HARMONICS),
        ).steady_states  # fmt: skip
    modes = case.model.modes
    constant = float(modes.mode_shape[0, 0] * modes.participation[0])
    fine = sj.simulate.StepControl(largest=0.01, angle=0.02)
    locked = sj.simulate.phase_controlled(
        case.model, 1.05 * case.forces[-1], harmonic_order=HARMONICS, steps=fine
    )
    # The nonlinear mode is what the sensor sees beside the other modes' linear response.
    others = sj.model.residual_velocity(modes, locked.frequency, locked.force)
    speed = np.abs(np.asarray(locked.velocity)[:, 1, 0] - np.asarray(others)[:, 0])
    damping = constant * np.asarray(locked.force) / speed
    # By displacement: a softening backbone can have a velocity more than once.
    own = np.abs(np.asarray(test.velocity)[:, 0]) / np.asarray(test.frequency)
    peak = [own[np.asarray(test.level) == k].max() for k in np.unique(np.asarray(test.level))]
    at = np.linspace(min(peak), max(peak), 25)
    displacement = speed / np.asarray(locked.frequency)
    response = sj.forced_response(
        case.model, [case.predicted], *ends, harmonic_order=HARMONICS, stability=False
    )[0]
    tip = response.at_events("phase_resonance")
    tip = tip[np.argmax(np.abs(response.velocity[tip, 1, 0]))]
    folds = response.at_events("fold")
    fold = response.frequency[folds[np.argmax(np.abs(response.velocity[folds, 1, 0]))]]
    return Truth(
        level=np.asarray(test.level),
        force=np.asarray(test.force),
        frequency=np.asarray(test.frequency),
        velocity=np.asarray(test.velocity)[:, 0],
        at=at,
        natural_frequency=np.interp(at, displacement, np.asarray(locked.frequency)),
        damping=np.interp(at, displacement, damping),
        resonance=(float(response.frequency[tip]), float(np.abs(response.velocity[tip, 1, 0]))),
        fold=float(fold),
    )


def recorded(
    case: Case, truth: Truth, force: np.ndarray, velocity: np.ndarray, errors: dict[str, float]
) -> sj.measure.SteadyStates:
    """States with their errors, whose random part is stated."""
    return sj.measure.steady_states(
        truth.level,
        truth.frequency,
        force,
        velocity,
        sensors=case.model.modes.sensors,
        velocity_std=errors["amplitude"] * np.abs(velocity),
        phase_std=np.full((len(force), 1), errors["phase"]),
        force_std=errors["force"] * force,
    )


def erring(case: Case, truth: Truth, seed: int) -> sj.measure.SteadyStates:
    """The states of one test, with their errors."""
    rng = np.random.default_rng(seed)
    n, levels = len(truth.level), np.unique(truth.level, return_inverse=True)[1]
    gain = ERRORS["gain"] * rng.normal(size=levels.max() + 1)[levels]
    own = ERRORS["amplitude"] * rng.normal(size=n) + 1j * ERRORS["phase"] * rng.normal(size=n)
    velocity = truth.velocity * np.exp(gain + own)
    force = truth.force * np.exp(ERRORS["force"] * rng.normal(size=n))
    return recorded(case, truth, force, velocity, ERRORS)


def one_test(case: Case, truth: Truth, seed: int, *, level_known: bool) -> dict:
    """Errors in units of the stated 1σ."""
    fit = sj.fit_jointly(
        erring(case, truth, seed),
        case.model.modes,
        level_gain_std=ERRORS["gain"] if level_known else 1e-9,
        **FAMILY,
    )
    values = sj.identify.fitted_values(fit, displacement=truth.at)
    frequency = (values.natural_frequency - truth.natural_frequency) / values.natural_frequency_std
    damping = (values.modal_damping - truth.damping) / values.modal_damping_std
    row = {
        "frequency": np.asarray(frequency).tolist(),
        "damping": np.asarray(damping).tolist(),
        "frequency_band": float(np.mean(values.natural_frequency_std / values.natural_frequency)),
        "damping_band": float(np.mean(values.modal_damping_std / values.modal_damping)),
        "noise": fit.noise.scale,
        "families": [
            fit.unknowns.squared_frequency.label,
            fit.unknowns.modal_damping.label,
        ],
        "notes": [str(note) for note in fit.notes],
    }
    curves = sj.identify.fitted_response(fit, case.predicted)
    tips = sorted((p for c in curves for p in c.resonances), key=lambda p: -p.velocity)
    if tips:
        row["resonance_frequency"] = (tips[0].frequency - truth.resonance[0]) / tips[
            0
        ].frequency_std
        row["resonance_velocity"] = (tips[0].velocity - truth.resonance[1]) / tips[0].velocity_std
    folds = [p for curve in curves for p in curve.folds]
    if folds:
        best = max(folds, key=lambda p: p.velocity)
        row["fold"] = (best.frequency - truth.fold) / best.frequency_std
    return row


def one_pointwise_test(case: Case, truth: Truth, seed: int, *, level_known: bool) -> dict:
    """The same of points and curves through them."""
    modes, stated = case.model.modes, ERRORS["gain"] if level_known else 0.0
    known = sj.model.structure(modes, level_gain_std=stated)
    found = sj.identify_backbone(erring(case, truth, seed), known)
    values = found.backbone.values(truth.at)
    frequency = (values.natural_frequency - truth.natural_frequency) / values.natural_frequency_std
    damping = (values.modal_damping - truth.damping) / values.modal_damping_std
    return {
        "frequency": np.asarray(frequency).tolist(),
        "damping": np.asarray(damping).tolist(),
        "frequency_band": float(np.mean(values.natural_frequency_std / values.natural_frequency)),
        "damping_band": float(np.mean(values.modal_damping_std / values.modal_damping)),
        "noise": found.fit.noise.scale,
        "families": ["points"],
        "notes": [str(note) for note in found.notes],
    }


_STATE: dict = {}


def _work(job: tuple[str, int, bool, bool]) -> dict:
    beam, seed, level_known, by_points = job
    if beam not in _STATE:
        _STATE[beam] = truth_of(CASES[beam])
    verb = one_pointwise_test if by_points else one_test
    return verb(CASES[beam], _STATE[beam], seed, level_known=level_known)


def report(beam: str, rows: list[dict], level_known: bool, seconds: float) -> None:
    """One line: shares within 1.96σ, pointwise means and extremes."""
    line = {
        "benchmark": "joint_fit_coverage",
        "beam": beam,
        "tests": len(rows),
        "level_error_in_the_model": level_known,
        "seconds_per_test": round(seconds / len(rows), 3),
    }
    for name in ("frequency", "damping"):
        z = np.array([row[name] for row in rows])
        share = np.mean(np.abs(z) < 1.96, axis=0)
        line[name] = {
            "mean": round(float(share.mean()), 3),
            "lowest": round(float(share.min()), 3),
            "highest": round(float(share.max()), 3),
            "bias": round(float(np.max(np.abs(z.mean(axis=0)))), 2),
        }
        line[f"{name}_band"] = float(f"{np.median([r[f'{name}_band'] for r in rows]):.3g}")
    for name in ("resonance_frequency", "resonance_velocity", "fold"):
        z = np.array([row[name] for row in rows if name in row])
        line[name] = round(float(np.mean(np.abs(z) < 1.96)), 3) if len(z) else None
        line[f"{name}_found"] = len(z)
        line[f"{name}_bias"] = round(float(np.mean(z)), 2) if len(z) else None
    line["noise"] = round(float(np.median([row["noise"] for row in rows])), 3)
    names, counts = np.unique([" ".join(row["families"]) for row in rows], return_counts=True)
    line["families"] = {str(names[k]): int(counts[k]) for k in np.argsort(-counts)[:4]}
    line["with_notes"] = sum(bool(row["notes"]) for row in rows)
    print(json.dumps(line), flush=True)


def main() -> None:
    """Both beams, with the level's error in the model and without."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--tests", type=int, default=500)
    parser.add_argument("--beam", choices=CASES, action="append")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=os.cpu_count())
    parser.add_argument("--level-known", action="store_true", help="only with the level's error")
    parser.add_argument("--pointwise", action="store_true", help="points and curves through them")
    parser.add_argument("--fit", default="auto,auto", help="families, as the command takes them")
    chosen = parser.parse_args()
    FAMILY.update(zip(("backbone", "damping"), chosen.fit.split(","), strict=True))
    for beam in chosen.beam or list(CASES):
        for level_known in (True,) if chosen.level_known else (True, False):
            seeds, how = range(chosen.seed, chosen.seed + chosen.tests), chosen.pointwise
            jobs = [(beam, seed, level_known, how) for seed in seeds]
            begin = time.perf_counter()
            if chosen.workers > 1:
                # A fork of a process that has begun with JAX may wait for ever.
                context = get_context("spawn")
                settings = {"initializer": FAMILY.update, "initargs": (FAMILY,)}
                with ProcessPoolExecutor(chosen.workers, context, **settings) as pool:
                    rows = list(pool.map(_work, jobs, chunksize=8))
            else:
                rows = [_work(job) for job in jobs]
            report(beam, rows, level_known, time.perf_counter() - begin)


if __name__ == "__main__":
    main()
