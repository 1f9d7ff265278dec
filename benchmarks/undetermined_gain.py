"""Does a test whose force is known as a drive voltage end with a gain that is right, or say so?

Run: python benchmarks/undetermined_gain.py [--seed 0] [--verb identify|diagnose] [--only NAME]

Forty tests and more: five structures, each under eight plans of measurement of which most do not
determine how many newtons a volt makes. States are exact for curves of natural frequency and
damping given in closed form, solved state by state with `scipy.optimize.brentq`: nothing is shared
with the solver. One JSON line a verb (a line a test with `--each`): how many tests were refused,
bounded (a gain with a stated error of 10 % or more that holds the truth), said
(a warning about the gain), silent and right, silent and wrong. Right is a gain known
to 10 % and within three of its standard deviations and 2 %, a velocity axis that ends within 3 % of
the largest velocity measured, and natural frequencies within three of their standard deviations or
0.2 % (what this benchmark is not about).
"""

import time
from collections import Counter
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from harness import options, teller
from scipy.optimize import brentq

import snrmjax as sj
from snrmjax.identify.inference.fitted_curves import values_to_the_largest
from snrmjax.numerics.facts import Fact

tell = teller(__file__)

HERTZ = 2 * np.pi
NOISE = {"amplitude": 0.004, "phase": np.radians(0.3), "force": 0.001}


class Plant(NamedTuple):
    """A structure: curves of its mode by the displacement amplitude over `reach`, and its gain."""

    frequency: Callable[[float], float]  # ω̃, rad/s
    damping_ratio: Callable[[float], float]
    constant: float  # Φ_r Φᵀb, 1/kg
    reach: float  # m
    gain: float  # N/V, or kg m/s² per volt of a shaker's base
    others: tuple[tuple[float, float, float], ...] = ()  # Hz, damping ratio, 1/kg

    def state(self, force: float, phase: float) -> tuple[float, complex]:
        """Frequency (rad/s) and velocity (m/s) of a mode with this phase to the force."""

        def at(displacement: float) -> tuple[float, float]:
            own = self.frequency(displacement / self.reach)
            modal = 2 * own * self.damping_ratio(displacement / self.reach)
            slope = 0.5 * modal * np.tan(phase)
            omega = -slope + np.hypot(slope, own)
            return omega, displacement * omega * modal - self.constant * force * np.cos(phase)

        largest = self.reach
        while at(largest)[1] < 0:
            largest *= 1.2
        found = brentq(lambda x: at(x)[1], 1e-9 * self.reach, largest, xtol=1e-15, rtol=1e-13)
        omega = at(found)[0]
        return omega, found * omega * np.exp(1j * phase)

    def other_modes(self, omega: float, force: float) -> complex:
        """Velocity of the other modes."""
        return sum(
            (
                1j * omega * a * force / ((HERTZ * f) ** 2 - omega**2 + 2j * z * HERTZ * f * omega)
                for f, z, a in self.others
            ),
            start=0j,
        )

    def force_at(self, displacement: float) -> float:
        """Force that reaches a displacement at resonance."""
        fraction = displacement / self.reach
        own = self.frequency(fraction)
        return 2 * self.damping_ratio(fraction) * own**2 * displacement / self.constant


def hertz(value: float, change: float, power: float = 2.0) -> Callable[[float], float]:
    """A natural frequency that has changed by a share at the largest amplitude."""
    return lambda a: HERTZ * value * (1 + change * a**power)


def grown(value: float, change: float, power: float = 1.0) -> Callable[[float], float]:
    """A damping ratio that has changed by a share at the largest amplitude."""
    return lambda a: value * (1 + change * a**power)


PLANTS = {
    "softening_8_percent_damping_growth": Plant(
        hertz(32.0, -0.08), grown(0.008, 0.08), 0.8, 2e-3, 6.3
    ),
    "strong_damping_growth": Plant(hertz(61.0, -0.01), grown(0.004, 2.0), 1.7, 4e-4, 0.42),
    "base_driven_clamped_beam": Plant(
        hertz(118.0, 0.07),
        grown(0.006, 0.3),
        1.3,
        3e-4,
        23.0,
        ((330.0, 0.005, 0.45), (640.0, 0.005, 0.3)),
    ),
    "piezo_plate": Plant(hertz(540.0, -0.004), grown(0.0015, 0.15), 9.0, 1.3e-4, 0.011),
    "bolted_joint": Plant(hertz(80.0, -0.03, 1.0), grown(0.003, 1.5, 0.6), 0.5, 3e-4, 2.6),
}


