"""Blind sets of approximate truth: a library law with a second contribution that no library has.

    python benchmarks/approximate_truth/draw.py --out DIR [--count 60] [--seed 0]

Writes DIR/sets/NAME.csv and NAME.toml (formats: CONTRACT.md) and DIR/keys/NAME.json: the law, the
second contribution, and the fraction of the change of stiffness or damping that the law makes,
1 − s(second)/s(both) with s the standard deviation over the measured states. Exact harmonic balance
by `regime_map/oscillator.py`; nothing is shared with the package under test. The second
contribution makes 0, 10, 20, 30, 40, 50, 60 or 100 % of the change.
"""

import json
import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np

sys.path.append(str(Path(__file__).resolve().parents[1]))
sys.path.append(str(Path(__file__).resolve().parents[1] / "regime_map"))
from generate import guessed, stepped
from harness import options
from oscillator import States, backbone, solved

_STIFFNESS = ("cubic", "quintic", "gap")
_DAMPING = ("quadratic_damping", "cubic_damping")
_OTHERS = {True: ("tanh", "power_1.6", "bump", "hertz"), False: ("power_v_1.5", "local_film")}
_KINDS = {
    "cubic": "cubic_stiffness",
    "quintic": "quintic_stiffness",
    "gap": "gap_stiffness",
    "quadratic_damping": "quadratic_damping",
    "cubic_damping": "cubic_damping",
}
_FRACTIONS = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 1.0)
_NOISE, _SAMPLES = 2e-3, 400


def force_of(kind: str, y, v):
    """A force of unit strength, and its slopes by displacement and velocity."""
    zero, size = np.zeros_like(y), np.abs(y)
    sign = np.sign(y)
    if kind == "cubic":
        return y**3, 3 * y**2, zero
    if kind == "quintic":
        return y**5, 5 * y**4, zero
    if kind == "gap":
        return sign * np.maximum(size - 0.5, 0), (size > 0.5) * 1.0, zero
    if kind == "tanh":
        return np.tanh(y / 0.3) - y / 0.3, (1 / np.cosh(y / 0.3) ** 2 - 1) / 0.3, zero
    if kind == "power_1.6":
        return sign * size**1.6, 1.6 * size**0.6, zero
    if kind == "bump":
        shape = np.exp(-((y / 0.4) ** 2))
        return y * shape, shape * (1 - 2 * (y / 0.4) ** 2), zero
    if kind == "hertz":
        over = np.maximum(size - 0.25, 0)
        return sign * over**1.5, 1.5 * over**0.5, zero
    if kind == "quadratic_damping":
        return v * np.abs(v), zero, 2 * np.abs(v)
    if kind == "cubic_damping":
        return v**3, zero, 3 * v**2
    if kind == "power_v_1.5":
        return np.sign(v) * np.abs(v) ** 1.5, zero, 1.5 * np.abs(v) ** 0.5
    film = np.exp(-((y / 0.35) ** 2))  # damping near the position of rest only
    return v * film, -2 * y / 0.35**2 * v * film, film


class Mixed(NamedTuple):
    """Several forces at once; `strength` scales all of them."""

    parts: tuple[tuple[str, float], ...]
    strength: float = 1.0
    name: str = "mixed"
    sizes: tuple[int, int] = (31, 1024)

    def force(self, y, v):
        """The sum, with its slopes."""
        each = [[self.strength * c * part for part in force_of(kind, y, v)]
                for kind, c in self.parts]  # fmt: skip
        return tuple(sum(parts) for parts in zip(*each, strict=True))


def change_of(kind: str, amplitude):
    """Change of squared frequency, or of damping, by a force of unit strength, at amplitudes."""
    t = 2 * np.pi * (np.arange(_SAMPLES) + 0.5) / _SAMPLES
    force = force_of(kind, np.outer(amplitude, np.cos(t)), -np.outer(amplitude, np.sin(t)))[0]
    first = 2 * np.mean(force * np.exp(-1j * t), axis=1) / amplitude
    return first.imag if kind in (*_DAMPING, *_OTHERS[False]) else first.real


