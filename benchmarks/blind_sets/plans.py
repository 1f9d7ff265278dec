"""Which sets there are, and the draws of each: structure, levels, effects, errors."""

from dataclasses import dataclass, field
from itertools import product

import numpy as np
from effects import LAWS, OUTSIDE, SHAPES, Baseline, Effect, draw_effect
from flat_beam import FLAT_BEAM
from strength import Errors, first_order_size

HALVES = ("development", "scoring")
STIFFNESS = ("cubic_stiffness", "quintic_stiffness", "gap_stiffness", "one_sided_stop")
DAMPING = ("coulomb_friction", "quadratic_damping", "cubic_damping", "van_der_pol_damping")
CHAIN = ("sensor_phase_error", "frequency_drift", "residual_mode", "jenkins_slider")
ON_A_BEAM = (
    *("coulomb_friction", "quadratic_damping", "cubic_damping", "van_der_pol_damping"),
    *("gap_stiffness", "one_sided_stop", "jenkins_slider", "sensor_phase_error"),
    *("quintic_stiffness", "cubic_stiffness"),
)


@dataclass(frozen=True)
class Plan:
    """What one set is to be."""

    group: str  # none, one_effect, two_effects, outside, beam, noise_wrong
    kinds: tuple[str, ...] = ()
    strength: float = 0.0
    harmonics: bool = True
    level_errors: bool = False
    stated_over_true: float = 1.0


@dataclass
class Case:
    """One set before it is simulated; scaled values as in `forces`."""

    plan: Plan
    name: str
    seed: list[int]
    base: Baseline
    errors: Errors
    natural_frequency_hz: float
    displacement: float  # Q_s, kg^1/2 m
    shape: float  # at the sensor, kg^-1/2
    participation: float  # kg^-1/2
    sequence: tuple[int, ...]  # levels in test order
    n_points: int
    effects: list[Effect]
    wanted: list[float]  # S of each effect
    noise_seed: np.random.SeedSequence
    step_deg: np.ndarray = field(default_factory=lambda: np.zeros(0))
    with_order: bool = True
    begin: float = 0.0  # of the test's clock
    sweeps: int = 0  # in which the clock goes from 0 to 1; 0: the case's own

    @property
    def on_a_beam(self) -> bool:
        """Whether the structure is the flat beam."""
        return self.plan.group == "beam"