class Plan(NamedTuple):
    """A plan of measurement: phases of the states (degrees) at levels' shares of the reach."""

    degrees: tuple[float, ...]
    levels: tuple[float, ...]
    stated: bool  # whether the noise is
    drift: float = 0.0  # of the velocities' gain from the first to the last level, unstated


FIVE = (0.2, 0.4, 0.6, 0.8, 1.0)
AROUND = (70.0, 50.0, 30.0, 12.0, 0.0, -12.0, -30.0, -50.0, -70.0)
NEAR = (8.0, 5.0, 2.0, 0.0, -2.0, -5.0, -8.0)
PLANS = {
    "around": Plan(AROUND, FIVE, stated=True),
    "around_noise_unstated": Plan(AROUND, FIVE, stated=False),
    "near": Plan(NEAR, FIVE, stated=True),
    "near_noise_unstated": Plan(NEAR, FIVE, stated=False),
    "one_level": Plan((*AROUND, 40.0, -40.0, 20.0, -20.0), (1.0,), stated=True),
    "one_level_near": Plan(NEAR, (1.0,), stated=False),
    "resonances_only": Plan((0.4, -0.3), (0.15, *FIVE), stated=True),
    "one_side": Plan((65.0, 50.0, 35.0, 20.0, 10.0, 5.0), FIVE, stated=True),
    "few_states": Plan((30.0, 0.0, -30.0), (0.5, 1.0), stated=True),
    "levels_drift": Plan(AROUND, FIVE, stated=True, drift=0.1),
    "near_levels_drift": Plan(NEAR, FIVE, stated=False, drift=0.1),
}


def measured(plant: Plant, plan: Plan, seed: int) -> sj.measure.SteadyStates:
    """A test with its noise, the force in volts."""
    rng = np.random.default_rng(seed)
    rows = []
    for level, fraction in enumerate(plan.levels):
        force = plant.force_at(fraction * plant.reach)
        for degrees in plan.degrees:
            omega, velocity = plant.state(force, np.radians(degrees))
            velocity += plant.other_modes(omega, force)
            velocity *= 1 + plan.drift * (level / max(len(plan.levels) - 1, 1) - 0.5)
            rows.append((level, omega, force, velocity))
    level, omega, force, velocity = map(np.array, zip(*rows, strict=True))
    draws = rng.normal(size=(3, len(rows)))
    noisy = velocity * np.exp(NOISE["amplitude"] * draws[0] + 1j * NOISE["phase"] * draws[1])
    drive = force / plant.gain * np.exp(NOISE["force"] * draws[2])
    stds = {}
    if plan.stated:
        stds = {
            "velocity_std": NOISE["amplitude"] * np.abs(noisy),
            "phase_std": np.full(len(rows), NOISE["phase"]),
        }
    return sj.measure.steady_states(
        level, omega, np.full(len(rows), np.nan), noisy, drive=drive, **stds
    )


def linear_model(plant: Plant) -> sj.model.Structure:
    """What a linear test says: frequency right to 0.1 %, damping to 10 %, the mass right."""
    modes = (
        (plant.frequency(0.0) * 1.001 / HERTZ, 1.1 * plant.damping_ratio(0.0), plant.constant),
        *plant.others,
    )
    frequency, ratio, constant = map(np.array, zip(*modes, strict=True))
    own = sj.model.linear_modes(HERTZ * frequency, ratio, np.ones((1, len(modes))), constant)
    return sj.model.Structure(own, sj.model.polynomial_potential({}, len(modes)))


class Outcome(NamedTuple):
    """How one test ended."""

    kind: str
    gain: float = np.nan  # found over true
    gain_std: float = np.nan  # relative
    axis: float = np.nan  # largest velocity over the true one
    frequency: float = np.nan  # largest error, in standard deviations
    seconds: float = 0.0
    words: str = ""


