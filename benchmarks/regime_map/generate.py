"""Blind sets all over the regime: one mode, at most one law, any shift, damping and level errors.

    python benchmarks/regime_map/generate.py --out DIR [--count 300] [--seed 0] [--jobs 1]

Writes DIR/sets/NAME.csv and NAME.toml (formats: CONTRACT.md) and DIR/keys/NAME.json with the truth:
law and parameters, shift of the resonance at the top level in half-power bandwidths ("share"; of
damping laws the added over the linear damping), exact backbone, and the resonance of one further
level that was not measured. Physics by `oscillator.py`; nothing is shared with the package under
test. Laws take turns, each through its decades of shift; seed and number of a set decide it.

A level's frequency error is of the linear stiffness, its gain and phase errors are of the recorded
velocity. `chi_squared` is what a linear mode leaves of the set without noise, with all errors of
the test and of the linear model in the covariance: below 15 the law cannot be seen.
"""

import json
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from oscillator import LAWS, STIFFNESS, Law, States, backbone, solved

sys.path.append(str(Path(__file__).resolve().parents[1]))
from harness import options

_HARDEST, _LEAST_DAMPING, _MOST_DAMPING = 0.45, 2e-4, 0.05
_FARTHEST = {"cubic_softening": -0.25, "quadratic": -0.12, "iwan": -0.10, "stop": 0.25}
_MOST_BANDWIDTHS = {"iwan": 30.0}  # beyond it its damping grows too large
_SIZES = {  # what levels may err by, and how often
    "frequency": ([0, 0.001, 0.005, 0.01], [0.35, 0.2, 0.25, 0.2]),
    "gain": ([0, 0.01, 0.05, 0.15], [0.35, 0.3, 0.2, 0.15]),
    "phase": (np.radians([0, 0.5, 3.0]), [0.4, 0.4, 0.2]),
}
_SEEN_FROM = 15.0


class Errors(NamedTuple):
    """1σ, relative or rad: of levels, of states, of the linear model; and what is stated."""

    levels: dict[str, float]
    levels_stated: bool = True
    noise: float = 0.0
    noise_stated: bool = True
    frequency: float = 0.0
    damping: float = 0.0
    mass: float = 0.0  # zero: exact, and nothing stated


class Test(NamedTuple):
    """All that was drawn in scaled units, and the states, level by level."""

    law: Law
    damping: float
    errors: Errors
    curve: States  # the backbone at many amplitudes
    level: np.ndarray  # of every state, from zero
    states: States
    off: dict[str, np.ndarray]  # errors of the levels; the last is the further level's
    plan: dict[str, str]
    further: States  # resonance of the further level as it would be recorded, and the nominal one


def drawn_fraction(name: str, turn: int, rng) -> float:
    """Signed shift in bandwidths, or added over linear damping, of a law's own decades in turn."""
    if name == "none":
        return 0.0
    farthest, turns, most = 0.0, 2, 10.0
    if name in _FARTHEST or name in STIFFNESS:
        farthest = _FARTHEST.get(name, _HARDEST)
        most = abs(farthest) / (2.1 * _LEAST_DAMPING)
        most = min(1000.0, _MOST_BANDWIDTHS.get(name, most), most)
        turns = int(np.ceil(np.log10(most) + 1))
    lowest = 10.0 ** (turn % turns - 1)
    size = float(np.exp(rng.uniform(*np.log([lowest, min(10 * lowest, most)]))))
    return -size if farthest < 0 else size


def _drawn_damping(name: str, fraction: float, rng) -> float:
    most = _MOST_DAMPING
    if name in _FARTHEST or name in STIFFNESS:
        most = min(most, abs(_FARTHEST.get(name, _HARDEST)) / (2 * abs(fraction)))
    elif name != "none":
        most = min(most, 0.06 / (1 + fraction))
    return float(np.exp(rng.uniform(*np.log([_LEAST_DAMPING, most]))))


