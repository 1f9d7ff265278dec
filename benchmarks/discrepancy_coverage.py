"""Do bands hold the truth where a structure does what no function of amplitude can?

Run: python benchmarks/discrepancy_coverage.py [--tests 200] [--seed 0] [--workers 2]

One mode that softens, with damping that grows with amplitude; four levels of 25 states, equally
spaced in phase from -70° to 70°. States are solved for exactly from the force balance, with one of
six effects that neither the joint fit nor the pointwise curve knows, each of a random size:

- side: damping beside resonance, larger on the side of low frequencies, in every level;
- both: damping that rises beside resonance to both sides;
- history: stiffness on the side of high frequencies, as of a joint that has slipped before;
- drift: a natural frequency that changes from the first state of a level to its last;
- settling: states that were read before they had settled, each a part of the step before behind;
- force: a force whose recorded phase turns with its distance from resonance;

and `none`. Velocity and phase have 0.2 % noise; nothing is stated of it. Judged at the phase
resonance of every level: natural frequency and damping, by the joint fit (smooth
curves) and by the pointwise backbone, as shares inside 95 % bands and bias over their half-width.
One JSON line for every effect.
"""

import argparse
import json
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from typing import NamedTuple

import numpy as np
from scipy.optimize import brentq

import snrmjax as sj

HERTZ = 2 * np.pi
OWN, MASS = 80.0 * HERTZ, 2.0  # rad/s, kg
FORCES = (0.2, 0.45, 0.9, 1.5)  # N
PHASES = np.radians(np.linspace(70, -70, 25))
NOISE = 0.002


class Effect(NamedTuple):
    """What changes stiffness (relative to the damping's force) and damping, by phase and place."""

    stiffness: Callable[[float, float], float]
    damping: Callable[[float, float], float]
    settling: float = 0.0  # share of the step before that a state is behind
    turn: float = 0.0  # rad, of the recorded force's phase at the outermost states


def nothing(phase: float, place: float) -> float:
    """No change."""
    return 0.0


def effect_of(kind: str, size: float) -> Effect:
    """One of the six effects; a size of one is a large one."""
    if kind == "side":
        return Effect(nothing, lambda p, _: size * (0.5 if p > 0 else -0.2) * np.sin(p) ** 2)
    if kind == "both":
        return Effect(nothing, lambda p, _: 0.4 * size * np.sin(p) ** 2)
    if kind == "history":
        return Effect(lambda p, _: -0.4 * size * np.sin(min(p, 0.0)) ** 2, nothing)
    if kind == "drift":
        return Effect(lambda _, place: 0.2 * size * (place - 0.5), nothing)
    if kind == "settling":
        return Effect(nothing, nothing, settling=0.3 * size)
    if kind == "force":
        return Effect(nothing, nothing, turn=0.06 * size)
    return Effect(nothing, nothing)


def squared_frequency(amplitude: float) -> float:
    """ω̃² by the displacement amplitude in m."""
    return OWN**2 * (1 - 0.012 * amplitude / (amplitude + 2e-4))


def modal_damping(amplitude: float) -> float:
    """2ζ̃ω̃ by the displacement amplitude in m."""
    return 2 * OWN * 0.002 * (1 + amplitude / 1.5e-4)


def state(force: float, phase: float, place: float, effect: Effect) -> tuple[float, float]:
    """Frequency (rad/s) and displacement (m) with this phase, from the force balance."""
    damping_factor = 1 + effect.damping(phase, place)
    shift = effect.stiffness(phase, place)

    def frequency(amplitude: float) -> float:
        damping = modal_damping(amplitude)
        square = squared_frequency(amplitude) + shift * OWN * damping
        tangent = damping * damping_factor * np.tan(phase)
        return 0.5 * (-tangent + np.sqrt(tangent**2 + 4 * square))

    def excess(amplitude: float) -> float:
        speed = frequency(amplitude) * amplitude
        needed = MASS * modal_damping(amplitude) * damping_factor * speed
        return needed - force * np.cos(phase)

    amplitude = brentq(excess, 1e-9, 1e-1, xtol=1e-16)
    return frequency(amplitude), amplitude


def level_of(force: float, effect: Effect) -> tuple[np.ndarray, np.ndarray]:
    """Frequencies and velocity phasors of a level, as they are read."""
    places = np.linspace(0, 1, len(PHASES))
    pairs = [state(force, p, s, effect) for p, s in zip(PHASES, places, strict=True)]
    frequency, amplitude = np.array(pairs).T
    velocity = frequency * amplitude * np.exp(1j * PHASES)
    velocity[1:] -= effect.settling * np.diff(velocity)
    return frequency, velocity * np.exp(1j * effect.turn * np.abs(np.sin(PHASES)) * np.sin(PHASES))


