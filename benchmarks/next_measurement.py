"""Do the advised next measurements narrow the bands more than evenly spread ones?

Run: python benchmarks/next_measurement.py [--tests 100] [--seed 0]

One mode with stiffening and with damping that rises with velocity, known exactly. Four levels of
five noisy states are fitted jointly. Then ten more states are measured where `next_measurements`
advises, or ten that are spread evenly over the same forces, in three ways: ten forces with phases
from 45° lead to 45° lag (which takes a controller that holds a phase), ten forces with frequencies
evenly between the ends of each response, and a grid of five forces and two frequencies. The fit is
repeated with the same noise, and the mean relative bands of both curves after and before are
compared. One JSON line.
"""

import numpy as np
from harness import options, teller

import snrmjax as sj

tell = teller(__file__)

OMEGA, CONSTANT = 500.0, 6.0  # rad/s at rest; of force over displacement, 1/kg
NOISE = {"velocity": 0.01, "phase": 0.012, "force": 0.003, "gain": 0.01}
FAMILIES = {"backbone": "polynomial:2@displacement", "damping": "viscous_quadratic@velocity"}
FORCES = (0.3, 0.8, 1.6, 2.6)
MODES = sj.model.linear_modes([OMEGA], [0.012], [[2.0]], [3.0])


def squared(x: np.ndarray) -> np.ndarray:
    """ω̃² against displacement (m)."""
    return OMEGA**2 * (1 + 0.3 * (x / 2e-3) ** 2)


def damping(v: np.ndarray) -> np.ndarray:
    """2ζ̃ω̃ against velocity (m/s)."""
    return 12.0 + 6.0 * v


def needed(x: np.ndarray, omega: np.ndarray) -> np.ndarray:
    """Complex force over displacement times A."""
    return squared(x) - omega**2 + 1j * omega * damping(x * omega)


def at_phase(force: float, phase: float) -> tuple[float, complex]:
    """Frequency and velocity under a force where the velocity has a phase, by bisection."""
    low, high, omega = 1e-6, 1e-2, OMEGA
    for _ in range(200):
        x = 0.5 * (low + high)
        omega = np.sqrt(squared(x))
        for _ in range(60):
            omega = np.sqrt(squared(x) - omega * damping(x * omega) * np.tan(phase))
        below = abs(needed(x, omega)) * x < CONSTANT * force
        low, high = (x, high) if below else (low, x)
    return float(omega), 1j * omega * CONSTANT * force / needed(x, omega)


def at_frequency(force: float, omega: float, expected: float) -> complex:
    """The motion under a force at a frequency whose velocity is nearest to the expected one."""
    x = np.linspace(1e-6, 4e-3, 40001)
    excess = np.abs(needed(x, omega)) * x - CONSTANT * force
    at = np.flatnonzero(np.signbit(excess[:-1]) != np.signbit(excess[1:]))
    roots = x[at] - excess[at] * (x[1] - x[0]) / (excess[at + 1] - excess[at])
    best = roots[np.argmin(np.abs(roots * omega - expected))]
    return 1j * omega * CONSTANT * force / needed(best, omega)


Row = tuple[int, float, float, complex]  # level, force, frequency, velocity


def measured(
    rows: list[Row], rng: np.random.Generator, gains: dict[int, float]
) -> sj.measure.SteadyStates:
    """Rows with noise; every level has its own gain."""
    level, force, omega, velocity = (np.array(column) for column in zip(*rows, strict=True))
    for number in level:
        gains.setdefault(int(number), NOISE["gain"] * rng.normal())
    n, shared = len(level), np.array([gains[int(k)] for k in level])
    own = NOISE["velocity"] * rng.normal(size=n) + 1j * NOISE["phase"] * rng.normal(size=n)
    velocity = velocity * np.exp(shared + own)
    force = force * np.exp(NOISE["force"] * rng.normal(size=n))
    return sj.measure.steady_states(
        level,
        omega,
        force,
        velocity,
        velocity_std=NOISE["velocity"] * np.abs(velocity),
        phase_std=np.full((n, 1), NOISE["phase"]),
        force_std=NOISE["force"] * force,
    )


