"""Does a calibration of the flat beam find the coefficients that its response depends on?

Run: python benchmarks/calibration.py [--seeds 100] [--points 10] [--start 0.3]

Exact steady states of four levels (harmonic balance, 9 harmonics, stable states within 45° of
resonance) get the errors of a careful test: 1 % of amplitude, 0.7° of phase and 0.3 % of force, at
random. Every seed fits the natural frequency and the damping of the first mode together with the
dominant coefficients of the potential, which start 30 % too large or too small by chance; all
others are known.

The dominant ones of all 55 coefficients are those that a greedy choice by Fisher information at the
truth keeps: in the order of the 1σ that each would have alone, the next is taken if no relative 1σ
of those taken then exceeds 20 % (see `relative_std`). From fundamentals these are 1111 and 1112;
harmonic 3, known to 1 mm/s, determines the second ten times better. A third case gives every level
a gain error of 1 % and makes the gains unknowns. The last case fits 1122 too, which only harmonic 5
determines, through the internal resonance 1:5. A start 30 % off moves this resonance to other
states, and many fits end in another minimum. `contradicted` counts fits whose χ² rejects the model
or the stated noise; shares are of the other fits.

One JSON line a case: how often each parameter, and all together (their ellipsoid), lie within two
standard deviations (95.4 % expected, give or take 2.1 in 100 tests); the scatter of the estimates
over their stated standard deviation; the mean of the reduced χ²; seconds of the first call, with
compilation, and the median of the others.
"""

import argparse
import json
import os
import time
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from scipy.stats import chi2

import snrmjax as sj

HERTZ = 2 * np.pi
AMPLITUDE, PHASE, FORCE, HARMONIC = 0.01, np.radians(0.7), 0.003, 1e-3
LINEAR = ("mode_1.natural_frequency", "mode_1.damping_ratio")


class Case(NamedTuple):
    """What is recorded and what is fitted."""

    harmonics: tuple[int, ...]
    coefficients: tuple[str, ...]
    level_gain: float = 0.0


CASES = {
    "fundamental": Case((), ("1111", "1112")),
    "harmonic 3": Case((3,), ("1111", "1112")),
    "fundamental, gain of levels": Case((), ("1111", "1112"), 0.01),
    "harmonics 3 and 5": Case((3, 5), ("1111", "1112", "1122")),
}


def exact_test(
    beam: sj.model.Structure, points: int, harmonics: tuple[int, ...]
) -> sj.measure.SteadyStates:
    """The states as they are."""
    return sj.phase_resonance_test(
        beam, sj.model.FLAT_BEAM_FORCES, 60 * HERTZ, 120 * HERTZ, appropriation=(0.5, 1.0),
        points_per_level=points,
        recording=sj.simulate.Recording(keep_harmonics=harmonics),
    ).steady_states  # fmt: skip


def measured(
    exact: sj.measure.SteadyStates, case: Case, random: np.random.Generator
) -> sj.measure.SteadyStates:
    """The states as a test would record them."""
    velocity, force = np.asarray(exact.velocity), np.asarray(exact.force)
    level = np.unique(np.asarray(exact.level), return_inverse=True)[1]
    gain = np.exp(case.level_gain * random.normal(size=level.max() + 1))[level, None]
    own = 1 + AMPLITUDE * random.normal(size=velocity.shape)
    factor = gain * own * np.exp(1j * PHASE * random.normal(size=velocity.shape))
    harmonics = np.asarray(exact.harmonics) * factor[..., None]
    parts = random.normal(size=(2, *harmonics.shape)) * HARMONIC / np.sqrt(2)
    recorded = velocity * factor
    kept = {
        "harmonics": harmonics + parts[0] + 1j * parts[1],
        "harmonic_order": case.harmonics,
        "harmonic_std": np.full(velocity.shape, HARMONIC),
    }
    return sj.measure.steady_states(
        *(exact.level, exact.frequency, force * (1 + FORCE * random.normal(size=force.shape))),
        recorded,
        sensors=exact.sensors,
        velocity_std=AMPLITUDE * np.abs(recorded),
        phase_std=np.full(velocity.shape, PHASE),
        force_std=FORCE * force,
        **(kept if case.harmonics else {}),
    )


def run(name: str, case: Case, options: argparse.Namespace) -> dict:
    """All seeds of one case."""
    beam = sj.model.flat_beam()
    names = (*LINEAR, *(f"potential.{key}" for key in case.coefficients))
    known = sj.model.parameter_values(beam)
    truth = np.array([known[name] for name in names])
    exact = exact_test(beam, options.points, case.harmonics)
    values, std, inside, spread, chi, seconds = [], [], [], [], [], []
    off = contradicted = 0
    for seed in range(options.seeds):
        random = np.random.default_rng(seed)
        data = measured(exact, case, random)
        share = options.start * random.choice([-1, 1], size=len(names))
        share[: len(LINEAR)] = 0.0
        start = sj.model.with_parameters(beam, names, jnp.asarray(truth * (1 + share)))
        before = time.perf_counter()
        found = sj.calibrate_model(start, data, names, level_gain_std=case.level_gain)
        seconds.append(time.perf_counter() - before)
        off += not found.converged or not found.state_converged.all()
        if any("it is understated or" in note for note in found.notes):
            contradicted += 1
            continue
        miss = found.values - truth
        values.append(found.values / truth - 1)
        std.append(found.std / np.abs(truth))
        inside.append(np.abs(miss) < 2 * found.std)
        distance = miss @ np.linalg.solve(found.covariance, miss)
        spread.append(distance < chi2.ppf(0.9545, len(names)))
        chi.append(found.reduced_chi_square)
    if not values:
        return {"case": name, "states": exact.n_states, "contradicted": contradicted}
    deviation = np.sqrt(np.mean(np.square(values), axis=0))

    def by_name(numbers: np.ndarray) -> dict:
        return {key: round(float(number), 4) for key, number in zip(names, numbers, strict=True)}

    return {
        "case": name,
        "states": exact.n_states,
        "seeds": options.seeds,
        "cores": len(os.sched_getaffinity(0)),
        "within_two_std": by_name(np.mean(inside, axis=0)),
        "together_within_two_std": float(np.mean(spread)),
        "relative_std": by_name(np.mean(std, axis=0)),
        "scatter_over_std": by_name(deviation / np.mean(std, axis=0)),
        "mean_error_over_std": by_name(np.mean(values, axis=0) / np.mean(std, axis=0)),
        "reduced_chi_square": round(float(np.mean(chi)), 4),
        "not_converged": off,
        "contradicted": contradicted,
        "first_s": round(seconds[0], 2),
        "median_s": round(float(np.median(seconds[1:])), 3),
        "longest_s": round(max(seconds[1:]), 3),
    }


def main() -> None:
    """Run the cases."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--seeds", type=int, default=100)
    parser.add_argument("--points", type=int, default=10, help="states of a level")
    parser.add_argument("--start", type=float, default=0.3, help="relative error of the start")
    options = parser.parse_args()
    for name, case in CASES.items():
        print(json.dumps(run(name, case, options)), flush=True)


if __name__ == "__main__":
    main()