def drawn_law(name: str, fraction: float, damping: float, rng) -> Law:
    """The law that shifts the resonance at unit amplitude by as many bandwidths, or damps so."""
    wanted = fraction * 2 * damping
    if name in ("none", "coulomb", "quadratic_damping"):
        unit = {"none": 0.0, "coulomb": np.pi / 4, "quadratic_damping": 3 * np.pi / 8}
        return Law(name, wanted * unit[name])
    shapes = {"gap": (0.2, 0.7), "stop": (0.2, 0.6), "iwan": (1.2, 2.2)}
    law = Law(name, 0.0, float(rng.uniform(*shapes.get(name, (0.0, 0.0)))))
    strength, power = abs(wanted), 0.9
    if name == "quadratic":
        strength, power = strength**0.5, 0.5
    for _ in range(40):
        law = law._replace(strength=float(strength))
        shift = backbone(law, damping, [1.0]).w[0] - 1
        ratio = min(max(wanted / shift, 0.3), 3) if shift * wanted > 0 else 0.5
        if abs(ratio - 1) < 1e-6:
            return law
        strength *= ratio**power
    raise ArithmeticError(f"no {name} shifts by {wanted:.3g}")


def drawn_errors(rng) -> Errors:
    """Errors of levels, of states and of the linear test."""

    def log(low: float, high: float) -> float:
        return float(np.exp(rng.uniform(np.log(low), np.log(high))))

    levels = {name: float(rng.choice(*given[:1], p=given[1])) for name, given in _SIZES.items()}
    mass = log(0.005, 0.05) if rng.random() < 0.5 else 0.0
    stated = bool(rng.random() < 0.6), bool(rng.random() < 0.75)
    return Errors(levels, stated[0], log(5e-4, 1e-2), stated[1], log(1e-3, 1e-2),
                  float(rng.uniform(0.1, 0.3)), mass)  # fmt: skip


def guessed(curve: States, force, phase, stiffness) -> States:
    """States at phases, from frequency and damping of the backbone at the same amplitude."""
    grid = np.log(curve.amplitude)
    a = np.geomspace(curve.amplitude[0], curve.amplitude[-1], 1500)
    squared = np.interp(np.log(a), grid, curve.w**2)
    damping = np.interp(np.log(a), grid, curve.force / (curve.amplitude * curve.w))
    tangent = np.tan(phase)[:, None] * damping / 2
    w = np.sqrt(np.maximum(squared + stiffness[:, None] - 1 + tangent**2, 0)) - tangent
    lacking = damping * w * a - (force * np.cos(phase))[:, None]
    rows, k = np.arange(len(phase)), np.maximum(np.argmax(lacking > 0, axis=1), 1)
    there = (lacking[:, 0] <= 0) & (lacking[rows, k] > 0)
    fraction = np.where(there, lacking[rows, k - 1] / (lacking[rows, k - 1] - lacking[rows, k]), 0)
    amplitude = a[k - 1] + fraction * (a[k] - a[k - 1])
    now = w[rows, k - 1] + fraction * (w[rows, k] - w[rows, k - 1])
    scaled = (curve.coefficients / curve.amplitude[:, None]).T
    x = np.stack([np.interp(np.log(amplitude), grid, row) for row in scaled], axis=1)
    return States(x * amplitude[:, None], now, force, phase, 0 * phase, there)


def stepped(curve: States, force: float, stiffness: float, plan: dict, upward: bool, rng):
    """Phases that a stepped sine upwards or downwards would meet, 8 to 40 of them, or none."""
    phase = np.radians(np.arange(75, -75.01, -0.25))
    if not upward:
        phase = phase[::-1]
    states = guessed(curve, np.full(len(phase), force), phase, np.full(len(phase), stiffness))
    w = states.w if upward else -states.w
    kept: list[int] = []
    margin, before_fold = int(rng.uniform(2, 40)), False  # in quarters of a degree
    farthest = -np.inf
    for i in np.flatnonzero(states.good):
        if w[i] > farthest:
            kept.append(i)
            farthest, before_fold = w[i], True
        elif before_fold:  # a jump: the last states before it are too near to be held
            del kept[max(len(kept) - margin, 0) :]
            before_fold = False
    if plan["side"] != "both":
        kept = [i for i in kept if (phase[i] > 0) == (plan["side"] == "below")]
    if len(kept) < 80:  # 20° of phase
        return np.zeros(0)
    place = w[kept] if plan["spacing"] == "frequency" else phase[kept]
    wanted = np.linspace(place[0], place[-1], int(rng.integers(8, 41)))
    chosen = np.unique(np.abs(place[:, None] - wanted).argmin(0))
    return phase[np.array(kept)[chosen]] if len(chosen) >= 8 else np.zeros(0)


