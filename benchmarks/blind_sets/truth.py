"""The true steady states of drawn cases: sweeps, instruments without noise, measured strength."""

from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import islice

import forces
import numpy as np
from effects import (
    IN_HARMONICS_ONLY,
    Effect,
    Points,
    first_order_change,
    lane_values,
    recorded,
)
from flat_beam import FLAT_BEAM
from integration import System
from plans import Case
from strength import baseline_balance, harmonic_units, units_of_noise
from sweep import Lanes, Sweep, run_sweeps

ZEROS = (
    *("lane.second", "lane.third", "lane.shift", "lane.mass", "lane.saturation"),
    *("test.drift", "test.jump", "test.jump_at", "test.warming", "test.warming_rate"),
)
WITHIN_DEG = 60.0
START_DEG = 72.0
TICKS = 60  # of the clock in one sweep


@dataclass
class Truth:
    """Recorded states of one case, scaled and without noise, in test order."""

    level: np.ndarray  # from 1
    frequency: np.ndarray  # Ω/ω₀
    force: np.ndarray  # recorded, scaled
    velocity: np.ndarray  # recorded, scaled: harmonic, point
    order: np.ndarray  # 0…1
    first_clock: float  # of the test's clock at order 0, and its span to order 1
    span: float
    jumps: int
    left_out: int
    residual: float  # worst of periodicity
    units: dict[str, float]  # S in the fundamental and in harmonics 2 and 3


def system_of(case: Case) -> System:
    """The equations that a case needs."""
    kinds = [effect.kind for effect in case.effects]
    fast = next((kind for kind in kinds if kind in forces.N_FAST), "")
    slider = next((kind for kind in kinds if kind in forces.SLIDERS), "")
    resonance = next((kind for kind in kinds if kind.startswith("internal_resonance")), "")
    if case.on_a_beam:
        square = (2 * np.pi * FLAT_BEAM.frequency_hz[0]) ** 2
        potential = tuple(
            (tuple(int(m) - 1 for m in key), value / square)
            for key, value in FLAT_BEAM.potential.items()
        )
        linear = (FLAT_BEAM.frequency_hz, FLAT_BEAM.shape, FLAT_BEAM.participation)
        ratios = ([value / values[0] for value in values] for values in linear)
        frequency, shape, participation = ratios
        modal = tuple(zip(frequency, FLAT_BEAM.damping_ratio, shape, participation, strict=True))
        return System(4, fast, slider, potential=potential, modal=modal, steps=256)
    if resonance:
        return System(2, fast, slider, coupling=int(resonance[-1]))
    return System(1, fast, slider, steps=256 if fast or slider else 384)


