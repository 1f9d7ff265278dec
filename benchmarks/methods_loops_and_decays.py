"""Loops, decays and multisines on structures of `methods_table.py`: errors and coverage.

Run: python benchmarks/methods_loops_and_decays.py [--seeds 20] [--structure NAME …]
[--noise low|middle|high …]

Every test runs in the virtual laboratory on a shaker that gives about 1 N a volt (little feedback
on the force; of the two beams, whose forces are small, still less): a phase-locked loop at six
voltages up to the largest force of `methods_table.py` (`pll`); a free decay from the resonance of
that force (`resonant_decay`, `restoring_force`, `ssm`); and five periods of 2 s of a multisine
around the mode whose rms is half of it (`pnlss`). Noise: each sample of force and velocity is off
by 0.1, 0.5 or 2 % of the channel's largest value. The truth is that of `methods_table.py`, and
errors count at amplitudes that it covers.

One JSON line a structure and method, as in `methods_table.py`, with the seconds of test.
"""

import argparse
import itertools
import json
from typing import NamedTuple

import numpy as np
from methods_table import HERTZ, STRUCTURES, true_mode, truth
from scipy.interpolate import CubicSpline

import snrmjax as sj
from snrmjax.measure import Channel, time_recording
from snrmjax.methods.record_comparison import run_record_method
from snrmjax.methods.records.recorded_test import recorded_test

NOISE = {"low": 0.001, "middle": 0.005, "high": 0.02}
PERIOD = 2.0  # s, of the multisine


class Bench(NamedTuple):
    """What a structure is tested with."""

    coil: float = 0.1  # ohm, and N/A: the feedback on the force is this much N s/m
    rate: float = 2000.0
    lines: tuple[int, int] = (60, 160)  # of the multisine, in halves of a hertz


BENCHES = dict.fromkeys(STRUCTURES, Bench()) | {
    "flat": Bench(1e-4, 10000.0, (100, 280)),
    "curved": Bench(1e-5, 2000.0, (80, 200)),
}


def recording(record, rate, *, forced):
    """A record of the laboratory as the methods read it."""
    channels = [Channel("tip", "velocity")]
    values = [np.asarray(record.velocity)]
    if forced:
        channels.append(Channel("force", "force"))
        values.append(np.asarray(record.force))
    return time_recording(np.stack(values), channels, rate, name="test")


def tests(bench, noise, model, forces, velocity, seed):
    """Results of every method for one seed."""
    largest = float(forces[-1])
    instruments = sj.methods.Instruments(
        force_noise=noise * largest, velocity_noise=noise * velocity
    )
    shaker = sj.methods.Shaker(bench.coil, bench.coil)
    reach = float(3 * velocity / model.modes.natural_frequency[0])  # of friction's tables, m
    laboratory = sj.methods.Laboratory(
        model, shaker, instruments, bench.rate, largest_displacement=reach
    )
    voltages = np.geomspace(forces[0], largest, 6)
    yield "pll", lambda: sj.methods.phase_locked_loop(laboratory, voltages, seed=seed)
    decay = sj.methods.decay_test(laboratory, largest, 3.0, seed=seed)
    played = sj.methods.multisine_test(
        laboratory, largest / 2, np.arange(*bench.lines), int(PERIOD * bench.rate), 5, seed=seed
    )
    free = recording(decay.record, bench.rate, forced=False)
    broad = recording(played.record, bench.rate, forced=True)
    for name in ("resonant_decay", "restoring_force", "ssm", "pnlss"):
        own = broad if name == "pnlss" else free

        def run(name=name, own=own):
            found = run_record_method(name, [recorded_test(own, model.modes)], model.modes)
            if found.result is None:
                raise ValueError(found.reason)
            return found.result

        yield name, run


def main() -> None:
    """Print a line for every structure and method."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--structure", choices=list(STRUCTURES), nargs="*")
    parser.add_argument("--noise", choices=list(NOISE), nargs="*", default=["middle"])
    given = parser.parse_args()
    for name, noise in itertools.product(given.structure or STRUCTURES, given.noise):
        make, forces, *ends = STRUCTURES[name]
        model = make()
        exact = true_mode if name == "two_modes" else truth
        true = exact(model, forces, *(HERTZ * end for end in ends))
        laws = [CubicSpline(true[0] ** 2, values) for values in (true[1] ** 2, true[2])]
        found: dict[str, list] = {}
        nothing: dict[str, int] = {}
        seconds: dict[str, float] = {}
        for seed in range(given.seeds):
            for method, run in tests(BENCHES[name], NOISE[noise], model, forces, true[0, -1], seed):
                rows = found.setdefault(method, [])
                nothing.setdefault(method, 0)
                try:
                    one = run()
                except ValueError:  # counted as a failure of the method
                    nothing[method] += 1
                    continue
                at = np.asarray(one.velocity)
                seconds[method] = float(one.test_seconds)
                good = one.found & (at >= true[0, 0]) & (at <= true[0, -1])
                nothing[method] += not good.any()
                omega, ratio = np.sqrt(laws[0](at[good] ** 2)), laws[1](at[good] ** 2)
                off = np.asarray(one.natural_frequency)[good] - omega
                away = np.asarray(one.damping_ratio)[good] - ratio
                rows += list(
                    zip(
                        *(off / omega, away / ratio),
                        off / np.asarray(one.natural_frequency_std)[good],
                        away / np.asarray(one.damping_ratio_std)[good],
                        strict=True,
                    )
                )
        for method, rows in found.items():
            line = {"benchmark": "methods_table", "structure": name, "noise": noise}
            line |= {"method": method, "nothing_found": nothing[method] / given.seeds}
            line["test_seconds"] = seconds.get(method)
            if rows:
                each = np.abs(np.array(rows))
                for k, quantity in enumerate(("frequency", "damping")):
                    line[f"{quantity}_error_median"] = float(np.median(each[:, k]))
                    line[f"{quantity}_error_90"] = float(np.percentile(each[:, k], 90))
                    score = each[np.isfinite(each[:, k + 2]), k + 2]
                    line[f"{quantity}_coverage"] = (
                        float(np.mean(score <= 1.96)) if score.size else None
                    )
                line["points_a_test"] = len(rows) / given.seeds
            print(json.dumps(line), flush=True)


if __name__ == "__main__":
    main()