OF_GAIN = {
    *("force_gain_undetermined", "force_gain_near_resonance", "force_gain_in_answer"),
    *("force_gain_far", "force_gain_moved", "level_errors_at_limit"),
}
"""Kinds of notes that say that the gain is not known."""


def about_gain(notes: tuple[Fact, ...]) -> str:
    """The note that says that the gain is not known, if any does."""
    return next((str(note) for note in notes if note.kind in OF_GAIN), "")


def largest_velocity(data: sj.measure.SteadyStates) -> float:
    """Largest velocity amplitude measured."""
    return float(np.max(np.abs(np.asarray(data.velocity))))


def identified(plant: Plant, plan: Plan, data: sj.measure.SteadyStates) -> Outcome:
    """A joint fit of one test."""
    fit = sj.fit_jointly(data, linear_model(plant))
    place = fit.names().index("force_gain")
    gain = float(np.exp(fit.unknowns.log_force_gain)) / plant.gain
    std = float(np.sqrt(fit.covariance[place, place]))
    fraction = np.linspace(min(plan.levels), 1.0, 9)
    at = sj.identify.fitted_values(fit, displacement=fraction * plant.reach)
    true = np.array([plant.frequency(one) for one in fraction])
    found, band = np.asarray(at.natural_frequency), np.asarray(at.natural_frequency_std)
    missed = float(np.max(np.abs(found - true) / np.maximum(band, 7e-4 * true)))
    speed = np.asarray(values_to_the_largest(fit, 41).velocity)
    axis = float(speed[-1]) / largest_velocity(data)
    holds = abs(np.log(gain)) < 3 * std + 0.02
    right = holds and std < 0.1 and abs(axis - 1) < 0.03 and missed < 3
    said = about_gain(fit.notes)
    kind = "silent_and_right" if right else "silent_and_wrong"
    if said:
        kind = "bounded" if holds and std > 0.1 and abs(axis - 1) < 0.03 else "said"
    return Outcome(kind, gain, std, axis, missed, words=said)


def diagnosed(plant: Plant, _: Plan, data: sj.measure.SteadyStates) -> Outcome:
    """A diagnosis of one test; right is a gain within 10 %, or a verdict that names nothing."""
    found = sj.diagnose_model(linear_model(plant), data)
    force = np.asarray(found.data.force) / np.asarray(data.drive)
    gain = float(np.median(force)) * found.answer.force_gain / plant.gain
    said = about_gain(found.notes)
    honest = not found.verdict.is_answer and found.verdict.value != "none"
    right = honest or abs(np.log(max(gain, 1e-300))) < 0.1
    kind = "silent_and_right" if right else "silent_and_wrong"
    words = f"{found.verdict.value}: {', '.join(found.effects)}"
    return Outcome("said" if said else kind, gain, words=words)


VERBS = {"identify": identified, "diagnose": diagnosed}


def one_test(verb: str, plant: Plant, plan: Plan, seed: int) -> Outcome:
    """One test, refusals included."""
    began = time.perf_counter()
    data = measured(plant, plan, seed)
    try:
        found = VERBS[verb](plant, plan, data)
    except ValueError as error:
        found = Outcome("refused", words=str(error))
    return found._replace(seconds=time.perf_counter() - began)


def main() -> None:
    """All structures under all plans."""
    chosen = options(__doc__, seed=0, verb=list(VERBS), only="", each=False)
    for verb in chosen.verb:
        counts: Counter[str] = Counter()
        seconds, wrong = [], []
        for number, (name, plant) in enumerate(PLANTS.items()):
            for other, (how, plan) in enumerate(PLANS.items()):
                label = f"{name}, {how}"
                if chosen.only not in label:
                    continue
                found = one_test(verb, plant, plan, 1000 * chosen.seed + 50 * number + other)
                counts[found.kind] += 1
                seconds.append(found.seconds)
                wrong += [label] if found.kind == "silent_and_wrong" else []
                if chosen.each:
                    tell(test=label, **found._asdict())
        line = {"verb": verb, "tests": sum(counts.values())}
        names = ("refused", "bounded", "said", "silent_and_right", "silent_and_wrong")
        line |= {key: counts[key] for key in names}
        tell(**line, seconds=np.median(seconds), wrong=wrong)


if __name__ == "__main__":
    main()
