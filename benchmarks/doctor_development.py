"""Development sets of the import doctor: time-integrated tests, each with one error, or with none.

`python benchmarks/doctor_development.py [--sets 40] [--seed 0]` prints one JSON line: how many
errors were found and named, and how many good sets raised an alarm. One oscillator (polynomial
stiffness, drag, friction, a gap) a set, its steady states by Runge-Kutta's classical rule from the
describing functions' guess on. The decision rules of `snrmjax.doctor` were tried on these sets:
other people's sets say how well they do.
"""

import argparse
import json
from typing import NamedTuple

import numpy as np

import snrmjax as sj

STEPS = 64  # of a cycle


class Oscillator(NamedTuple):
    """q̈ + 2ζωq̇ + ω²q + forces(q, q̇) = p F cos Ωt, seen as Φq̇."""

    omega: float
    zeta: float
    shape: float
    participation: float
    quadratic: float  # forces: of q², q³, |q̇|q̇ and q²q̇, friction, stiffness beyond a gap
    cubic: float
    drag: float
    nonlinear_damping: float
    friction: float
    smooth: float
    stop: float
    gap: float

    def acceleration(self, q, v, drive):
        """Of the modal coordinate, under a modal force."""
        force = self.quadratic * q**2 + self.cubic * q**3
        force = force + self.drag * np.abs(v) * v + self.nonlinear_damping * q**2 * v
        force = force + self.friction * np.tanh(v / self.smooth)
        force = force + self.stop * (np.maximum(q - self.gap, 0) - np.maximum(-q - self.gap, 0))
        return drive - force - self.omega**2 * q - 2 * self.zeta * self.omega * v

    def balance(self, q, omega):
        """Equivalent stiffness and damping at the displacement amplitude."""
        beta = 2 * np.pi * (np.arange(256) + 0.5) / 256
        q, omega = np.asarray(q)[..., None], np.asarray(omega)[..., None]
        x, v = q * np.cos(beta), -q * omega * np.sin(beta)
        own = -self.acceleration(x, v, 0.0)
        k = 2 * np.mean(own * np.cos(beta), axis=-1) / q[..., 0]
        d = -2 * np.mean(own * np.sin(beta), axis=-1) / (q * omega)[..., 0]
        return k, d


def oscillator(rng, tip=1.0):
    """A random structure; its nonlinear forces are sized at the displacement `tip`."""
    omega = 2 * np.pi * np.exp(rng.uniform(np.log(15), np.log(300)))
    zeta = np.exp(rng.uniform(np.log(0.003), np.log(0.04)))
    shape = np.exp(rng.uniform(np.log(0.3), np.log(20)))
    participation = shape * np.exp(rng.uniform(-1, 1)) if rng.random() < 0.6 else shape
    kind = rng.choice(["linear", "hard", "soft", "curved", "drag", "friction", "gap", "damped"])
    none = dict.fromkeys(Oscillator._fields[4:], 0.0) | {"smooth": 1.0, "gap": 1.0}
    tip = tip * 1e-4 * np.exp(rng.uniform(0, 3))
    size = np.exp(rng.uniform(np.log(0.02), np.log(0.5)))  # relative change of stiffness
    k = omega**2
    if kind in ("hard", "soft"):
        sign = 1 if kind == "hard" else -0.4
        none["cubic"] = sign * size * k / tip**2
    elif kind == "curved":
        none["cubic"] = size * k / tip**2
        none["quadratic"] = np.sqrt(0.8 * size) * k / tip
    elif kind == "drag":
        none["drag"] = 2 * zeta * omega * rng.uniform(0.3, 3) / (tip * omega)
    elif kind == "damped":
        none["nonlinear_damping"] = 2 * zeta * omega * rng.uniform(1, 8) / tip**2
    elif kind == "friction":
        none["friction"] = rng.uniform(0.1, 0.5) * 2 * zeta * omega * tip * omega * 0.25
        none["smooth"] = 0.02 * tip * omega
    elif kind == "gap":
        none["stop"], none["gap"] = size * 2 * k, 0.4 * tip
    return Oscillator(omega, zeta, shape, participation, **none), tip, str(kind)


