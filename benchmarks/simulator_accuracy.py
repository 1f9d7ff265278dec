"""How accurate simulated responses are: against time integration and another harmonic balance.

Run: python benchmarks/simulator_accuracy.py [--points N] [--stability N]

The reference is that of the tests (tests/truths/periodic_motions.py): the equations of motion
written again in NumPy, integrated by SciPy's Dormand-Prince method of order 8 with rtol 1e-12, and
a harmonic balance by sampling whose folds and peaks are found by brentq. Seven curves: the flat
beam at four forces (60-120 Hz), the monostable curved beam at three (20-150 Hz).

events: the largest relative error in the frequency of all folds, peaks and phase resonances, and
how many were lost, for largest steps from 0.003 to 0.3.
stability: whether stable and unstable points are told apart as the multipliers of the map over one
period do (slopes by differences), on N points of either kind.
closure: how far the motion of a point is from its start after one period, over its size, for
points all along each curve and 9 to 63 harmonics. An unstable motion grows in this period, so its
distance is divided by its largest multiplier. One JSON line each.
"""

import sys
import time
from pathlib import Path

import numpy as np

import snrmjax as sj

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from harness import options, teller
from truths.periodic_motions import NumpyBalance, TimeDomain, initial_state, spectrum_distance

tell = teller(__file__)

HERTZ = 2 * np.pi
KINDS = ("fold", "peak", "phase_resonance")
CURVES = {
    "flat": (sj.model.flat_beam(), sj.model.FLAT_BEAM_FORCES, (60 * HERTZ, 120 * HERTZ)),
    "curved": (
        sj.model.curved_beam("monostable"),
        sj.model.CURVED_BEAM_FORCES,
        (20 * HERTZ, 150 * HERTZ),
    ),
}
BAR = 1e-7  # of the closure


def responses(beam: str, **settings: object) -> list[sj.simulate.ResponseCurve]:
    """The curves of one beam at the paper's forces."""
    model, forces, ends = CURVES[beam]
    return sj.forced_response(model, forces, *ends, **settings)


def closure(n_points: int) -> None:
    """Motions against one period of time integration, by number of harmonics."""
    for beam, (model, _, _) in CURVES.items():
        for order in (9, 15, 31, 45, 63):
            for curve in responses(beam, harmonic_order=order):
                rows = np.linspace(0, len(curve.frequency) - 1, n_points).round().astype(int)
                rows = [k for k in rows if curve.event[k] != "fold"]
                misses = []
                for k in rows:
                    truth = TimeDomain(model, curve.force, curve.frequency[k])
                    state = initial_state(curve.coefficients[k], curve.frequency[k])
                    growth = max(np.abs(curve.multipliers[k]).max(), 1.0)
                    misses.append(truth.closure(state) / growth)
                worst = int(np.argmax(misses))
                tell(
                    measurement="closure",
                    beam=beam,
                    force=curve.force,
                    harmonics=order,
                    points=len(rows),
                    median=float(np.median(misses)),
                    largest=float(misses[worst]),
                    largest_at_hz=float(curve.frequency[rows[worst]] / HERTZ),
                    fraction_below_bar=float(np.mean(np.array(misses) < BAR)),
                )


def events() -> None:
    """Folds, peaks and phase resonances against another balance, by step size."""
    for beam, (model, _, _) in CURVES.items():
        known: dict[float, dict[str, int]] = {}
        for step in (0.003, 0.01, 0.03, 0.05, 0.1, 0.3):
            control = sj.simulate.StepControl(first=step, largest=step, max_points=8000)
            for curve in responses(beam, steps=control, stability=False):
                counts = {kind: int(curve.at_events(kind).size) for kind in KINDS}
                known.setdefault(curve.force, counts)
                scale = float(np.abs(curve.coefficients).max())
                balance = NumpyBalance(model, curve.force, 9, scale)
                errors = {
                    kind: max(
                        abs(
                            balance.event(kind, curve.coefficients[k], curve.frequency[k])[0]
                            / curve.frequency[k]
                            - 1
                        )
                        for k in curve.at_events(kind)
                    )
                    for kind in KINDS
                    if counts[kind]
                }
                lost = sum(known[curve.force][kind] - counts[kind] for kind in KINDS)
                tell(
                    measurement="events",
                    beam=beam,
                    force=curve.force,
                    largest_step=step,
                    points=len(curve.frequency),
                    **counts,
                    lost=lost,
                    **{f"{kind}_error": float(error) for kind, error in errors.items()},
                )


def stability(n_each: int) -> None:
    """Stability against the multipliers of the map over one period."""
    settings = {
        "harmonic_order": 31,
        "steps": sj.simulate.StepControl(largest=0.01, angle=0.02, max_points=8000),
    }
    chosen = []
    for beam, (model, _, _) in CURVES.items():
        for curve in responses(beam, **settings):
            chosen += [(beam, model, curve, k) for k, e in enumerate(curve.event) if not e]
    rng = np.random.default_rng(0)
    for verdict in (True, False):
        rows = [row for row in chosen if bool(row[2].is_stable[row[3]]) is verdict]
        picks = rng.permutation(len(rows))[:n_each]
        wrong, distances, near, begin = [], [], 0, time.perf_counter()
        for row in picks:
            beam, model, curve, k = rows[row]
            truth = TimeDomain(model, curve.force, curve.frequency[k]).multipliers(
                initial_state(curve.coefficients[k], curve.frequency[k])
            )
            largest = float(np.abs(truth).max())
            distances.append(spectrum_distance(curve.multipliers[k], truth) / max(largest, 1.0))
            near += abs(largest - 1) < 1e-2
            if (largest < 1) is not verdict:
                wrong.append([beam, curve.force, float(curve.frequency[k] / HERTZ), largest])
        tell(
            measurement="stability",
            verdict="stable" if verdict else "unstable",
            points=len(picks),
            of=len(rows),
            within_1e_2_of_the_circle=int(near),
            disagreements=len(wrong),
            wrong=wrong,
            median_distance=float(np.median(distances)),
            largest_distance=float(np.max(distances)),
            seconds=time.perf_counter() - begin,
        )


def main() -> None:
    """Measure and print."""
    chosen = options(__doc__, points=24, stability=200)
    events()
    stability(chosen.stability)
    closure(chosen.points)


if __name__ == "__main__":
    main()
