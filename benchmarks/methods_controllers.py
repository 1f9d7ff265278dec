"""Loops that hold what an open loop loses: a one-sided stop and a flat beam in the laboratory.

Run: python benchmarks/methods_controllers.py [--structure stop|flat] [--out FOLDER]

Both structures stand on a shaker with back-EMF and a moving armature, with noise on both channels.
Truth is harmonic balance (nine harmonics) of the structure under a sine, which no loop knows:
resonances (`phase_controlled`), and the force at a velocity and a frequency
(`response_controlled`). One JSON line a structure and a test:

- open_loop: stepped sines of one voltage, up and down: frequencies of the jumps, and the share of
  the range in which both answers differ by more than a tenth;
- pll, cbc: backbones with two sets of gains: largest relative errors of frequency and modal
  damping, largest difference between the sets at equal velocities;
- phase_sweep: the whole response at the voltage of the open loop, two sets of gains: errors of
  frequency and force, and how many of its states lie where neither stepped sine has been;
- s_curve: force over velocity at one frequency, two sets of gains: error of the force relative to
  the largest, and how many points lie where the force falls;
- synthesis: whole responses drawn from the loop's backbone (nonlinear mode synthesis) against those
  by harmonic balance: relative errors of peak and of both folds' frequencies, largest distance of
  the stable parts above a tenth of the peak, in velocity over the peak's;
- badly_tuned: statuses of a loop whose gains are wrong.
"""

import argparse
import itertools
import json
import time
from pathlib import Path
from typing import NamedTuple

import matplotlib.pyplot as plt
import numpy as np

import snrmjax as sj
from snrmjax.methods import MethodStatus
from snrmjax.simulate import FeedbackSettings, Instruments, LoopGains, Shaker

HERTZ = 2 * np.pi
PHASES = np.radians([55, 40, 25, 10, 0, -15, -30, -40, -50, -60, -70, -78])
COLOURS = ("#1b6ca8", "#d1495b")


class Case(NamedTuple):
    """A structure in its laboratory and what is asked of it."""

    model: sj.model.Structure
    laboratory: sj.simulate.Laboratory
    largest_force: float  # N, of the true backbone
    voltages: np.ndarray  # V, of the loop
    gains: tuple[LoopGains, LoopGains]
    wild: LoopGains
    settle: int  # cycles
    voltage: float  # V, of open loop and phase sweep
    ends: tuple[float, float]  # Hz, of the open loop
    feedback: tuple[FeedbackSettings, FeedbackSettings]
    targets: np.ndarray  # m/s, of the backbone by continuation
    frequency: float  # Hz, of the S-curve
    amplitudes: np.ndarray  # m/s, of its targets
    forces: tuple[float, ...]  # N, of the responses that are drawn from the backbone


def stop() -> Case:
    """One mode with a stop of twice its stiffness on one side."""
    modes = sj.model.linear_modes([50 * HERTZ], [0.01], [[1.0]], [1.0])
    contact = sj.model.EFFECTS["one_sided_stop"](stiffness=2 * (50 * HERTZ) ** 2, gap=1e-4)
    model = sj.model.structure(modes, effects=[contact])
    shaker = Shaker(300.0, 8.0, mass=0.02, damping=0.2, stiffness=300.0)
    instruments = Instruments(force_noise=1e-3, velocity_noise=1e-4)
    return Case(
        model,
        sj.simulate.Laboratory(model, shaker, instruments, 4000.0, substeps=4),
        1.5,
        np.array([6.0, 10.0, 15.0, 20.0, 25.0, 30.0, 40.0]),
        (LoopGains(120.0, 16.0), LoopGains(160.0, 22.0)),
        LoopGains(2.0, 60.0),
        400,
        30.0,
        (49.0, 63.0),
        (FeedbackSettings(3000.0, filter_rate=200.0), FeedbackSettings(5000.0, settle_cycles=90)),
        np.array([0.04, 0.06, 0.08, 0.1, 0.13]),
        56.0,
        np.linspace(0.01, 0.12, 14),
        (0.3, 0.6),
    )