def lane_table(cases: list[Case]) -> Lanes:
    """All sweeps of some cases: up and down at each level of the sequence."""
    rows: list[dict[str, float]] = []
    start, direction, step, clock, tick = [], [], [], [], []
    for case in cases:
        base = case.base
        n = 2 * len(case.sequence)
        for k in range(n):
            peak, sense = base.peaks[case.sequence[k // 2]], 1 - 2 * (k % 2)
            row = dict.fromkeys(ZEROS, 0.0)
            row |= {"lane.force": 2 * base.damping * peak, "lane.speed": peak}
            row |= {"lane.damping": base.damping}
            if case.on_a_beam:
                row |= {"beam.scale": case.displacement}
            else:
                row |= {"baseline.cubic": base.cubic}
            for effect in case.effects:
                row |= lane_values(effect)
            row["lane.damping"] += row.pop("lane.extra_damping", 0.0)
            rows.append(row)
            q = peak * np.cos(np.radians(START_DEG))
            stiffness = 1 + 0.75 * base.cubic * q**2
            lean = 2 * base.damping * np.tan(np.radians(START_DEG))
            start.append(np.sqrt(max(stiffness - sense * lean, 0.2)))
            direction.append(sense)
            step.append(case.step_deg[k])
            clock.append(case.begin + k / (case.sweeps or n))
            tick.append(1 / ((case.sweeps or n) * TICKS))
    names = sorted({name for row in rows for name in row})
    # Shapes (a gap, an exponent) need a harmless value in lanes without their effect.
    harmless = {name: max(row.get(name, 0.0) for row in rows) for name in names}
    sizes = ("gap", "width", "lag", "slip_displacement", "exponent")  # ends of names
    parameters = {
        name: np.array(
            [row.get(name, harmless[name] if name.endswith(sizes) else 0.0) for row in rows]
        )
        for name in names
    }
    return Lanes(
        parameters, np.array(start), np.array(direction), np.array(step), np.array(clock),
        np.array(tick),
    )  # fmt: skip


def _aims(rng: np.random.Generator) -> Iterator[float]:
    """Phases in degrees without end, denser near resonance."""
    while True:
        aim = rng.normal(0, 32)
        if abs(aim) <= WITHIN_DEG:
            yield aim


def _thinned(phases: list[float], aims: Iterable[float]) -> list[int]:
    """Indices of the points whose phases in degrees are nearest to what is aimed at."""
    free = list(range(len(phases)))
    chosen: list[int] = []
    for aim in aims:
        if not free:
            break
        best = min(free, key=lambda k: abs(phases[k] - aim))
        free.remove(best)
        chosen.append(best)
    return sorted(chosen)


def assembled(case: Case, sweeps: list[Sweep], aims: Sequence[float] | None = None) -> Truth:
    """The instruments' readings of points near phases in degrees, or near drawn ones."""
    rng = np.random.default_rng([*case.seed, 5])
    fraction = case.n_points / len(case.sequence)
    rows = []
    for place, level in enumerate(case.sequence):
        force = 2 * case.base.damping * case.base.peaks[level]
        candidates = []
        for sweep in sweeps[2 * place : 2 * place + 2]:
            for point in sweep.points:
                w = np.array([point.frequency])
                f, v = np.array([force]), point.velocity[:, None]
                motion = np.array([abs(point.displacement)])
                for effect in case.effects:
                    f, v = recorded(effect, w, f, v, motion)
                phase = float(np.degrees(np.angle(v[1, 0])))
                if abs(phase) <= WITHIN_DEG:
                    candidates.append((phase, point, f[0], v[:, 0]))
        wanted = islice(_aims(rng), max(round(fraction), 5)) if aims is None else aims
        keep = _thinned([c[0] for c in candidates], wanted)
        rows += [(level + 1, *candidates[k][1:]) for k in keep]
    rows.sort(key=lambda row: row[1].clock)
    clock = np.array([row[1].clock for row in rows])
    return Truth(
        level=np.array([row[0] for row in rows]),
        frequency=np.array([row[1].frequency for row in rows]),
        force=np.array([row[2] for row in rows]),
        velocity=np.array([row[3] for row in rows]).T,
        order=(clock - clock[0]) / (clock[-1] - clock[0]),
        first_clock=float(clock[0]),
        span=float(clock[-1] - clock[0]),
        jumps=sum(bool(point.jumped) for sweep in sweeps for point in sweep.points),
        left_out=sum(int(sweep.left_out) for sweep in sweeps),
        residual=max(point.residual for sweep in sweeps for point in sweep.points),
        units={},
    )


def measured_units(case: Case, truth: Truth) -> dict[str, float]:
    """S as it came out: the recorded states against the baseline alone."""
    w, v = truth.frequency, truth.velocity
    x = v[1] / (1j * w)
    at = Points(truth.level, np.abs(x), w, truth.order)
    if case.on_a_beam:  # no single mode stands for the beam: the effect's own first order
        change = sum(first_order_change(e, at, case.base) for e in case.effects)
        low, high = units_of_noise(change, at, case.base, case.errors)
        return {"bottom": low, "top": high}
    k, third = baseline_balance(np.abs(x), w, case.base)
    low, high = units_of_noise(truth.force / x - k, at, case.base, case.errors)
    turn = (x / np.abs(x)) ** 3
    missing = np.stack([v[2], v[3] - 3j * w * third * turn])
    h_low, h_high = harmonic_units(missing, at, case.errors)
    return {"bottom": low, "top": high, "harmonics_bottom": h_low, "harmonics_top": h_high}


def _achieved(case: Case, units: dict[str, float]) -> float:
    if case.effects and case.effects[0].kind in IN_HARMONICS_ONLY:
        return max(units["harmonics_bottom"], units["harmonics_top"])
    return max(units["bottom"], units["top"])


def simulate(cases: list[Case], steps: int | None = None) -> list[Truth]:
    """The recorded states of all cases, integrated together where their equations are alike.

    `steps` a period may be set lower than usual where accuracy matters less than time.
    """
    groups: dict[System, list[int]] = defaultdict(list)
    for k, case in enumerate(cases):
        system = system_of(case)
        groups[system if steps is None else system._replace(steps=steps)].append(k)
    found: dict[int, Truth] = {}
    for system, members in groups.items():
        some = [cases[k] for k in members]
        sweeps = run_sweeps(system, lane_table(some))
        at = 0
        for k, case in zip(members, some, strict=True):
            n = 2 * len(case.sequence)
            truth = assembled(case, sweeps[at : at + n])
            truth.units = measured_units(case, truth)
            found[k], at = truth, at + n
    return [found[k] for k in range(len(cases))]


def _power(effect: Effect) -> float:
    twice = ("quadratic_stiffness", "static_preload", "sensor_saturation")
    return 2.0 if effect.kind in twice or effect.kind.startswith("internal") else 1.0


def calibrated(cases: list[Case], rounds: int = 2, steps: int | None = None) -> list[Truth]:
    """Simulate; where one effect's strength came out more than 15 % off, resize it and repeat."""
    truths = simulate(cases, steps)
    for _ in range(rounds):
        off = []
        for k, (case, truth) in enumerate(zip(cases, truths, strict=True)):
            if len(case.effects) != 1 or case.on_a_beam:
                continue
            ratio = case.wanted[0] / max(_achieved(case, truth.units), 1e-3)
            if abs(np.log(ratio)) > np.log(1.15):
                effect = case.effects[0]
                factor = float(np.clip(ratio, 0.3, 3.0)) ** (1 / _power(effect))
                cases[k] = replace(case, effects=[effect.sized(factor)])
                off.append(k)
        if not off:
            break
        for k, truth in zip(off, simulate([cases[k] for k in off], steps), strict=True):
            truths[k] = truth
    return truths