def _drawn_forces(law: Law, damping: float, rng) -> np.ndarray:
    """Rising forces of one to eight levels, the last for unit amplitude."""
    top = backbone(law, damping, [1.0]).force[0]
    n, lowest = int(rng.integers(1, 9)), float(np.exp(rng.uniform(*np.log([0.03, 0.5]))))
    steps = np.linspace(0, 1, n) if n > 1 else np.ones(1)
    steps[1:-1] += rng.uniform(-0.15, 0.15, max(n - 2, 0)) / n
    if law.name != "coulomb":
        return top * lowest ** (1 - steps)
    # In amplitude, so that it always moves, and without sticking.
    lowest = min(0.8, max(0.1 + lowest, 6 * law.strength))
    return top - 2 * damping * (1 - lowest ** (1 - steps))


def drawn_test(rng, name: str, fraction: float, errors: Errors | None = None) -> Test:
    """Law, plan, errors and exact states; ArithmeticError where they do not go together."""
    damping = _drawn_damping(name, fraction, rng)
    law = drawn_law(name, fraction, damping, rng)
    forces, errors = _drawn_forces(law, damping, rng), errors or drawn_errors(rng)
    n = len(forces)
    off = {key: rng.normal(size=n + 1) * size for key, size in errors.levels.items()}
    stiffness = (1 + off["frequency"]) ** 2
    where = "beyond" if n == 1 or rng.random() < 0.5 else "between"
    if name in ("cubic_softening", "quadratic") and where == "beyond":
        where = "between" if n > 1 else "below"
    k = int(rng.integers(0, max(n - 1, 1)))
    extra = {"beyond": 1.3 * forces[-1], "below": 0.7 * forces[0],
             "between": float(np.sqrt(forces[k] * forces[min(k + 1, n - 1)]))}[where]  # fmt: skip
    ends = 0.15 * forces[0] / forces[-1], 1.7 if where == "beyond" else 1.06
    if name == "coulomb":
        free = (extra - 4 / np.pi * law.strength) / (2 * damping)
        ends = law.strength / 0.3, 1.1 * max(1, free)
    curve = backbone(law, damping, np.geomspace(*ends, 60), steps=12)
    if not curve.good.all():
        raise ArithmeticError("no backbone")
    side = str(rng.choice(["both", "below", "above"], p=[0.7, 0.15, 0.15]))
    plan = {"side": side, "spacing": str(rng.choice(["phase", "frequency"])), "where": where}
    # Mostly the direction that meets the large amplitudes.
    upward = (curve.w[-1] >= 1) == (rng.random() < 0.8)
    plan["direction"] = "up" if upward else "down"
    phases = [stepped(curve, force, stiffness[k], plan, upward, rng)
              for k, force in enumerate(forces)]  # fmt: skip
    level = np.repeat(np.arange(n), [len(p) for p in phases])
    phase = np.concatenate(phases)
    start = guessed(curve, forces[level], phase, stiffness[level])
    states = solved(law, damping, stiffness[level], phase, start, "force")
    near = np.abs(states.amplitude / start.amplitude - 1) < 0.3
    keep = states.good & near & (states.slope < 0)
    if np.bincount(level[keep], minlength=n).min() < 5:
        raise ArithmeticError("a level without states")
    pair = np.array([stiffness[n], 1.0])
    recorded = np.array([-off["phase"][n], 0.0])
    start = guessed(curve, np.full(2, extra), recorded, pair)
    further = solved(law, damping, pair, recorded, start, "force")
    if not (further.good & start.good).all():
        raise ArithmeticError("no further level")
    return Test(law, damping, errors, curve, level[keep], states.of(keep), off, plan, further)


