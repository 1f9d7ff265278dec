"""Blind tests of strongly nonlinear modes for `snrmjax check`: hidden errors, and none.

    python benchmarks/blind_checks/strong.py --out DIR [--wrong 60] [--good 60] [--seed 1]

Another kind than generate.py: closed-form balances of one mode instead of sweeps. K(a) and δ(a) are
drawn (cubic, quintic, softening, a gap, friction, quadratic damping), half of them with resonances
that shift by 10 to 200 bandwidths, damping ratios from 0.0003 on. 2 to 8 levels of one force or of
one response, whose natural frequencies lie up to 1 % apart as temperature makes them in half of the
tests; stable states of an upward or a downward sweep, or both sides of the resonance. Writes the
files that score.py reads. NumPy alone.
"""

import argparse
import collections
import json
from pathlib import Path

import numpy as np
import tomli_w

KINDS = (
    "conjugated_response",
    "acceleration_as_velocity",
    "displacement_as_velocity",
    "volts_as_force",
    "rms_for_peak",
    "degrees_for_radians",
    "clipped_channel",
    "drift",
    "different_structures",
    "shape_not_mass_normalised",
)


def draw_structure(rng) -> dict:
    """A mode in SI units of its own displacement; `shift` is that of ω̃ at the top, relative."""
    strong = bool(rng.random() < 0.5)
    zeta = float(np.exp(rng.uniform(*np.log([3e-4, 2e-3] if strong else [1e-3, 0.02]))))
    widths = float(np.exp(rng.uniform(*np.log([10, 200] if strong else [0.3, 10]))))
    law = str(rng.choice(["cubic", "quintic", "softening", "gap", "friction"]))
    shift = min(widths * 2 * zeta, 0.08 if law == "softening" else 0.35)
    return {
        "strong": strong, "law": law, "zeta": zeta, "shift": shift,
        "omega": 2 * np.pi * float(np.exp(rng.uniform(*np.log([15, 300])))),
        "drag": float(rng.choice([0.0, rng.uniform(0, 1.5)])),
        "top": float(np.exp(rng.uniform(*np.log([2e-5, 1e-3])))),
        "shape": float(np.exp(rng.uniform(*np.log([0.3, 10]))) * rng.choice([1, -1])),
        "participation": float(np.exp(rng.uniform(*np.log([0.3, 10]))) * rng.choice([1, -1])),
    }  # fmt: skip


def curves(one: dict, u):
    """ω̃² and δ at amplitudes over the largest."""
    grows = (1 + one["shift"]) ** 2 - 1
    if one["law"] == "quintic":
        rise = grows * u**4
    elif one["law"] == "gap":
        inside = np.clip(0.3 / np.maximum(u, 1e-9), 0, 1)
        share = 1 - 2 / np.pi * (np.arcsin(inside) + inside * np.sqrt(1 - inside**2))
        rise = grows * share / (1 - 2 / np.pi * (np.arcsin(0.3) + 0.3 * np.sqrt(1 - 0.09)))
    elif one["law"] == "softening":
        rise = -(1 - (1 - one["shift"]) ** 2) * u**2
    elif one["law"] == "friction":
        rise = grows * (0.06 / (0.06 + u) - 1) * min(1.0, 0.1 / max(one["shift"], 1e-9))
    else:
        rise = grows * u**2
    delta = 2 * one["zeta"] * one["omega"] * (1 + one["drag"] * u)
    if one["law"] == "friction":
        delta = delta * (1 + 0.6 * u / (0.06 + u) ** 1.5 * 0.3)
    return one["omega"] ** 2 * (1 + rise), delta


