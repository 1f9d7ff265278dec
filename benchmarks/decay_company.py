"""Free decays with other modes, hum, an offset and noise: coverage of 95 % bands, refusals.

Run: python benchmarks/decay_company.py [--seed 1] [--count 60] [--show] [--write]

Every record is a sum of one to three oscillators, each integrated alone in time by SciPy (DOP853):
q̈ + d(q̇) + ω₀² q + β q³ = 0 with a linear, hardening or softening spring and damping of 0.1 to 2 %
that is viscous, grows with the velocity (v|v|) or shrinks with it (v/(1 + v²/v₀²)). The others have
2 to 40 % of the energy at the start, at 0.3 to 6 times the frequency and 20 % or more away from all
that the mode has in its decay; in every fifth record one is 5 to 15 % away, where a refusal is
right (and an answer right if its bands hold). Noise of 0.1 to 3 % and hum at 50 Hz of 0 to 2 % of
the largest velocity, an offset within ±5 %. The model says the linear frequency with 1 % error.

Truth: undamped motions of the mode alone, integrated over half a cycle: fundamental velocity V,
frequency, and mean power lost over ½ V². A point is covered where frequency or damping is within
1.96 of the stated 1σ. One JSON line a method.
"""

from typing import NamedTuple

import numpy as np
from harness import options, teller
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicSpline

import snrmjax as sj
from snrmjax.measure import Channel, time_recording
from snrmjax.methods.comparison import run_record_method
from snrmjax.methods.records.recorded_test import recorded_test
from snrmjax.numerics.rules import InputError

tell = teller(__file__)

METHODS = ("resonant_decay", "ssm", "restoring_force")
HERTZ = 2 * np.pi
_CLOSE_EVERY = 5
_AWAY = 0.2


class Oscillator(NamedTuple):
    """One mode, per unit of its mass."""

    rest: float  # rad/s
    cubic: float  # 1/(s² m²)
    viscous: float  # 1/s
    quadratic: float  # 1/m
    saturates: float  # 1/s, of v/(1 + v²/v₀²)
    knee: float  # m/s, v₀
    start: float  # m

    def spring(self, q):
        """Elastic force."""
        return self.rest**2 * q + self.cubic * q**3

    def damper(self, v):
        """Damping force."""
        return (
            self.viscous * v
            + self.quadratic * v * np.abs(v)
            + self.saturates * v / (1 + (v / self.knee) ** 2)
        )

    def decay(self, time):
        """Velocity in free decay."""
        found = solve_ivp(
            lambda _, state: (state[1], -self.spring(state[0]) - self.damper(state[1])),
            *((0, time[-1]), (self.start, 0.0), "DOP853"),
            t_eval=time,
            rtol=1e-9,
            atol=1e-12 * self.start,
        )
        return found.y[1]

    def modal(self, count=60):
        """Fundamental velocity, frequency (rad/s) and damping ratio at rising amplitudes."""
        angle = np.pi * (np.arange(200) + 0.5) / 200

        def turns(_, state):
            return state[1]

        turns.terminal, turns.direction = True, 1.0
        rows = []
        for size in self.start * np.geomspace(0.005, 1.05, count):
            found = solve_ivp(
                lambda _, state: (state[1], -self.spring(state[0])),
                *((0, 20 / self.rest), (size, -1e-12 * size * self.rest)),
                events=turns,
                dense_output=True,
                rtol=1e-10,
                atol=1e-14 * size,
            )
            omega = np.pi / found.t_events[0][0]
            speed = -found.sol(angle / omega)[1]
            fundamental = 2 * np.mean(speed * np.sin(angle))
            lost = np.mean(self.damper(speed) * speed)
            rows.append((fundamental, omega, lost / fundamental**2 / omega))
        return np.array(rows).T


class Case(NamedTuple):
    """One record, what is in it, and the truth."""

    time: np.ndarray
    velocity: np.ndarray
    truth: np.ndarray
    rest: float
    close: bool
    words: str


def oscillator(rng, rest, start, *, plain=False):
    """A mode with a spring and a damping drawn by lot."""
    spring = "linear" if plain else rng.choice(["linear", "hardening", "softening"])
    strength = {
        "linear": 0.0,
        "hardening": rng.uniform(0.05, 0.8),
        "softening": -rng.uniform(0.05, 0.3),
    }[spring]
    ratio = np.exp(rng.uniform(np.log(0.001), np.log(0.02)))
    law = "viscous" if plain else rng.choice(["viscous", "grows", "shrinks"], p=[0.5, 0.25, 0.25])
    rate, speed = 2 * ratio * rest, rest * start
    quadratic = rng.uniform(0.3, 1.0) * rate / speed if law == "grows" else 0.0
    saturates = rng.uniform(0.3, 1.0) * rate if law == "shrinks" else 0.0
    viscous = rate * (0.6 if law != "viscous" else 1.0)
    return (
        Oscillator(
            *(rest, strength * (rest / start) ** 2, viscous, quadratic, saturates),
            *(speed * rng.uniform(0.3, 1.0), start),
        ),
        f"{spring} {law} {100 * ratio:.2g} %",
    )


