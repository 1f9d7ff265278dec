"""Loops, decays and multisines on structures of `methods_table.py`: errors and coverage.

Run: python benchmarks/methods_loops_and_decays.py [--seeds 20] [--structure NAME …]
[--noise low|middle|high …] [--method NAME …]

Every test runs in the virtual laboratory on a shaker that gives about 1 N a volt (little feedback
on the force; of the two beams, whose forces are small, still less): a phase-locked loop at six
voltages up to the largest force of `methods_table.py` (`pll`); control-based continuation at six
amplitudes between the resonances of the lowest and the largest force (`cbc`: only the fundamental
is fed back, by a filter of a quarter of the mode's frequency, with a gain of 2.5 times the force
over velocity that the linear mode has at resonance); a free decay from the resonance of the largest
force (`resonant_decay`, `restoring_force`, `ssm`); and five periods of 2 s of a multisine around
the mode whose rms is half of it (`pnlss`). Noise: each sample of force and velocity is off
by 0.1, 0.5 or 2 % of the channel's largest value. The truth is that of `methods_table.py`, and
errors count at amplitudes that it covers.

One JSON line a structure and method, as in `methods_table.py`, with the seconds of test.
"""

import itertools
from typing import NamedTuple

import numpy as np
from harness import options, teller
from methods_table import STRUCTURES, line_of, scored, truth_of

import snrmjax as sj
from snrmjax.measure import Channel, time_recording
from snrmjax.methods.comparison import run_record_method
from snrmjax.methods.records.recorded_test import recorded_test

tell = teller(__file__)

NOISE = {"low": 0.001, "middle": 0.005, "high": 0.02}
METHODS = ("pll", "cbc", "resonant_decay", "restoring_force", "ssm", "pnlss")
PERIOD = 2.0  # s, of the multisine
_LEVELS = 6
_GAIN = 2.5  # of the feedback, times force over velocity of the linear resonance


class Bench(NamedTuple):
    """What a structure is tested with."""

    coil: float = 0.1  # ohm, and N/A: the feedback on the force is this much N s/m
    rate: float = 2000.0
    lines: tuple[int, int] = (60, 160)  # of the multisine, in halves of a hertz
    substeps: int = 2
    fast: bool = False  # a loop for heavy damping, from rest at once to the largest force


BENCHES = dict.fromkeys(STRUCTURES, Bench()) | {
    "flat": Bench(1e-5, 10000.0, (100, 280), 4, True),
    "curved": Bench(1e-7, 2000.0, (80, 200), fast=True),
}


def recording(record, rate, *, forced):
    """A record of the laboratory as the methods read it."""
    channels = [Channel("tip", "velocity")]
    values = [np.asarray(record.velocity)]
    if forced:
        channels.append(Channel("force", "force"))
        values.append(np.asarray(record.force))
    return time_recording(np.stack(values), channels, rate, name="test")


def resonances(model, true, forces, count):
    """Velocities between the resonances of the lowest and the largest force, and their forces."""
    modes = model.modes
    per_force = float(modes.mode_shape[0, 0] * modes.participation[0])
    force = 2 * true[2] * true[1] * true[0] / abs(per_force)
    velocity = np.geomspace(*np.interp([forces[0], forces[-1]], force, true[0]), count)
    return velocity, np.interp(velocity, true[0], force)


def continuation(laboratory, velocity, force, seed):
    """Control-based continuation through about these motions."""
    modes = laboratory.structure.modes
    omega, ratio = float(modes.natural_frequency[0]), float(modes.damping_ratio[0])
    per_force = abs(float(modes.mode_shape[0, 0] * modes.participation[0]))
    gain = _GAIN * 2 * ratio * omega / per_force
    settings = sj.simulate.FeedbackSettings(gain, record_cycles=40, filter_rate=omega / 4)
    return sj.methods.control_based_continuation(
        laboratory, velocity + force / gain, settings, seed=seed
    )


def tests(bench, noise, model, forces, true, methods, seed):
    """Results of some methods for one seed."""
    largest, velocity = float(forces[-1]), float(true[0, -1])
    instruments = sj.simulate.Instruments(
        force_noise=noise * largest, velocity_noise=noise * velocity
    )
    shaker = sj.simulate.Shaker(bench.coil, bench.coil)
    reach = float(3 * velocity / model.modes.natural_frequency[0])  # of friction's tables, m
    laboratory = sj.simulate.Laboratory(
        *(model, shaker, instruments, bench.rate, bench.substeps), largest_displacement=reach
    )
    omega = float(model.modes.natural_frequency[0])
    gains = sj.simulate.LoopGains(omega / 4, omega / 20) if bench.fast else None
    voltages = np.geomspace(forces[0], largest, _LEVELS)
    if "pll" in methods:
        yield (
            "pll",
            lambda: sj.methods.phase_locked_loop(laboratory, voltages, gains=gains, seed=seed),
        )
    if "cbc" in methods:
        motions = resonances(model, true, forces, _LEVELS)
        yield "cbc", lambda: continuation(laboratory, *motions, seed)
    recorded = [name for name in ("resonant_decay", "restoring_force", "ssm") if name in methods]
    if recorded:
        decay = sj.simulate.decay_test(laboratory, largest, 3.0, gains=gains, seed=seed)
        free = recording(decay.record, bench.rate, forced=False)
    if "pnlss" in methods:
        recorded.append("pnlss")
        played = sj.simulate.multisine_test(
            laboratory, largest / 2, np.arange(*bench.lines), int(PERIOD * bench.rate), 5, seed=seed
        )
        broad = recording(played.record, bench.rate, forced=True)
    for name in recorded:
        own = broad if name == "pnlss" else free

        def run(name=name, own=own):
            found = run_record_method(name, [recorded_test(own, model.modes)], model.modes)
            if found.result is None:
                raise ValueError(found.reason)
            return found.result

        yield name, run


def main() -> None:
    """Print a line for every structure and method."""
    given = options(__doc__, seeds=20, structure=list(STRUCTURES), noise=["middle"], method=METHODS)
    for name, noise in itertools.product(given.structure, given.noise):
        model, forces, true, laws = truth_of(name)
        found: dict[str, list] = {method: [] for method in given.method}
        nothing, seconds = dict.fromkeys(given.method, 0), dict.fromkeys(given.method, 0.0)
        for seed in range(given.seeds):
            bench = BENCHES[name], NOISE[noise], model, forces, true, given.method
            for method, run in tests(*bench, seed):
                try:
                    one = run()
                except ValueError:  # counted as a failure of the method
                    nothing[method] += 1
                    continue
                rows = scored(one, true, laws)
                nothing[method] += not rows
                seconds[method] = float(one.test_seconds)
                found[method] += rows
        for method, rows in found.items():
            missed = nothing[method] / given.seeds
            about = {"structure": name, "noise": noise, "method": method}
            tell(**about, nothing_found=missed, test_seconds=seconds[method],
                 **line_of(rows, given.seeds))  # fmt: skip


if __name__ == "__main__":
    main()