def guesses(one, tip, levels, phases):
    """Level, F, Ω, displacement and phase by describing functions, a force a level."""
    columns = []
    for level, top in enumerate(levels):
        top = top * tip
        w = np.sqrt(one.balance(top, one.omega)[0])
        force = float(top * w * one.balance(top, w)[1])  # modal force
        phase = np.asarray(phases(level))
        low, high = np.full(len(phase), 1e-6 * top), np.full(len(phase), 1.5 * top)
        w_at = np.full(len(phase), float(w))
        for _ in range(60):
            x = 0.5 * (low + high)
            k, d = one.balance(x, w_at)
            half = 0.5 * d * np.tan(phase)
            w_at = np.sqrt(np.maximum(k + half**2, 1e-6 * k)) - half
            above = d * w_at * x > force * np.cos(phase)
            low, high = np.where(above, low, x), np.where(above, x, high)
        same = np.ones(len(phase))
        columns.append((level * same.astype(int), force / one.participation * same, w_at, x, phase))
    return tuple(np.concatenate(c) for c in zip(*columns, strict=True))


def settled(one, force, omega, x, phase, cycles):
    """Velocity phasors of orders 1 to 3 after so many cycles, and whether they had settled."""
    q, v = x * np.cos(phase - np.pi / 2), -x * omega * np.sin(phase - np.pi / 2)
    drive, h = one.participation * force, 2 * np.pi / omega / STEPS
    cosines = np.cos(2 * np.pi * np.arange(2 * STEPS) / (2 * STEPS))
    last = []
    for cycle in range(cycles):
        keep = cycle >= cycles - 2
        if keep:
            waves = np.zeros((3, len(q)), dtype=complex)
        for n in range(STEPS):
            if keep:
                for k in (1, 2, 3):
                    waves[k - 1] += v * np.exp(-2j * np.pi * k * n / STEPS)
            f0, f1, f2 = (drive * cosines[(2 * n + j) % (2 * STEPS)] for j in range(3))
            a1 = one.acceleration(q, v, f0)
            a2 = one.acceleration(q + 0.5 * h * v, v + 0.5 * h * a1, f1)
            v2 = v + 0.5 * h * a1
            v3 = v + 0.5 * h * a2
            a3 = one.acceleration(q + 0.5 * h * v2, v3, f1)
            v4 = v + h * a3
            a4 = one.acceleration(q + h * v3, v4, f2)
            q = q + h / 6 * (v + 2 * v2 + 2 * v3 + v4)
            v = v + h / 6 * (a1 + 2 * a2 + 2 * a3 + a4)
        if keep:
            last.append(waves * 2 / STEPS * one.shape)
    still = np.abs(last[1][0] - last[0][0]) < 2e-4 * np.abs(last[1][0])
    return last[1], still


class Test(NamedTuple):
    """A virtual test before anything goes wrong with it."""

    one: Oscillator
    level: np.ndarray
    omega: np.ndarray
    force: np.ndarray
    velocity: np.ndarray  # orders 1 to 3
    noise: dict
    stated: bool
    keep: bool  # harmonics
    kind: str
    mass_std: float


def good_test(rng, one=None, tip=None, kind="", force_levels=True):
    """States of a random structure, and the errors of the instruments."""
    if one is None:
        one, tip, kind = oscillator(rng)
    n = int(rng.integers(2, 6))
    levels = np.geomspace(rng.uniform(0.1, 0.4), 1.0, n)
    if rng.random() < 0.5:  # a few states near resonance
        per, widest = int(rng.integers(5, 9)), np.radians(rng.uniform(40, 65))
        grid = np.linspace(-widest, widest, per)
    else:
        per, widest = int(rng.integers(11, 26)), np.radians(rng.uniform(65, 80))
        t = np.linspace(-1, 1, per)
        grid = np.arctan(t * np.tan(widest)) if rng.random() < 0.5 else t * widest
    grid = grid[::-1]  # rising frequency
    level, force, omega, x, phase = guesses(one, tip, levels, lambda _: grid)
    cycles = int(np.clip(1.3 / one.zeta, 60, 300))
    velocity, still = settled(one, force, omega, x, phase, cycles)
    turned = np.abs(np.angle(velocity[0] * np.exp(-1j * phase))) < np.radians(25)
    keep = still & turned
    noise = {
        "velocity": rng.choice([0.002, 0.005, 0.01, 0.02]),
        "phase": np.radians(rng.choice([0.2, 0.5, 1.0])),
        "force": rng.choice([0.0, 0.003, 0.01]),
        "gain": rng.choice([0.0, 0.005, 0.01]),
        "turn": np.radians(rng.choice([0.0, 0.5])),
    }
    return Test(
        *(one, level[keep], omega[keep], force[keep], velocity[:, keep], noise),
        *(bool(rng.random() < 0.7), bool(rng.random() < 0.5), kind, 0.0),
    )