def flat() -> Case:
    """The flat clamped-clamped beam with its four modes."""
    model = sj.model.flat_beam()
    shaker = Shaker(3.0, 0.005, mass=1e-7, damping=1e-7, stiffness=1e-3)
    instruments = Instruments(force_noise=1e-6, velocity_noise=1e-4, filter_corner_hz=2000.0)
    feedback = FeedbackSettings(40.0, filter_rate=150.0)
    return Case(
        model,
        sj.simulate.Laboratory(model, shaker, instruments, 10000.0, substeps=4),
        1.6e-2,
        np.array([0.5, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0]),
        (LoopGains(100.0, 40.0), LoopGains(200.0, 60.0)),
        LoopGains(5.0, 400.0),
        150,
        8.0,
        (80.0, 106.0),
        (feedback, feedback._replace(gain=60.0, filter_rate=200.0)),
        np.array([0.2, 0.4, 0.6, 0.8]),
        94.0,
        np.linspace(0.05, 0.95, 14),
        (0.006, 0.012),
    )


def backbone(case: Case):
    """Frequency (rad/s) and modal damping (1/s) over velocity at the true resonances."""
    curve = sj.simulate.phase_controlled(case.model, case.largest_force)
    speed = np.abs(curve.velocity[:, 1, 0])
    modes = case.model.modes
    per_force = abs(float(modes.mode_shape[0, 0] * modes.participation[0]))
    return speed, curve.frequency, per_force * curve.force / speed


def between_points(x, y, at):
    """Linear between the points of a curve, which may turn back on itself: the nearest branch."""
    order = np.argsort(x)
    return np.interp(at, x[order], y[order])


def judged(case: Case, results, truth):
    """Errors of two results of one method, and how far they are from each other."""
    errors, laws = [], []
    for one in results:
        good = one.found
        speed, omega = one.velocity[good], one.natural_frequency[good]
        damping = 2 * one.damping_ratio[good] * omega
        errors.append(
            (
                np.abs(omega / between_points(truth[0], truth[1], speed) - 1).max(),
                np.abs(damping / between_points(truth[0], truth[2], speed) - 1).max(),
            )
        )
        laws.append((speed, omega))
    # Compared at equal velocities: the slope of the truth moves the few per mille between them.
    pairs = min(len(law[0]) for law in laws)
    moved = between_points(truth[0], truth[1], laws[1][0][:pairs]) - between_points(
        truth[0], truth[1], laws[0][0][:pairs]
    )
    apart = np.abs(laws[1][1][:pairs] - laws[0][1][:pairs] - moved) / laws[0][1][:pairs]
    return {
        "frequency_error_max": float(np.max(errors, axis=0)[0]),
        "damping_error_max": float(np.max(errors, axis=0)[1]),
        "apart_between_gains_max": float(apart.max()),
        "points": [int(one.found.sum()) for one in results],
        "test_seconds": [one.test_seconds for one in results],
    }


def open_loop(case: Case):
    """Velocities of stepped sines of constant voltage, up and down, by rising frequency."""
    steps = HERTZ * np.linspace(*case.ends, 29)
    found = []
    for way in (steps, steps[::-1]):
        test = sj.simulate.stepped_sine_test(
            case.laboratory, case.voltage, way, settle_cycles=case.settle
        )
        states = sj.simulate.steady_states_of(case.laboratory, test)
        found.append(np.abs(np.asarray(states.velocity)[:, 0])[np.argsort(way)])
    return steps, *found


class Held(NamedTuple):
    """Motions of one velocity by harmonic balance, over frequency."""

    frequency: np.ndarray  # rad/s
    force: np.ndarray  # N
    phase: np.ndarray  # rad, falling: the sensor's velocity ahead of the force

    def at_frequency(self, omega: float) -> float:
        """The force (N) at a frequency."""
        return float(np.interp(omega, self.frequency, self.force))

    def at_phase(self, phase: float) -> tuple[float, float]:
        """Frequency (rad/s) and force (N) at a phase."""
        return tuple(
            float(np.interp(-phase, -self.phase, one)) for one in (self.frequency, self.force)
        )


