"""Do 95 % bands have their coverage where few levels vary by an unstated amount?

Run: python benchmarks/few_levels.py [--tests 200] [--seed 0]

The flat beam's test of `joint_fit_coverage.py` with 2, 3, 4 and 6 levels and a third of its random
errors. Levels have errors of 3 % in gain and 1° in phase, or none; neither case is stated to the
fit, which estimates the level-to-level variance. Truth as there. One JSON line a case: coverage of
the bands, their mean relative 1σ, how often and how large each level-to-level error was found.
"""

import argparse
import json
from typing import NamedTuple

import numpy as np
from joint_fit_coverage import CASES, ERRORS, Case, Truth, recorded, truth_of

import snrmjax as sj

QUIET = {name: value / 3 for name, value in ERRORS.items()}
SHARED = {"gain": 0.03, "phase": np.radians(1.0)}


class Found(NamedTuple):
    """Errors of one test in 1σ, its bands, and the estimated level-to-level errors."""

    frequency: np.ndarray
    damping: np.ndarray
    bands: tuple[float, float]
    level_std: np.ndarray


def one_test(case: Case, truth: Truth, seed: int, *, differ: bool) -> Found:
    """One noisy test, fitted without stated errors of its levels."""
    rng = np.random.default_rng(seed)
    n, levels = len(truth.level), np.unique(truth.level, return_inverse=True)[1]
    draws = rng.normal(size=(2, levels.max() + 1))
    shared = (SHARED["gain"] * draws[0] + 1j * SHARED["phase"] * draws[1])[levels]
    own = QUIET["amplitude"] * rng.normal(size=n) + 1j * QUIET["phase"] * rng.normal(size=n)
    velocity = truth.velocity * np.exp(own + (shared if differ else 0.0))
    force = truth.force * np.exp(QUIET["force"] * rng.normal(size=n))
    fit = sj.fit_jointly(recorded(case, truth, force, velocity, QUIET), case.model.modes)
    values = sj.identify.fitted_values(fit, displacement=truth.at)
    return Found(
        np.asarray(values.natural_frequency - truth.natural_frequency)
        / np.asarray(values.natural_frequency_std),
        np.asarray(values.modal_damping - truth.damping) / np.asarray(values.modal_damping_std),
        (
            float(np.mean(values.natural_frequency_std / values.natural_frequency)),
            float(np.mean(values.modal_damping_std / values.modal_damping)),
        ),
        fit.noise.level_std,
    )


def main() -> None:
    """Every number of levels, with and without errors that they share."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--tests", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    chosen = parser.parse_args()
    for n_levels in (2, 3, 4, 6):
        # Two levels must have amplitudes in common, or their difference cannot be seen.
        lowest = 6.67e-3 if n_levels == 2 else 2.669e-3
        forces = tuple(np.geomspace(lowest, 1.334e-2, n_levels).tolist())
        case = CASES["flat"]._replace(forces=forces)
        truth = truth_of(case)
        for differ in (True, False):
            rows = [
                one_test(case, truth, chosen.seed + k, differ=differ) for k in range(chosen.tests)
            ]
            line: dict[str, object] = {
                "benchmark": "few_levels",
                "levels": n_levels,
                "differ": differ,
                "tests": len(rows),
            }
            for name in ("frequency", "damping"):
                share = np.mean([np.abs(getattr(row, name)) < 1.96 for row in rows], axis=0)
                line[name] = {
                    "mean": round(float(share.mean()), 3),
                    "lowest": round(float(share.min()), 3),
                    "highest": round(float(share.max()), 3),
                }
            line["bands"] = [float(f"{v:.3g}") for v in np.median([r.bands for r in rows], axis=0)]
            sizes = np.array([row.level_std for row in rows])
            line["found_in"] = np.round(np.mean(sizes > 0, axis=0), 3).tolist()
            line["found_median"] = np.round(np.median(sizes, axis=0), 5).tolist()
            print(json.dumps(line), flush=True)


if __name__ == "__main__":
    main()