def recorded(rng, test):
    """Level, Ω, F, V with random errors, and harmonics."""
    n = len(test.level)
    no = test.noise
    gain = (no["gain"] * rng.normal(size=9))[test.level]
    turn = (no["turn"] * rng.normal(size=9))[test.level]
    own = np.exp(
        gain
        + 1j * turn
        + no["velocity"] * rng.normal(size=n)
        + 1j * no["phase"] * rng.normal(size=n)
    )
    velocity = test.velocity[0] * own
    floor = 2e-4 * np.abs(velocity).max()
    higher = test.velocity[1:] * own + floor / np.sqrt(2) * (
        rng.normal(size=(2, n)) + 1j * rng.normal(size=(2, n))
    )
    force = test.force * (1 + no["force"] * rng.normal(size=n))
    return test.level, test.omega, force, velocity, higher, floor


def table(test, level, omega, force, velocity, higher, floor, order=None):
    """What was recorded as a table of steady states."""
    n = len(level)
    no = test.noise
    more = {}
    if test.stated:
        more |= {"velocity_std": no["velocity"] * np.abs(velocity)}
        more |= {"phase_std": np.full((n, 1), no["phase"])}
        if no["force"]:
            more["force_std"] = no["force"] * force
    if test.keep:
        more |= {"harmonics": higher.T[:, None, :], "harmonic_order": (2, 3)}
        more |= {"harmonic_std": np.full((n, 1), floor)}
    return sj.measure.steady_states(
        level + 1,
        omega,
        force,
        velocity,
        order=np.linspace(0, 1, n) if order is None else order,
        sensors=("tip",),
        **more,
    )


def model_of(rng, test, shape=1.0):
    """The linear model of a test; `shape` scales its mode shape wrongly."""
    one = test.one
    modes = sj.model.linear_modes(
        [one.omega],
        [one.zeta],
        [[one.shape * shape]],
        [one.participation],
        sensors=("tip",),
        std=sj.model.LinearModesStd([3e-4 * one.omega], [0.05 * one.zeta]),
    )
    return sj.model.structure(
        modes,
        level_gain_std=float(test.noise["gain"]),
        level_phase_std=float(test.noise["turn"]),
    )


def wrap_degrees(velocity):
    """Phases in degrees taken for radians."""
    return np.abs(velocity) * np.exp(1j * np.degrees(np.angle(velocity)))


def radians_as_degrees(velocity):
    """Phases in radians taken for degrees."""
    return np.abs(velocity) * np.exp(1j * np.radians(np.angle(velocity)))


def clipped_phasor(velocity, limit):
    """First and third harmonic of a sine cut off at a limit."""
    a = np.abs(velocity)
    s = np.minimum(limit / a, 1.0)
    first = a * (2 / np.pi) * (np.arcsin(s) + s * np.sqrt(1 - s**2))
    beta = 2 * np.pi * np.arange(512) / 512
    wave = np.clip(a[:, None] * np.cos(beta), -limit, limit)
    third = 2 * np.mean(wave * np.cos(3 * beta), axis=1)
    unit = velocity / a
    return first * unit, third * unit**3