def case(seed, number):
    """A record drawn by lot."""
    rng = np.random.default_rng([seed, number])
    rest = HERTZ * np.exp(rng.uniform(np.log(20), np.log(120)))
    mode, words = oscillator(rng, rest, 1e-3)
    truth = mode.modal()
    ratio = float(np.interp(0.5 * truth[0, -1], truth[0], truth[2]))
    fall = rng.uniform(1.5, 4.0)
    cycles = float(np.clip(fall / (HERTZ * ratio), 40, 400))
    time = np.arange(0, cycles * HERTZ / rest, HERTZ / (rng.uniform(30, 45) * rest))
    motion = mode.decay(time)
    close = number % _CLOSE_EVERY == 0
    count = rng.integers(1, 3) if close else rng.integers(0, 3)
    energy = np.exp(rng.uniform(np.log(0.02), np.log(0.4)))
    low, high = truth[1].min(), truth[1].max()
    fractions = energy * rng.dirichlet(np.ones(count)) if count else []
    total = motion.copy()
    for k, fraction in enumerate(fractions):
        while True:
            times = np.exp(rng.uniform(np.log(0.3), np.log(6.0)))
            if close and k == 0:
                # Of the frequency that the mode has at half its amplitude.
                middle = np.interp(0.5 * truth[0, -1], truth[0], truth[1]) / rest
                times = middle * (1 + rng.choice([-1, 1]) * rng.uniform(0.05, 0.15))
                break
            if not low * (1 - _AWAY) < times * rest < high * (1 + _AWAY):
                break
        size = truth[0, -1] * np.sqrt(fraction / (1 - energy)) / (times * rest)
        other, named = oscillator(rng, times * rest, size, plain=rng.random() < 0.5)
        total += other.decay(time)
        words += f" + {times:.2f} ({100 * fraction:.2g} %, {named})"
    largest = np.abs(motion).max()
    noise = np.exp(rng.uniform(np.log(0.001), np.log(0.03)))
    hum = rng.uniform(0, 0.02)
    total += largest * noise * rng.standard_normal(len(time))
    total += largest * hum * np.cos(HERTZ * 50 * time + rng.uniform(0, HERTZ))
    total += largest * rng.uniform(-0.05, 0.05)
    words += f"; {rest / HERTZ:.1f} Hz, {cycles:.0f} cycles, noise {noise:.2%}, hum {hum:.2%}"
    return Case(time, total, truth, rest * (1 + 0.01 * rng.standard_normal()), close, words)


def scored(result, truth):
    """Relative errors of frequency and damping over 1σ and by themselves, where truth reaches."""
    at = np.asarray(result.velocity)
    kept = result.has_result & (at > truth[0, 0]) & (at < truth[0, -1])
    rows = []
    for row, found, std in (
        (1, result.natural_frequency, result.natural_frequency_std),
        (2, result.damping_ratio, result.damping_ratio_std),
    ):
        true = CubicSpline(truth[0], truth[row])(at[kept])
        away = np.asarray(found)[kept] / true - 1
        rows += [np.abs(away) * true / np.asarray(std)[kept], np.abs(away)]
    return np.array(rows)


def main() -> None:
    """Print a line for every method."""
    given = options(__doc__, seed=1, count=60, show=False, method=METHODS)
    rows = {name: [] for name in given.method}
    refused = {name: {True: 0, False: 0} for name in given.method}
    closes = 0
    for number in range(given.count):
        one = case(given.seed, number)
        closes += one.close
        modes = sj.model.linear_modes([one.rest], [0.005], [[1.0]], [1.0], sensors=("tip",))
        rate = 1 / (one.time[1] - one.time[0])
        record = time_recording(one.velocity[None], [Channel("tip", "velocity")], rate, name="test")
        if given.show:
            print(number, "close" if one.close else "", one.words)
        for name in given.method:
            try:
                found = run_record_method(name, [recorded_test(record, modes)], modes)
                result, why = found.result, found.reason
            except InputError as error:
                result, why = None, str(error)
            if result is None or not result.has_result.any():
                refused[name][one.close] += 1
                if given.show:
                    print("   ", name, "refused:", why or "no point")
                continue
            found = scored(result, one.truth)
            rows[name].append(found)
            if given.show:
                fraction = [np.mean(found[k] < 1.96) for k in (0, 2)]
                print(
                    f"    {name}: {found.shape[1]} points, "
                    f"inside {fraction[0]:.2f} {fraction[1]:.2f}, "
                    f"errors {np.median(found[1]):.1e} {np.median(found[3]):.1e}, worst score "
                    f"{found[0].max():.1f} {found[2].max():.1f}"
                )
    for name, found in rows.items():
        every = np.concatenate([*found, np.zeros((4, 0))], axis=1)
        banded = np.isfinite(every[0]).any()
        tell(
            seed=given.seed,
            records=given.count,
            close=closes,
            method=name,
            frequency_coverage=float(np.mean(every[0] < 1.96)) if banded else None,
            damping_coverage=float(np.mean(every[2] < 1.96)) if banded else None,
            frequency_error_median=float(np.median(every[1])),
            frequency_error_90=float(np.quantile(every[1], 0.9)),
            damping_error_median=float(np.median(every[3])),
            damping_error_90=float(np.quantile(every[3], 0.9)),
            points=every.shape[1],
            answered=len(found),
            refused_close=refused[name][True],
            refused_wrongly=refused[name][False],
        )


if __name__ == "__main__":
    main()
