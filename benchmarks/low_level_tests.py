"""Low-level tests that already harden or soften: bands of frequency and damping at no amplitude.

Run: python benchmarks/low_level_tests.py [--seeds 40] [--first 0]

The truth is one mode with a cubic spring, in some tests a cubic damper too, beside a far linear
mode: m ẍ + c ẋ + k x + k₃ x³ + c₃ x² ẋ = F cos Ωt, integrated in time by SciPy (DOP853, all states
of a test side by side, from the one-term solution through many periods), with noise of the sensor
and of its gain. In a quarter of the tests k₃ = c₃ = 0; in the others the peak shifts by 0.1 to 1
half-power bandwidth at the highest of two to four levels.

One JSON line a test: errors of frequency and damping at no amplitude in standard errors, jointly
fitted and by the lowest level as a linear mode, and what was said; the last line counts.
"""

import time

import numpy as np
from harness import options, teller
from scipy.integrate import solve_ivp

import snrmjax as sj
from snrmjax.identify.modal.linear_fit import fit_linear_modes
from snrmjax.identify.modal.modes_of_tests import find_modes, responses_of_states

tell = teller(__file__)
HERTZ = 2 * np.pi
WIDE = 1.96


def steady(omega, force, of):
    """Velocity fundamentals of m ẍ + c ẋ + k x + k₃ x³ + c₃ x² ẋ = F cos Ωt, time in 1/Ω."""
    own, ratio, cubic, damper = of
    shift = np.zeros_like(omega)
    for _ in range(200):  # one term: k + 3/4 k₃ X², c + c₃ X²/4
        x = force / (
            own**2
            + 0.75 * cubic * shift
            - omega**2
            + 1j * omega * (2 * ratio * own + 0.25 * damper * shift)
        )
        shift = 0.5 * shift + 0.5 * np.abs(x) ** 2
    n = len(omega)

    def slope(tau, state):
        x, v = state[:n], state[n:]  # v = dx/dτ
        rate = omega * v
        load = force * np.cos(tau) - own**2 * x - cubic * x**3
        return np.append(v, (load - (2 * ratio * own + damper * x**2) * rate) / omega**2)

    periods = int(np.ceil(4 / (HERTZ * ratio)))  # the one-term solution is near: e^-4 of its error
    start = np.append(x.real, -x.imag)
    whole = solve_ivp(slope, (0, periods * HERTZ), start, method="DOP853", rtol=1e-8, atol=1e-12)
    tau = np.linspace(0, HERTZ, 65)[:-1]
    last = solve_ivp(
        slope, (0, HERTZ), whole.y[:, -1], method="DOP853", rtol=1e-9, atol=1e-13, t_eval=tau
    )
    phasor = 2 * np.mean(last.y[:n] * np.exp(-1j * tau), axis=1)
    return 1j * omega * phasor


def made(seed):
    """A test: its steady states and the truth."""
    rng = np.random.default_rng(seed)
    own, ratio = HERTZ * 10 ** rng.uniform(1.0, 2.3), 10 ** rng.uniform(-2.6, -1.7)
    gain = rng.choice([-1, 1]) * 10 ** rng.uniform(-1, 1)
    n_levels, n_points = int(rng.integers(2, 5)), int(rng.integers(15, 41))
    levels = np.sort(10 ** rng.uniform(-1, 0, n_levels))
    levels[-1] = 1.0
    wanted = 0.0 if seed % 4 == 0 else rng.choice([-1, 1]) * rng.uniform(0.1, 1.0)
    top = 1.0 / (2 * ratio * own**2)  # X at resonance for the unit force
    # Shift of the peak 3/8 k₃ X²/ω = wanted × 2ζω.
    cubic = wanted * 2 * ratio * own**2 * 8 / 3 / top**2
    damped = seed % 4 == 3
    damper = damped * rng.uniform(0.2, 1.0) * 8 * ratio * own / top**2 * 0.5
    rows = []
    for number, force in enumerate(levels, start=1):
        middle = 1 + wanted * force**2 * ratio * rng.uniform(0.5, 1.0)
        reach = rng.uniform(4, 8) * ratio
        omega = own * np.linspace(middle - reach, middle + reach, n_points)
        velocity = gain * steady(omega, np.full(n_points, force), (own, ratio, cubic, damper))
        far = 1j * omega * force * gain * 0.3 / ((3.1 * own) ** 2 - omega**2)
        rows += [(number, w, force, v) for w, v in zip(omega, velocity + far, strict=True)]
    level, omega, force, velocity = (np.array(column) for column in zip(*rows, strict=True))
    # Of the lowest level's peak, and of each value.
    floor = 10 ** rng.uniform(-3, -2) * np.abs(velocity[level == 1]).max()
    fraction = 10 ** rng.uniform(-3, -2.3)
    std = np.hypot(floor, fraction * np.abs(velocity)) / np.sqrt(2)
    noise = std * (rng.normal(size=std.shape) + 1j * rng.normal(size=std.shape))
    stated = {}
    if seed % 2:
        stated = {"velocity_std": std[:, None], "phase_std": (std / np.abs(velocity))[:, None]}
    data = sj.measure.steady_states(level, omega, force, (velocity + noise)[:, None], **stated)
    return data, (own, ratio), wanted, damped


def errors(found, truth):
    """Errors of frequency and damping of the mode that is nearest, in standard errors."""
    k = int(np.argmin(np.abs(found.natural_frequency - truth[0])))
    return (
        float((found.natural_frequency[k] - truth[0]) / found.natural_frequency_std[k]),
        float((found.damping_ratio[k] - truth[1]) / found.damping_ratio_std[k]),
    )


def main():
    """Count."""
    asked = options(__doc__, seeds=40, first=0)
    inside, linear, said, seconds = [], [], [], []
    for seed in range(asked.first, asked.first + asked.seeds):
        data, truth, wanted, damped = made(seed)
        begin = time.perf_counter()
        found, notes = find_modes(data)
        seconds.append(time.perf_counter() - begin)
        lowest = responses_of_states(data, 1)
        try:
            alone = errors(fit_linear_modes(lowest.responses, std=lowest.std), truth)
        except ValueError:  # the poles of a resonance that leans do not settle
            alone = np.nan, np.nan
        together = errors(found, truth)
        kinds = [note.kind for note in notes]
        dependent = "amplitude_dependent_mode" in kinds
        note = dict(notes[0]) if dependent else {}
        inside.append(np.abs(together) < WIDE)
        linear.append(np.abs(alone) < WIDE)
        said.append(dependent == (wanted != 0))
        tell(
            seed=seed,
            peak_shift_bandwidths=wanted,
            cubic_damping=damped,
            levels=int(np.max(data.level)),
            said=kinds[0],
            power=note.get("power"),
            levels_used=len(note.get("levels", ())),
            frequency_error_stds=together[0],
            damping_error_stds=together[1],
            linear_frequency_error_stds=alone[0],
            linear_damping_error_stds=alone[1],
        )
    fraction = 100 * np.mean(inside, axis=0)
    own = 100 * np.mean(linear, axis=0)
    tell(
        case="all",
        tests=len(inside),
        **{"coverage_%": 100 * np.mean(inside)},
        **{"frequency_coverage_%": fraction[0], "damping_coverage_%": fraction[1]},
        **{"linear_frequency_coverage_%": own[0], "linear_damping_coverage_%": own[1]},
        **{"dependence_said_rightly_%": 100 * np.mean(said)},
        seconds_a_test=np.median(seconds),
    )


if __name__ == "__main__":
    main()