def held_velocity(case: Case, speed: float, omega: float) -> Held:
    """The motions of one velocity about a frequency; raises where the range is not traced."""
    steps = sj.simulate.StepControl(largest=0.01, max_points=4000)
    curve = sj.simulate.response_controlled(
        case.model, float(speed), 0.92 * omega, 1.1 * omega, steps=steps
    )
    # Internal resonances turn such curves back: the stretch about the frequency without a turn.
    falls = np.flatnonzero(np.diff(curve.frequency) <= 0)
    edges = np.concatenate([[-1], falls, [len(curve.frequency) - 1]])
    for first, last in itertools.pairwise(edges):
        part = slice(first + 1, last + 1)
        if len(curve.frequency[part]) and curve.frequency[part][0] < omega < curve.frequency[last]:
            # A force below zero points the other way.
            turned = curve.velocity[part, 1, 0] * np.sign(curve.force[part])
            phase = np.unwrap(np.angle(turned))
            return Held(curve.frequency[part], np.abs(curve.force[part]), phase)
    raise RuntimeError(f"no truth at {speed:.4g} m/s: {curve.status.name}.")


def synthesise(case: Case, result, axis, tell) -> None:
    """Responses from a backbone beside those by harmonic balance."""
    ends = (0.9 * HERTZ * case.ends[0], 1.1 * HERTZ * case.ends[1])
    for number, force in enumerate(case.forces):
        began = time.time()
        (exact,) = sj.forced_response(case.model, [force], *ends)
        (found,) = sj.methods.synthesised_response(
            result, case.model.modes, force, from_frequency=ends[0], to_frequency=ends[1]
        )
        speed, seen = np.abs(exact.velocity[:, 1, 0]), np.abs(found.velocity)
        folds = np.sort(exact.frequency[exact.at_events("fold")])
        turns = found.frequency[np.flatnonzero(np.diff(np.sign(np.diff(found.frequency)))) + 1]
        # The upper branch up to the peak, and the lower one from its fold on.
        last = [np.flatnonzero(~one) for one in (exact.is_stable, found.stable)]
        last = [int(one[-1]) if one.size else 0 for one in last]
        tops = int(np.argmax(speed)), int(np.argmax(seen))
        pairs = [
            (slice(0, tops[0]), slice(0, tops[1])),
            (slice(max(last[0], tops[0]) + 1, None), slice(max(last[1], tops[1]) + 1, None)),
        ]
        misses = []
        for part, other in pairs:
            there = np.interp(
                exact.frequency[part], found.frequency[other], seen[other], np.nan, np.nan
            )
            large = speed[part] > 0.1 * speed.max()
            misses.append(np.nanmax(np.abs(there - speed[part])[large]) / speed.max())
        tell(
            *("synthesis", began),
            force_n=force,
            peak_velocity_error=float(seen.max() / speed.max() - 1),
            peak_frequency_error=float(
                found.frequency[np.argmax(seen)] / exact.frequency[np.argmax(speed)] - 1
            ),
            fold_frequency_errors=[float(e) for e in np.sort(turns) / folds - 1]
            if len(turns) == len(folds)
            else f"{len(turns)} turns, {len(folds)} folds",
            stable_distance_max=[float(miss) for miss in misses],
        )
        first = number == 0
        axis.plot(
            *(exact.frequency / HERTZ, speed, "k--"),
            **{"lw": 1, "label": "harmonic balance" if first else None},
        )
        for stable, style in ((True, "-"), (False, ":")):
            axis.plot(
                *(found.frequency / HERTZ, np.where(found.stable == stable, seen, np.nan), style),
                color=COLOURS[0],
                label=f"from the loop's backbone{'' if stable else ', unstable'}"
                if first
                else None,
            )
    good = result.found
    axis.plot(
        *(result.natural_frequency[good] / HERTZ, result.velocity[good], "s"),
        **{"color": COLOURS[1], "ms": 5, "mfc": "none"},
    )
    axis.set(xlabel="frequency (Hz)", ylabel="velocity (m/s)")
    axis.set_title(" and ".join(f"{force:g}" for force in case.forces) + " N", fontsize=10)