def chi_squared(test: Test) -> float:
    """What a linear mode leaves of the closed-form points without noise, errors in covariance."""
    s, e, n = test.states, test.errors, len(test.states.w)
    z = s.force / s.amplitude * (np.sin(s.phase) + 1j * np.cos(s.phase))
    # Its own level's error is no part of the signal.
    linear = (1 + test.off["frequency"][test.level]) ** 2
    residual = np.concatenate([z.real + s.w**2 - linear, z.imag / s.w - 2 * test.damping])

    def moved(dz):
        return np.concatenate([dz.real, dz.imag / s.w])

    frequency, rest = moved(np.full(n, 2.0 + 0j)), np.zeros(n)
    shared = [e.frequency * frequency, e.mass * moved(z),
              2 * test.damping * e.damping * np.concatenate([rest, rest + 1])]  # fmt: skip
    for k in np.unique(test.level):
        own = np.tile(test.level == k, 2)
        units = {"frequency": frequency, "gain": moved(z), "phase": moved(1j * z)}
        shared += [e.levels[name] * unit * own for name, unit in units.items()]
    covariance = sum(np.outer(v, v) for v in shared)
    for v in (moved(e.noise * z), moved(1j * e.noise * z)):
        covariance = covariance + np.outer(v, v) * np.tile(np.eye(n), (2, 2))
    scale = 1 / np.sqrt(np.diag(covariance))
    whitened = np.linalg.solve(covariance * scale[:, None] * scale, scale * residual)
    return float((scale * residual) @ whitened)


def _effect(law: Law, omega: float, unit: float) -> tuple[list[str], dict[str, float]]:
    """The effect and its parameters in modal units; `unit` is that of q, kg^1/2 m."""
    s, square = law.strength, omega**2
    gap = {"stiffness": s * square, "gap": law.shape * unit}
    quadratic = {"coefficient": s * square / unit, "cubic": 0.1 * s**2 * square / unit**2}
    return {
        "none": ([], {}),
        "cubic_hardening": (["cubic_stiffness"], {"coefficient": s * square / unit**2}),
        "cubic_softening": (["cubic_stiffness"], {"coefficient": -s * square / unit**2}),
        "quadratic": (["quadratic_stiffness"], quadratic),
        "quintic": (["quintic_stiffness"], {"coefficient": s * square / unit**4}),
        "gap": (["gap_stiffness"], gap),
        "stop": (["one_sided_stop"], gap),
        "coulomb": (["coulomb_friction"], {"force": s * square * unit}),
        "iwan": (["iwan_microslip"], {"coefficient": s * square * unit ** (1 - law.shape),
                                      "exponent": law.shape}),
        "quadratic_damping": (["quadratic_damping"], {"coefficient": s / unit}),
    }[law.name]  # fmt: skip


def written_set(folder: Path, name: str, law: str, turn: int, seed: tuple[int, int]) -> int:
    """Draw and write one set; returns how often it was drawn."""
    fraction = drawn_fraction(law, turn, np.random.default_rng(seed))
    for attempt in range(80):
        rng = np.random.default_rng((*seed, attempt))
        try:
            test = drawn_test(rng, law, fraction)
        except (ArithmeticError, np.linalg.LinAlgError):
            continue
        _write(folder, name, test, fraction, rng)
        return attempt + 1
    raise RuntimeError(f"{name}: no {law} with a shift of {fraction:.3g} could be drawn")