def drawn_set(law: str, other: str, fraction: float, rng):
    """A law with a second contribution, exact states of five levels, and the law's fraction."""
    of_stiffness = law in _STIFFNESS
    damping = float(np.exp(rng.uniform(*np.log([1e-3, 1e-2]))))
    wanted = 2 * damping * float(np.exp(rng.uniform(*np.log([2.0, 8.0]))))
    if not of_stiffness:
        wanted = 2 * damping * rng.uniform(0.5, 2.0)
    wanted = min(wanted, 0.15)
    grid = np.linspace(0.1, 1.0, 60)
    one, two = change_of(law, grid), change_of(other, grid)
    sign = -0.5 if law in ("cubic", "quintic") and rng.random() < 0.3 else 1.0
    first = sign * wanted * (1 - fraction) / np.std(one) * np.std(grid**2)
    second = wanted * fraction / np.std(two) * np.std(grid**2)
    if of_stiffness and rng.random() < 0.3:
        second = -second
    mixed = Mixed(((law, first), (other, second)))
    curve = backbone(mixed, damping, np.geomspace(0.02, 1.1, 60), steps=12)
    if not curve.good.all():
        raise ArithmeticError("no backbone")
    top = np.interp(1.0, curve.amplitude, curve.force)
    forces = top * np.geomspace(0.1, 1.0, 5)
    plan, upward = {"side": "both", "spacing": "phase"}, bool(curve.w[-1] > curve.w[0])
    phases = [stepped(curve, force, 1.0, plan, upward, rng) for force in forces]
    level = np.repeat(np.arange(len(forces)), [len(p) for p in phases])
    phase, ones = np.concatenate(phases), np.ones(len(level))
    start = guessed(curve, forces[level], phase, ones)
    states = solved(mixed, damping, ones, phase, start, "force")
    keep = states.good & (np.abs(states.amplitude / start.amplitude - 1) < 0.3) & (states.slope < 0)
    if np.bincount(level[keep], minlength=len(forces)).min() < 5:
        raise ArithmeticError("a level without states")
    states, level = states.of(keep), level[keep]
    one = first * change_of(law, states.amplitude)
    two = second * change_of(other, states.amplitude)
    true = 1 - np.std(two) / np.std(one + two)
    return damping, states, level, float(np.clip(true, 0, 1))


def _write(folder: Path, name: str, damping: float, states: States, level, key: dict, rng) -> None:
    hz, mass, top = np.exp(rng.uniform(*np.log([(20, 0.05, 3e-3), (400, 20, 1.0)])))
    omega = 2 * np.pi * hz
    size = top / omega
    velocity = omega * size * states.w * states.amplitude * np.exp(1j * states.phase)
    random = _NOISE * rng.normal(size=(2, len(states.w)))
    velocity = velocity * (1 + random[0]) * np.exp(1j * random[1])
    force = mass * omega**2 * size * states.force
    columns = {"level": level + 1, "frequency_hz": hz * states.w, "force_n": force,
               "velocity_re_m_s": velocity.real, "velocity_im_m_s": velocity.imag,
               "velocity_std_m_s": _NOISE * np.abs(velocity),
               "phase_std_deg": np.full(len(states.w), np.degrees(_NOISE))}  # fmt: skip
    rows = [",".join(columns)]
    rows += [",".join(f"{v:.11g}" for v in row) for row in zip(*columns.values(), strict=True)]
    (folder / "sets" / f"{name}.csv").write_text("\n".join(rows) + "\n", encoding="utf-8")
    shape = 1 / np.sqrt(mass)
    lines = ['name = "one mode"', "[[mode]]", f"frequency_hz = {hz * (1 + 1e-3 * rng.normal())}",
             f"damping_ratio = {damping * (1 + 0.1 * rng.normal())}",
             f"shape = {{ sensor = {shape} }}", f"participation = {shape}",
             f"frequency_std_hz = {1e-3 * hz}", f"damping_ratio_std = {0.1 * damping}",
             "modal_mass_std = 0.01"]  # fmt: skip
    (folder / "sets" / f"{name}.toml").write_text("\n".join(lines) + "\n", encoding="utf-8")
    (folder / "keys" / f"{name}.json").write_text(json.dumps(key), encoding="utf-8")


def main() -> None:
    """Draw and write all sets."""
    chosen = options(__doc__, out=Path, count=60, seed=0)
    for part in ("sets", "keys"):
        (chosen.out / part).mkdir(parents=True, exist_ok=True)
    for k in range(chosen.count):
        rng = np.random.default_rng((chosen.seed, k))
        law = str(rng.choice((*_STIFFNESS, *_DAMPING)))
        other = str(rng.choice(_OTHERS[law in _STIFFNESS]))
        fraction = _FRACTIONS[k % len(_FRACTIONS)]
        for _ in range(80):
            try:
                found = drawn_set(law, other, fraction, rng)
                break
            except (ArithmeticError, np.linalg.LinAlgError):
                continue
        else:
            raise RuntimeError(f"no set of {law} with {other} could be drawn")
        damping, states, level, true = found
        part = "stiffness" if law in _STIFFNESS else "damping"
        key = {"law": _KINDS[law], "other": other, "part": part, "second": fraction,
               "explained": true}  # fmt: skip
        _write(chosen.out, f"set{k:04d}", damping, states, level, key, rng)


if __name__ == "__main__":
    main()