def run(name: str, case: Case, axes) -> None:
    """All tests of one structure, a line each, and its column of the figure."""

    def tell(test: str, began: float, **numbers) -> None:
        line = {"benchmark": "methods_controllers", "structure": name, "test": test}
        print(json.dumps({**line, **numbers, "seconds": round(time.time() - began, 1)}), flush=True)

    truth = backbone(case)
    response, section, drawn = axes
    response.plot(truth[1] / HERTZ, truth[0], "k--", lw=1, label="resonances, harmonic balance")

    began = time.time()
    steps, up, down = open_loop(case)
    apart = np.abs(up / down - 1) > 0.1
    drops = [int(np.argmin(np.diff(np.log(up)))), int(np.argmax(-np.diff(np.log(down))))]
    tell(
        *("open_loop", began),
        jump_down_hz=steps[drops[0]] / HERTZ,
        jump_up_hz=steps[drops[1]] / HERTZ,
        both_answers_share=float(apart.mean()),
        velocity_ratio_max=float((up / down).max()),
    )
    response.plot(steps / HERTZ, up, ">", color="0.45", ms=4, label="open loop, up")
    response.plot(steps / HERTZ, down, "<", color="0.7", ms=4, label="open loop, down")

    began = time.time()
    loops = [
        sj.methods.phase_locked_loop(
            case.laboratory, case.voltages, gains=gains, settle_cycles=case.settle
        )
        for gains in case.gains
    ]
    tell("pll", began, **judged(case, loops, truth))
    found = loops[0].found
    response.plot(
        loops[0].natural_frequency[found] / HERTZ,
        loops[0].velocity[found],
        *("s",),
        **{"color": COLOURS[1], "ms": 5, "mfc": "none", "label": "backbone, phase-locked loop"},
    )

    began = time.time()
    sweeps = [
        sj.simulate.phase_sweep(
            case.laboratory, case.voltage, PHASES, gains=gains, settle_cycles=case.settle
        )
        for gains in case.gains
    ]
    held = [one.held for one in sweeps]
    true = np.array(
        [
            [
                held_velocity(case, abs(v), at).at_phase(float(np.angle(v)))
                if good
                else (np.nan, np.nan)
                for v, at, good in zip(one.velocity, one.frequency, ok, strict=True)
            ]
            for one, ok in zip(sweeps, held, strict=True)
        ]
    )
    off = np.array([one.frequency for one in sweeps]) / true[..., 0] - 1
    off_force = np.array([one.force for one in sweeps]) / true[..., 1] - 1
    speed = np.abs(sweeps[0].velocity)
    tops, floors = (np.interp(sweeps[0].frequency, steps, one) for one in (up, down))
    unseen = held[0] & (speed < 0.95 * tops) & (speed > 1.05 * floors)
    tell(
        *("phase_sweep", began),
        states=[int(ok.sum()) for ok in held],
        asked=len(PHASES),
        where_no_open_loop_was=int(unseen.sum()),
        frequency_error_max=float(np.nanmax(np.abs(off))),
        force_error_max=float(np.nanmax(np.abs(off_force))),
        apart_between_gains_max=float(np.nanmax(np.abs(off[1] - off[0]))),
    )
    response.plot(
        sweeps[0].frequency / HERTZ,
        speed,
        *("o-",),
        **{"color": COLOURS[0], "ms": 4, "lw": 0.8, "label": "phase after phase, same voltage"},
    )

    began = time.time()
    continued = [
        sj.methods.control_based_continuation(case.laboratory, case.targets, settings)
        for settings in case.feedback
    ]
    tell("cbc", began, **judged(case, continued, truth))
    found = continued[0].found
    response.plot(
        continued[0].natural_frequency[found] / HERTZ,
        continued[0].velocity[found],
        *("x",),
        **{"color": "k", "ms": 7, "label": "backbone, control-based continuation"},
    )
    response.axvline(case.frequency, color="0.85", zorder=0)
    response.set(xlabel="frequency (Hz)", ylabel="velocity (m/s)")

    began = time.time()
    omega = HERTZ * case.frequency
    curves = [
        sj.simulate.s_curve(case.laboratory, omega, case.amplitudes, settings)
        for settings in case.feedback
    ]
    ok = np.isfinite(curves[0].force)
    exact = np.array(
        [held_velocity(case, v, omega).at_frequency(omega) for v in curves[0].velocity[ok]]
    )
    other = np.isfinite(curves[1].force)
    within = other
    direct = np.array(
        [held_velocity(case, v, omega).at_frequency(omega) for v in curves[1].velocity[within]]
    )
    misses = [curves[0].force[ok] - exact, curves[1].force[within] - direct]
    tell(
        *("s_curve", began),
        frequency_hz=case.frequency,
        held=[int(ok.sum()), int(other.sum())],
        falling=int(np.sum(np.diff(curves[0].force[ok]) < 0)),
        force_error_max=[float(np.abs(miss).max() / exact.max()) for miss in misses],
        invasive_max=[float(np.nanmax(one.invasive)) for one in curves],
    )
    both_speeds = np.concatenate([curves[0].velocity[ok], curves[1].velocity[within]])
    order = np.argsort(both_speeds)
    section.plot(
        *(both_speeds[order], np.concatenate([exact, direct])[order], "k--"),
        **{"lw": 1, "label": "harmonic balance"},
    )
    for one, colour, mark, label in zip(
        curves, COLOURS, "ox", ("first gains", "second gains"), strict=True
    ):
        section.plot(one.velocity, one.force, mark, color=colour, ms=5, label=label)
    section.set(xlabel="velocity (m/s)", ylabel="force (N)")
    section.set_title(f"held at {case.frequency:g} Hz", fontsize=10)

    synthesise(case, loops[0], drawn, tell)
    began = time.time()
    lost = sj.methods.phase_locked_loop(
        case.laboratory, case.voltages[-2:], gains=case.wild, settle_cycles=case.settle
    )
    blown = case.feedback[0]._replace(filter_rate=20 * case.feedback[0].filter_rate)
    tell(
        *("badly_tuned", began),
        pll=[MethodStatus(int(s)).name.lower() for s in lost.status],
        cbc_filter_too_fast=int(
            np.isnan(
                sj.simulate.s_curve(case.laboratory, omega, case.amplitudes[:2], blown).force
            ).sum()
        ),
        of=2,
    )


def main() -> None:
    """Run the structures and draw them."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--structure", choices=["stop", "flat"])
    parser.add_argument("--out", type=Path, default=Path())
    given = parser.parse_args()
    names = [given.structure] if given.structure else ["stop", "flat"]
    figure, axes = plt.subplots(
        *(3, len(names)),
        **{"figsize": (5.2 * len(names), 11), "squeeze": False, "layout": "constrained"},
    )
    for name, column in zip(names, axes.T, strict=True):
        run(name, {"stop": stop, "flat": flat}[name](), column)
        title = {"stop": "one mode and a one-sided stop", "flat": "flat clamped beam"}[name]
        column[0].set_title(title, fontsize=10)
    axes[0, 0].legend(fontsize=8, frameon=False, loc="upper left")
    axes[1, 0].legend(fontsize=8, frameon=False)
    axes[2, 0].legend(fontsize=8, frameon=False)
    given.out.mkdir(parents=True, exist_ok=True)
    figure.savefig(given.out / "methods_controllers.png", dpi=150)


if __name__ == "__main__":
    main()