def broken(rng, kind):
    """A set with one error: its data and model, and a word on it."""
    test = good_test(rng)
    shape, order, detail = 1.0, None, ""
    level, omega, force, velocity, higher, floor = recorded(rng, test)
    h1 = 1j * omega
    if kind == "conjugated_response":
        velocity, higher = velocity.conj(), higher.conj()
    elif kind == "acceleration_as_velocity":
        velocity, higher = h1 * velocity, higher * h1 * np.array([[2], [3]])
    elif kind == "displacement_as_velocity":
        velocity, higher = velocity / h1, higher / (h1 * np.array([[2], [3]]))
    elif kind == "volts_as_force":
        gain = np.exp(rng.uniform(np.log(1.7), np.log(50))) ** rng.choice([-1, 1])
        nominal = test.force
        force, detail = nominal * gain, f"{gain:.3g}"
    elif kind == "rms_for_peak":
        if rng.random() < 0.5:
            force, detail = force / np.sqrt(2), "force"
        else:
            velocity, higher, detail = velocity / np.sqrt(2), higher / np.sqrt(2), "velocity"
            floor /= np.sqrt(2)
    elif kind == "degrees_for_radians":
        way = rng.random() < 0.5
        velocity, detail = (wrap_degrees, radians_as_degrees)[way](velocity), str(way)
    elif kind == "clipped_channel":
        limit = np.abs(velocity).max() * rng.uniform(0.45, 0.75)
        first, third = clipped_phasor(velocity, limit)
        higher[1] += third
        velocity, detail = first, f"{limit / np.abs(test.velocity[0]).max():.2f}"
    elif kind == "unsettled_steps":
        share = rng.uniform(0.35, 0.75)
        detail = f"{share:.2f}"
        for k in np.unique(level):
            rows = np.flatnonzero(level == k)
            now = 0.0
            for row in rows:
                dwell = -np.log(share) / (test.one.zeta * test.one.omega)
                lam = share * np.exp(1j * (test.one.omega - omega[row]) * dwell * rng.choice([1]))
                now = velocity[row] + lam * (now - velocity[row])
                velocity[row] = now
    elif kind == "force_dropout":
        depth = rng.uniform(0.55, 0.9)
        drop = 1 - depth * np.maximum(np.cos(np.angle(test.velocity[0])), 0) ** 2
        force, velocity = force * drop, velocity * drop  # a linear structure's
        detail = f"{depth:.2f}"
    elif kind == "force_harmonics":
        ratio = rng.uniform(0.05, 0.3)
        k = rng.choice([2, 3])
        w = k * omega
        mobility = 1j * w / (test.one.omega**2 - w**2 + 2j * test.one.zeta * test.one.omega * w)
        turn = np.exp(1j * rng.uniform(0, 2 * np.pi))
        higher[k - 2] += mobility * ratio * turn * force * test.one.shape * test.one.participation
        test = test._replace(keep=True)
        detail = f"{k}: {ratio:.2f}"
    elif kind == "drift":
        along = np.linspace(-0.5, 0.5, len(level))
        if rng.random() < 0.5:
            size = rng.uniform(0.5, 4) * test.one.zeta * rng.choice([-1, 1])
            omega, detail = omega * (1 + size * along), f"frequency {size:.4f}"
        else:
            size = rng.uniform(0.08, 0.4) * rng.choice([-1, 1])
            velocity, detail = velocity * (1 + size * along), f"gain {size:.3f}"
    elif kind == "different_structures":
        which = np.unique(level)[-1:] if rng.random() < 0.5 else np.unique(level)[:1]
        rows = np.isin(level, which)
        size = rng.uniform(0.03, 0.2) * rng.choice([-1, 1])
        omega, detail = np.where(rows, omega * (1 + size), omega), f"{size:.3f}"
    elif kind == "shape_not_mass_normalised":
        shape = np.exp(rng.uniform(np.log(1.7), np.log(30))) ** rng.choice([-1, 1])
        if rng.random() < 0.4:
            shape = 1 / test.one.shape
        detail = f"{shape:.3g}"
    data = table(test, level, omega, force, velocity, higher, floor, order)
    return data, model_of(rng, test, shape), f"{test.kind} {detail}"


KINDS = (
    *("conjugated_response", "acceleration_as_velocity", "displacement_as_velocity"),
    *("volts_as_force", "rms_for_peak", "degrees_for_radians", "clipped_channel"),
    *("unsettled_steps", "force_dropout", "force_harmonics", "drift", "different_structures"),
    "shape_not_mass_normalised",
)


def main():
    """Score the doctor on sets of each kind and on good ones."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--sets", type=int, default=39)
    parser.add_argument("--good", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--kind", default="")
    parser.add_argument("--verbose", action="store_true")
    parser.add_argument("--no-model", action="store_true")
    settings = parser.parse_args()
    kinds = (settings.kind,) if settings.kind else KINDS
    found, named, alarms, wrong = 0, 0, 0, []
    for k in range(settings.sets):
        kind = kinds[k % len(kinds)]
        data, model, detail = broken(np.random.default_rng([settings.seed, k]), kind)
        given = None if settings.no_model else model
        said = [one.kind for one in sj.doctor.check_test(data, given).findings]
        found += bool(said)
        named += said == [kind]
        if said != [kind]:
            wrong.append((k, kind, detail, data.n_states, said))
    for k in range(settings.good):
        rng = np.random.default_rng([settings.seed, 10**6 + k])
        test = good_test(rng)
        data = table(test, *recorded(rng, test))
        given = None if settings.no_model else model_of(rng, test)
        said = sj.doctor.check_test(data, given).findings
        alarms += bool(said)
        if said:
            wrong.append((k, "good", test.kind, data.n_states, [one.kind for one in said]))
    if settings.verbose:
        for one in wrong:
            print(*one)
    print(
        json.dumps(
            {
                "sets": settings.sets,
                "found": found,
                "named": named,
                "good": settings.good,
                "false_alarms": alarms,
            }
        )
    )


if __name__ == "__main__":
    main()