def states(one: dict, rng, offsets, plan: dict):
    """Level, Ω, modal force amplitude and modal velocity phasor, level after level."""
    rows = []
    for k, (offset, top) in enumerate(zip(offsets, plan["tops"], strict=True)):
        n = plan["points"]
        if plan["held"]:  # one response: 70° to either side of the phase resonance
            u = np.full(n, top)
            stiffness, delta = curves(one, u)
            stiffness = stiffness * (1 + offset) ** 2
            tangent = np.tan(np.radians(70) * np.linspace(-1, 1, n))
            # (K − Ω²)/(Ωδ) = tan: a quadratic equation of Ω.
            w = 0.5 * (-tangent * delta + np.sqrt((tangent * delta) ** 2 + 4 * stiffness))
        else:  # one force: amplitudes, then the frequency of either side
            angle = np.linspace(0.3, np.pi / 2, n)
            u = top * np.sin(angle)
            stiffness, delta = curves(one, u)
            stiffness = stiffness * (1 + offset) ** 2
            peak, damped = (x[0] for x in curves(one, np.array([top])))
            force = top * damped * np.sqrt(peak) * (1 + offset)
            side = {"up": -1.0, "down": 1.0}.get(plan["sweep"], 0.0)
            if not side:
                side = np.where(np.arange(n) % 2, 1.0, -1.0)
            # (K − Ω²)² + (Ωδ)² = (F/u)²: a quadratic equation of Ω².
            half = stiffness - 0.5 * delta**2
            square = half**2 - stiffness**2 + (force / u) ** 2
            w = np.sqrt(half + side * np.sqrt(np.maximum(square, 0.0)))
            keep = (square >= 0) & (w > 0.3 * one["omega"])
            u, w, stiffness, delta = (x[keep] for x in (u, w, stiffness, delta))
        order = np.argsort(w) if plan["sweep"] != "down" else np.argsort(-w)
        z = stiffness - w**2 + 1j * w * delta
        f = np.abs(z) * u
        v = 1j * w * f / z
        rows.append(np.column_stack([np.full(len(w), k + 1), w, f, v])[order])
    level, w, f, v = np.concatenate(rows).T
    return level.real.astype(int), w.real, f.real, v


def unclipped_fundamental(v, limit):
    """First harmonic of sines cut off at a limit, by its integral."""
    turn = 2 * np.pi * (np.arange(720) + 0.5) / 720
    wave = np.clip(np.abs(v)[:, None] * np.cos(turn), -limit, limit)
    return 2 * np.mean(wave * np.cos(turn), axis=1) * np.exp(1j * np.angle(v))