def _write(folder: Path, name: str, test: Test, fraction: float, rng) -> None:
    e, s, off, level = test.errors, test.states, test.off, test.level
    hz, mass, top = np.exp(rng.uniform(*np.log([(20, 0.05, 3e-3), (400, 20, 1.0)])))
    omega = 2 * np.pi * hz
    size = top / omega  # m of unit displacement
    newton = mass * omega**2 * size
    exact = omega * size * s.w * s.amplitude * np.exp(1j * s.phase)
    random = e.noise * rng.normal(size=(2, len(s.w)))
    velocity = exact * (1 + off["gain"][level]) * (1 + random[0])
    velocity = velocity * np.exp(1j * (off["phase"][level] + random[1]))
    columns = {"level": level + 1, "frequency_hz": hz * s.w, "force_n": newton * s.force,
               "velocity_re_m_s": velocity.real, "velocity_im_m_s": velocity.imag}  # fmt: skip
    if e.noise_stated:
        columns["velocity_std_m_s"] = e.noise * np.abs(velocity)
        columns["phase_std_deg"] = np.full(len(s.w), np.degrees(e.noise))
    rows = [",".join(columns)]
    rows += [",".join(f"{v:.11g}" for v in row) for row in zip(*columns.values(), strict=True)]
    (folder / "sets" / f"{name}.csv").write_text("\n".join(rows) + "\n", encoding="utf-8")
    wrong = np.clip(rng.normal(size=3), -2.5, 2.5)
    shape = 1 / np.sqrt(mass * (1 + e.mass * wrong[2]))
    lines = ['name = "one mode"', "[[mode]]"]
    lines += [f"frequency_hz = {hz * (1 + e.frequency * wrong[0]):.12g}"]
    lines += [f"damping_ratio = {test.damping * (1 + e.damping * wrong[1]):.9g}"]
    lines += [f"shape = {{ sensor = {shape:.9g} }}", f"participation = {shape:.9g}"]
    lines += [f"frequency_std_hz = {e.frequency * hz:.6g}"]
    lines += [f"damping_ratio_std = {e.damping * test.damping:.6g}"]
    lines += [f"modal_mass_std = {e.mass:.6g}"] * (e.mass > 0)
    if e.levels_stated and any(e.levels.values()):
        lines += ["[measurement]", f"level_gain_std = {e.levels['gain']:.6g}",
                  f"level_phase_std_deg = {np.degrees(e.levels['phase']):.6g}",
                  f"level_frequency_std_hz = {e.levels['frequency'] * hz:.6g}"]  # fmt: skip
    (folder / "sets" / f"{name}.toml").write_text("\n".join(lines) + "\n", encoding="utf-8")

    def points(b: States) -> dict[str, Any]:
        return {"displacement_m": (size * b.amplitude).tolist(),
                "velocity_m_s": (omega * size * b.w * b.amplitude).tolist(),
                "force_n": (newton * b.force).tolist(), "frequency_hz": (hz * b.w).tolist(),
                "damping_ratio": (b.force / (2 * b.amplitude * b.w**2)).tolist()}  # fmt: skip

    low, high = np.quantile(s.amplitude, [0.05, 1.0])
    further, nominal = test.further.of(slice(0, 1)), test.further.of(slice(1, 2))
    at_top = backbone(test.law, test.damping, [1.0]).w[0]
    kinds, parameters = _effect(test.law, omega, size * np.sqrt(mass))
    chi = chi_squared(test)
    key = {
        "name": name, "law": test.law.name, "kinds": kinds, "parameters": parameters,
        "share": abs(fraction), "shift_bandwidths": abs(at_top - 1) / (2 * test.damping),
        "damping_ratio": test.damping, "frequency_hz": hz, "modal_mass_kg": mass,
        "levels": int(level.max()) + 1, "states": len(s.w), **test.plan,
        "errors": e.levels, "errors_stated": e.levels_stated and any(e.levels.values()),
        "noise": e.noise, "noise_stated": e.noise_stated, "mass_std": e.mass or None,
        "prior": {"frequency": e.frequency, "damping": e.damping},
        "level_errors": {key: value[:-1].tolist() for key, value in off.items()},
        "chi_squared": chi, "detectable": chi >= _SEEN_FROM,
        "backbone": points(backbone(test.law, test.damping, np.geomspace(low, high, 5))),
        "curve": points(test.curve),
        "extra_level": points(nominal) | {
            "force_n": newton * float(further.force[0]), "where": test.plan["where"],
            "recorded_frequency_hz": hz * float(further.w[0]),
            "recorded_velocity_m_s": points(further)["velocity_m_s"][0] * (1 + off["gain"][-1]),
            "errors": {key: float(value[-1]) for key, value in off.items()},
        },
        "true_velocity": np.stack([exact.real, exact.imag], 1).tolist(),
    }  # fmt: skip
    (folder / "keys" / f"{name}.json").write_text(json.dumps(key), encoding="utf-8")


def main() -> None:
    """Draw and write all sets."""
    chosen = options(__doc__, out=Path, count=300, seed=0, jobs=1)
    begin = time.perf_counter()
    for part in ("sets", "keys"):
        (chosen.out / part).mkdir(parents=True, exist_ok=True)
    given = [(chosen.out, f"set{k:04d}", LAWS[k % len(LAWS)], k // len(LAWS), (chosen.seed, k))
             for k in range(chosen.count)]  # fmt: skip
    with ProcessPoolExecutor(chosen.jobs) as pool:
        drawn = list(pool.map(written_set, *zip(*given, strict=True)))
    seconds = round(time.perf_counter() - begin, 1)
    print(json.dumps({"sets": len(drawn), "drawn": sum(drawn), "seconds": seconds}))


if __name__ == "__main__":
    main()