def truth(effect: Effect) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Velocity, natural frequency and damping ratio at every level's phase resonance.

    Drift makes the natural frequency that of the middle of a level, where resonance is.
    """
    pairs = [state(force, 0.0, 0.5, effect) for force in FORCES]
    frequency, amplitude = np.array(pairs).T
    ratio = np.array([modal_damping(a) for a in amplitude]) / (2 * frequency)
    return frequency * amplitude, frequency, ratio


def judged(job: tuple[str, int]) -> dict[str, np.ndarray]:
    """Errors over 1σ of frequency and damping, by the joint fit and pointwise."""
    kind, seed = job
    random = np.random.default_rng(seed)
    effect = effect_of(kind, random.uniform(0.4, 1.0))
    parts = [level_of(force, effect) for force in FORCES]
    n = len(PHASES)
    frequency, velocity = (np.concatenate(columns) for columns in zip(*parts, strict=True))
    noise = NOISE * random.standard_normal((2, len(frequency)))
    velocity = velocity * np.exp(noise[0] + 1j * noise[1])
    level, force = np.repeat(np.arange(1, 5), n), np.repeat(FORCES, n)
    data = sj.measure.steady_states(level, frequency, force, velocity)
    modes = sj.model.linear_modes([OWN], [0.002], [[MASS**-0.5]], [MASS**-0.5])
    speed, natural, ratio = truth(effect)
    fit, points = sj.fit_jointly(data, modes), sj.identify_backbone(data, modes)
    errors, bands = scores(fit, points, speed, natural, ratio)
    joint = sj.identify.fitted_values(fit, speed)
    return {
        **errors,
        "joint_band": np.median(bands["joint"][0] * natural) / HERTZ,
        "joint_error": np.abs(np.asarray(joint.natural_frequency) - natural) / HERTZ,
    }


def scores(
    fit: sj.identify.JointFit,
    points: sj.identify.Identification,
    speed: np.ndarray,
    natural: np.ndarray,
    ratio: np.ndarray,
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Errors over 1σ of frequency and damping by both ways at true phase resonances, and their 1σ.

    Arguments: `speed` in m/s, `natural` in rad/s and the damping `ratio` of the truths, relative to
    the model's modal mass. The 1σ are relative to the truth. Rows: frequency, damping.
    """
    joint = sj.identify.fitted_values(fit, speed)
    # Damping of both is relative to the modal mass that a fit found: compared by its force.
    found = float(fit.problem.modal_mass_of(fit.unknowns) * abs(fit.problem.modal_constant))
    curve = points.backbone.values(speed / natural)
    errors, bands = {}, {}
    for way, values in (("joint", joint), ("pointwise", curve)):
        std = np.array([values.natural_frequency_std, found * values.damping_ratio_std])
        given = np.array([values.natural_frequency, found * values.damping_ratio])
        errors[way] = (given - [natural, ratio]) / std
        bands[way] = std / [natural, ratio]
    return errors, bands


def main() -> None:
    """Run the tests and print one line for every effect."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--tests", type=int, default=200, help="with an effect, of all six kinds")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=2)
    chosen = parser.parse_args()
    kinds = ("side", "both", "history", "drift", "settling", "force", "none")
    each = -(-chosen.tests // 6)
    jobs = [(kind, chosen.seed + 1000 * k + t) for k, kind in enumerate(kinds) for t in range(each)]
    with ProcessPoolExecutor(chosen.workers, mp_context=get_context("spawn")) as pool:
        rows = list(pool.map(judged, jobs))
    pooled = [row for (kind, _), row in zip(jobs, rows, strict=True) if kind != "none"]
    groups = {
        kind: [row for (own, _), row in zip(jobs, rows, strict=True) if own == kind]
        for kind in kinds
    }
    for kind, mine in {**groups, "all six": pooled}.items():
        line: dict[str, object] = {"benchmark": "discrepancy_coverage", "effect": kind}
        line["tests"] = len(mine)
        for way in ("joint", "pointwise"):
            scores = np.array([row[way] for row in mine])
            for place, name in enumerate(("frequency", "damping")):
                z = scores[:, place]
                line[f"{way}_{name}_inside_95"] = float(np.mean(np.abs(z) < 1.96))
                line[f"{way}_{name}_bias"] = float(np.max(np.abs(np.mean(z, axis=0))) / 1.96)
        line["joint_frequency_std_hz"] = float(np.median([row["joint_band"] for row in mine]))
        line["joint_frequency_error_hz"] = float(np.median([row["joint_error"] for row in mine]))
        print(json.dumps(line), flush=True)


if __name__ == "__main__":
    main()