def write(folder: Path, kind: str, seed) -> dict:
    """One test and its key."""
    rng = np.random.default_rng(seed)
    one = draw_structure(rng)
    apart = float(rng.uniform(0.001, 0.01)) if rng.random() < 0.5 else 0.0
    levels = int(rng.integers(2, 9))
    plan = {
        "held": bool(rng.random() < 0.35), "sweep": str(rng.choice(["up", "down", "both", "both"])),
        "points": int(rng.integers(12, 33)),
        "tops": np.geomspace(float(rng.uniform(0.1, 0.4)), 1.0, levels),
    }  # fmt: skip
    if kind in ("drift", "different_structures") and rng.random() < 0.5:
        plan["held"] = True
    noise = float(np.exp(rng.uniform(*np.log([1e-3, 1e-2]))))
    stated = bool(rng.random() < 0.5)
    hidden: dict = {}
    files = [np.clip(apart * rng.normal(size=levels), -0.01, 0.01)]
    if kind == "different_structures" or (kind == "none" and rng.random() < 0.2):
        other = 0.0
        if kind == "different_structures":
            other = float(rng.uniform(0.03, 0.12) * rng.choice([-1, 1]))
            hidden["other"] = other
        files.append((1 + other) * (1 + np.clip(apart * rng.normal(size=levels), -0.01, 0.01)) - 1)
    for name, offsets in zip(("measured.csv", "other.csv"), files, strict=False):
        level, w, f, v = states(one, rng, offsets, plan)
        n = len(w)
        size = one["top"]
        force = f * size / abs(one["participation"])
        velocity = v * size * one["shape"] * np.sign(one["participation"])
        order = np.linspace(0, 1, n)
        if kind == "drift":
            change = float(rng.uniform(2, 6) * 2 * one["zeta"] * rng.choice([-1, 1]))
            hidden["drift"] = change
            factor = 1 + change * (order - 0.5)
            w, velocity, force = w * factor, velocity * factor, force * factor**2
        if kind == "clipped_channel":
            limit = float(rng.uniform(0.55, 0.85)) * np.abs(velocity).max()
            hidden["limit"] = limit
            velocity = unclipped_fundamental(velocity, limit)
        velocity = velocity * np.exp(noise * (rng.normal(size=n) + 1j * rng.normal(size=n)))
        force = force * np.exp(0.3 * noise * rng.normal(size=n))
        if kind == "conjugated_response":
            velocity = velocity.conj()
        elif kind == "acceleration_as_velocity":
            velocity = 1j * w * velocity
        elif kind == "displacement_as_velocity":
            velocity = velocity / (1j * w)
        elif kind == "rms_for_peak":
            velocity = velocity / np.sqrt(2)
        elif kind == "degrees_for_radians":
            velocity = np.abs(velocity) * np.exp(1j * np.degrees(np.angle(velocity)))
        elif kind == "volts_as_force":
            factor = float(np.exp(rng.uniform(*np.log([2.0, 30.0])) * rng.choice([-1, 1])))
            hidden["factor"] = factor
            force = force * factor
        columns = {
            "level": level, "frequency_hz": w / 2 / np.pi, "force_n": force,
            "velocity_re_m_s": velocity.real, "velocity_im_m_s": velocity.imag,
        }  # fmt: skip
        if stated:
            columns["velocity_std_m_s"] = noise * np.abs(velocity)
            columns["phase_std_deg"] = np.full(n, np.degrees(noise))
            columns["force_std_n"] = 0.3 * noise * force
        if kind == "drift" or rng.random() < 0.5:
            columns["order"] = order
        lines = [",".join(columns)]
        for row in zip(*columns.values(), strict=True):
            lines.append(",".join(f"{value:.9g}" for value in row))
        (folder / name).write_text("\n".join(lines) + "\n", encoding="utf-8")
    shape = one["shape"]
    if kind == "shape_not_mass_normalised":
        factor = float(np.exp(rng.uniform(*np.log([1.7, 10.0])) * rng.choice([-1, 1])))
        hidden["shape"] = factor
        shape = shape * factor
    mode = {
        "frequency_hz": one["omega"] / 2 / np.pi * (1 + 1e-3 * rng.normal()),
        "damping_ratio": one["zeta"] * (1 + 0.1 * rng.normal()),
        "shape": {"tip": float(shape * (1 + 0.01 * rng.normal()))},
        "participation": one["participation"],
    }
    model = {"name": folder.name.replace("_", " "), "mode": [mode]}
    (folder / "model.toml").write_text(tomli_w.dumps(model), encoding="utf-8")
    law = {k: one[k] for k in ("law", "strong", "zeta", "shift")}
    law |= {"apart": apart, "held": plan["held"], "sweep": plan["sweep"], "noise": noise}
    return {"kind": kind, "record": False, "hidden": hidden, "law": law}


def main() -> None:
    """Draw and write all tests."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--wrong", type=int, default=60)
    parser.add_argument("--good", type=int, default=60)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    kinds = [KINDS[k % len(KINDS)] for k in range(options.wrong)] + ["none"] * options.good
    kinds = [kinds[k] for k in np.random.default_rng(options.seed).permutation(len(kinds))]
    (options.out / "keys").mkdir(parents=True, exist_ok=True)
    for number, kind in enumerate(kinds):
        folder = options.out / "sets" / f"test_{number:03d}"
        folder.mkdir(parents=True, exist_ok=True)
        key = write(folder, kind, (options.seed, number))
        path = options.out / "keys" / f"{folder.name}.json"
        path.write_text(json.dumps(key, indent=1), encoding="utf-8")
    print(json.dumps({"tests": len(kinds), "kinds": collections.Counter(kinds)}))


if __name__ == "__main__":
    main()