def fitted(data: sj.measure.SteadyStates) -> sj.identify.JointFit:
    """The joint fit of all these tests."""
    return sj.fit_jointly(data, MODES, level_gain_std=NOISE["gain"], **FAMILIES)


def band(fit: sj.identify.JointFit, at: np.ndarray) -> float:
    """Mean relative 1σ of both curves."""
    values = sj.identify.fitted_values(fit, at)
    return float(
        np.mean(values.natural_frequency_std / values.natural_frequency)
        + np.mean(values.modal_damping_std / values.modal_damping)
    )


def advised(fit: sj.identify.JointFit) -> list[Row]:
    """Ten states as the fit advises; equal forces are one level."""
    advice = sj.next_measurements(fit, 10)
    level = {force: 10 + k for k, force in enumerate(dict.fromkeys(one.force for one in advice))}
    return [
        (
            *(level[one.force], one.force, one.frequency),
            at_frequency(one.force, one.frequency, one.velocity),
        )
        for one in advice
    ]


def even(way: str) -> list[Row]:
    """Ten states spread evenly."""
    # So that force and place on the response are not correlated.
    turns = [0, 5, 1, 6, 2, 7, 3, 8, 4, 9]
    forces = np.linspace(FORCES[0], FORCES[-1], 5 if way == "grid" else 10)
    if way == "phases":
        phases = np.radians(np.linspace(45, -45, 10))[turns]
        return [
            (40 + k, f, *at_phase(f, p))
            for k, (f, p) in enumerate(zip(forces, phases, strict=True))
        ]
    fractions = (
        np.tile([0.25, 0.75], (5, 1)) if way == "grid" else (np.array(turns)[:, None] + 0.5) / 10
    )
    rows: list[Row] = []
    for k, (force, mine) in enumerate(zip(forces, fractions, strict=True)):
        low, high = (at_phase(force, np.radians(end))[0] for end in (70, -70))
        tip, velocity = at_phase(force, 0.0)
        for omega in low + mine * (high - low):
            # A sweep up stays on the branch of large motion as far as resonance.
            expected = abs(velocity) if omega <= tip else 0.0
            rows.append((40 + k, force, omega, at_frequency(force, omega, expected)))
    return rows


WAYS = ("phases", "frequencies", "grid")


def one_test(seed: int) -> list[float]:
    """Band ratios after ten advised and after ten even states, way by way."""
    rng, gains = np.random.default_rng(seed), {}
    rows = [
        (k, force, *at_phase(force, phase))
        for k, force in enumerate(FORCES)
        for phase in np.radians(np.linspace(-40, 40, 5))
    ]
    data = measured(rows, rng, gains)
    fit = fitted(data)
    speed = np.abs(np.asarray(fit.motion().velocity))
    at = np.linspace(speed.min(), speed.max(), 25)
    before, ratios = band(fit, at), []
    for more in (advised(fit), *map(even, WAYS)):
        joined = sj.measure.join_steady_states(data, measured(more, rng, dict(gains)))
        ratios.append(band(fitted(joined), at) / before)
    return ratios


def main() -> None:
    """All tests and one line."""
    chosen = options(__doc__, tests=100, seed=0)
    ratios = np.array([one_test(chosen.seed + k) for k in range(chosen.tests)])
    line: dict[str, object] = {
        "tests": len(ratios),
        "band_after_advised": round(float(np.median(ratios[:, 0])), 3),
    }
    for k, way in enumerate(WAYS, 1):
        gain = (1 - ratios[:, 0]) / (1 - ratios[:, k])
        line[f"even_{way}"] = {
            "band_after": round(float(np.median(ratios[:, k])), 3),
            "advice_shrinks_more_by_median": round(float(np.median(gain)), 2),
            "share_at_least_1_5": round(float(np.mean(gain >= 1.5)), 2),
            "share_better": round(float(np.mean(gain > 1)), 2),
        }
    tell(**line)


if __name__ == "__main__":
    main()