def all_plans() -> list[Plan]:
    """The sets of one half, in an order unrelated to their names."""
    plans = [Plan("none", harmonics=k % 2 == 0) for k in range(30)]
    plans += [Plan("none", harmonics=k % 2 == 0, level_errors=True) for k in range(20)]
    for n, kind in enumerate(SHAPES):
        unseen = kind in ("bilinear_stiffness", "force_harmonics")
        for m, strength in enumerate((1.0, 1.0, 0.5, 0.25)):
            harmonics = (m == 0) if m < 2 else (n + m) % 2 == 0
            shared = (n + 3 * m) % 4 == 0
            seen = harmonics or (unseen and m > 1)
            plans.append(Plan("one_effect", (kind,), strength, seen, shared))
    pairs = [
        *product(STIFFNESS, DAMPING),
        *product(STIFFNESS, CHAIN[:3]),
        *product(DAMPING, CHAIN),
    ]
    for k in range(20):
        plans.append(Plan("two_effects", pairs[(13 * k + 5) % len(pairs)], 1.0, k % 2 == 0))
    for kind in OUTSIDE:
        plans += [Plan("outside", (kind,), 1.0, harmonics) for harmonics in (True, False)]
    for k, kind in enumerate(ON_A_BEAM):
        plans.append(Plan("beam", (kind,), 1.0, k % 2 == 0))
    for k in range(12):
        kinds = (
            ("coulomb_friction", "cubic_stiffness", "quadratic_damping", "gap_stiffness")[k // 3],
        )
        wrong = 0.5 if k % 2 == 0 else 1.5
        hidden = k % 3 == 2
        plans.append(
            Plan("noise_wrong", kinds if hidden else (), float(hidden), k % 4 < 2, False, wrong)
        )
    return plans


def law_plans(repeats: int = 3) -> list[Plan]:
    """Sets of laws that no formula of the library has, and twenty without any effect."""
    plans = [Plan("none", harmonics=k % 2 == 0, level_errors=k % 4 == 3) for k in range(20)]
    for n, kind in enumerate(LAWS):
        plans += [
            Plan("law", (kind,), 1.0, harmonics=(n + k) % 3 > 0, level_errors=(n + k) % 5 == 4)
            for k in range(repeats)
        ]
    return plans


def _levels(rng: np.random.Generator) -> tuple[tuple[float, ...], tuple[int, ...]]:
    n = int(rng.integers(4, 7))
    return tuple(np.geomspace(1 / rng.uniform(3.5, 10), 1.0, n).tolist()), tuple(range(n))


def _log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def draw_case(plan: Plan, index: int, half: str, seed: int) -> Case:
    """Draw one set; halves, seeds and sets have independent streams."""
    root = np.random.SeedSequence(seed, spawn_key=(HALVES.index(half), index))
    draws, noise = root.spawn(2)
    rng = np.random.default_rng(draws)
    peaks, sequence = _levels(rng)
    damping = _log_uniform(rng, 0.002, 0.03)
    shift = 0.0
    if rng.random() < 0.75 or plan.kinds == ("static_preload",):
        most = min(0.07, 9 * damping)
        shift = float(rng.uniform(0.25, 1.0) * most * rng.choice([1.0, 1.0, -0.7]))
    if plan.kinds == ("static_preload",):
        shift = abs(shift)  # softening would be unstable under a preload that is seen
    if plan.group == "beam":
        damping, shift = FLAT_BEAM.damping_ratio[0], float(rng.uniform(0.03, 0.07))
    base = Baseline(damping, 8 / 3 * shift, peaks)
    errors = Errors(
        frequency=damping * float(rng.uniform(0.02, 0.08)),
        damping=float(rng.uniform(0.01, 0.03)),
        cubic=float(rng.uniform(0.005, 0.03)),
        level_gain=0.01 if plan.level_errors else 0.0,
        level_phase=np.radians(0.5) if plan.level_errors else 0.0,
        harmonic=float(rng.uniform(0.001, 0.003)),
    )
    if plan.group == "beam":
        frequency, shape = FLAT_BEAM.frequency_hz[0], FLAT_BEAM.shape[0]
        participation = FLAT_BEAM.participation[0]
        displacement = 2 * np.pi * frequency * np.sqrt(base.cubic / FLAT_BEAM.condensed_cubic)
    else:
        frequency = _log_uniform(rng, 5, 500)
        shape = _log_uniform(rng, 0.3, 20)
        participation = shape * _log_uniform(rng, 0.2, 1.0)
        speed = _log_uniform(rng, 0.02, 1.0)
        displacement = speed / (2 * np.pi * frequency * shape)
    effects = [draw_effect(kind, rng, base) for kind in plan.kinds]
    wanted, sized = [], []
    for effect in effects:
        full = float(rng.uniform(5, 10))
        wanted.append(full * plan.strength)
        sized.append(effect.sized(first_order_size(effect, base, errors, full * plan.strength)))
    in_order = any(kind in ("frequency_drift", "frequency_jump", "warming") for kind in plan.kinds)
    if rng.random() < (0.6 if in_order else 0.25):
        sequence = (*sequence, 0)
    return Case(
        plan=plan, name="", seed=[seed, HALVES.index(half), index], base=base, errors=errors,
        natural_frequency_hz=frequency, displacement=float(displacement), shape=shape,
        participation=participation, sequence=sequence, n_points=int(rng.integers(28, 81)),
        effects=sized, wanted=wanted, noise_seed=noise,
        step_deg=rng.uniform(7, 10, 2 * len(sequence)),
        with_order=bool(in_order or rng.random() < 0.7),
    )  # fmt: skip


def draw_cases(half: str, seed: int, *, laws: bool = False) -> list[Case]:
    """All sets of one half, or those of laws outside the library; the names are shuffled."""
    plans = law_plans() if laws else all_plans()
    order = np.random.default_rng([seed, 77, HALVES.index(half)]).permutation(len(plans))
    cases = []
    for index, (plan, place) in enumerate(zip(plans, order, strict=True)):
        case = draw_case(plan, index, half, seed)
        case.name = f"set_{place + 1:04d}"
        cases.append(case)
    return sorted(cases, key=lambda case: case.name)
