"""Score coupled modes identified from blind tests against their keys.

Run: python benchmarks/coupled_sets/score.py --folder DIR [--one-sensor] [--write]

Of every set: whether the interaction is the true one (or none), whether the 95 % band of the
resonant coefficients holds the true ones, and how far the responses of the fitted model to the
force that was left out lie from the integrated ones, at all sensors, over the largest of them.
And the bias of a backbone of one mode: stated, true and 1σ of the backbone.
One JSON line a set, one at the end.
"""

import json
import re
import sys
import tempfile
import time
from pathlib import Path

import jax
import numpy as np
from generate import gradient
from scipy.optimize import fsolve

import snrmjax as sj
from snrmjax.identify.coupled.coupled_test import single_mode_bias

sys.path.append(str(Path(__file__).resolve().parents[1]))
from harness import options, teller

tell = teller(__file__)
RESONANT = {"1:1": ("1122", "1112", "1222"), "1:2": ("112",), "1:3": ("1112",), "none": ()}


def off_left_out(model, key, n_sensors):
    """Relative differences of the responses to the force that was left out."""
    states = key["left_out"]
    if not states:
        return []
    omega = np.array([state["omega"] for state in states])
    seen = np.array([np.array(state["re"]) + 1j * np.array(state["im"]) for state in states])
    seen = seen[:, :n_sensors]
    span = omega.max() - omega.min()
    ends = omega.min() - 0.05 * span, omega.max() + 0.05 * span
    (curve,) = sj.forced_response(model, [states[0]["force"]], *ends, harmonic_order=7)
    frequency = np.asarray(curve.frequency)
    off = []
    for at, v in zip(omega, seen, strict=True):
        crossed = np.flatnonzero((frequency[:-1] - at) * (frequency[1:] - at) <= 0)
        missed = [np.inf]
        for k in crossed:
            nearer = k + int(abs(frequency[k + 1] - at) < abs(frequency[k] - at))
            motion = sj.simulate.periodic_motion(
                model, states[0]["force"], curve.point(nearer), value=at
            )
            if motion.converged:
                missed.append(np.linalg.norm(np.asarray(motion.velocity)[1] - v))
        off.append(min(missed) / np.abs(seen).max())
    return off


def true_mode(key, sensor, speeds):
    """Natural frequency and damping ratio of the true damped mode at velocities of a sensor.

    By a harmonic balance of its own, of five harmonics: the periodic motion that a damping force
    of the opposite sign, -2 d v per unit of mass in all modes, keeps going at the frequency Ω; its
    damping ratio is d/Ω. The mode without damping is no truth here: beside an internal resonance
    it gives the second mode far more than any damped structure does.
    """
    omega, zeta, shape = (np.array(key[name]) for name in ("omega", "zeta", "shape"))
    order, tau = np.arange(6), 2 * np.pi * np.arange(64) / 64
    waves = np.exp(1j * np.outer(order, tau))

    def left(unknown, speed, size):
        real, imaginary = unknown[:12].reshape(2, 6), unknown[12:22].reshape(2, 5)
        q = size * (real + 1j * np.pad(imaginary, ((0, 0), (1, 0))))
        frequency, growth = unknown[22:] * omega[0]
        inside = np.stack(gradient((q @ waves).real, key["terms"])) @ waves.conj().T / 32
        inside[:, 0] /= 2
        spin = 1j * order * frequency
        linear = omega[:, None] ** 2 + spin**2 + 2 * (zeta * omega - growth)[:, None] * spin
        balance = (linear * q + inside) / (omega[0] ** 2 * size)
        seen = abs(frequency * (shape[sensor] @ q[:, 1]))
        conditions = seen / speed - 1, q[0, 1].imag / size
        return np.concatenate(
            [balance.real.ravel(), balance.imag[:, 1:].ravel(), np.array(conditions)]
        )

    found, unknown = [], np.zeros(24)
    unknown[[1, 22, 23]] = 1.0, 1.0, zeta[0]
    for speed in speeds:
        size = speed / (omega[0] * abs(shape[sensor, 0]))
        new, _, good, _ = fsolve(left, unknown, (speed, size), full_output=True, xtol=1e-11)
        if good != 1:
            found.append((np.nan, np.nan))
            continue
        unknown = new
        found.append((new[22] * omega[0], new[23] / new[22]))
    return np.array(found).T


def biases(identified, coupled, key):
    """Stated and true bias of one mode at the largest amplitude, and 1σ of its curve."""
    bias = single_mode_bias(identified, coupled)
    speed, frequency, damping, std = bias.at_largest
    if not np.isfinite(speed):
        return None
    place = np.flatnonzero(bias.velocity == speed)[0]
    sensor = "ab".index(identified.backbone.sensor)
    curve = identified.backbone.sampled(len(bias.velocity))
    true = true_mode(key, sensor, np.linspace(speed / 100, speed, 100))[:, -1]
    return {
        "frequency": [frequency, float(curve.natural_frequency[place]) / true[0] - 1, std],
        "damping": [
            *(damping, float(curve.damping_ratio[place]) / true[1] - 1),
            float(curve.damping_ratio_std[place]) / true[1],
        ],
    }


def of_one_sensor(path, folder):
    """The set as the first sensor alone has it."""
    lines = path.read_text().splitlines()
    kept = [line for line in lines if line.split(",")[3] != "b"]
    alone = folder / path.name
    alone.write_text("\n".join(kept) + "\n")
    text = path.with_suffix(".toml").read_text()
    alone.with_suffix(".toml").write_text(re.sub(r", b = [^ ]* }", " }", text))
    return alone


def scored(path, key):
    """One set."""
    begin = time.perf_counter()
    model = sj.read_model(path.with_suffix(".toml"))
    data = sj.read_steady_states(path, model)
    found = sj.identify.coupled_modes(data, model)
    seconds = time.perf_counter() - begin
    answer = "none" if found.interaction is None else f"1:{found.interaction.ratio}"
    fit = found.calibration
    fitted = {n: (v, d) for n, v, d in zip(fit.names, fit.values, fit.std, strict=True)}
    held = []
    for term in RESONANT[key["kind"]]:
        value, std = fitted.get(f"potential.{term}", (0.0, 0.0))
        held.append((value - key["terms"].get(term, 0.0)) / std if std else None)
    off = off_left_out(found.model, key, len(model.modes.sensors))
    return {
        **{"set": path.stem, "kind": key["kind"], "answer": answer, "noise": key["noise"]},
        "probability": found.interactions[0].probability if found.interactions else None,
        "share": found.interactions[0].fraction if found.interactions else None,
        **{"scale": fit.noise_scale, "errors_std": held},
        **{"left_out": np.max(off) if off else None, "seconds": seconds},
        "bias": biases(sj.identify_backbone(data, model), found, key),
        "terms": [name.removeprefix("potential.") for name in fit.names if name.startswith("p")],
    }


def bias_counts(lines, part):
    """Of biases that matter, and of those above three 1σ, how many are stated within 30 %."""
    least = {"frequency": 1e-4, "damping": 1e-3}[part]
    rows = [line["bias"][part] for line in lines if line["bias"] is not None]
    right = [(abs(true), std, abs(stated - true) < 0.3 * abs(true)) for stated, true, std in rows]
    large, clear = ([r for t, s, r in right if t > max(least, k * s)] for k in (0, 3))
    return {
        **{"all": len(rows), "large": len(large), "large_within_30_percent": sum(large)},
        **{"above_3_std": len(clear), "above_3_std_within_30_percent": sum(clear)},
    }


def main() -> None:
    """Score all sets of a folder."""
    chosen = options(__doc__, folder=Path, one_sensor=False)
    lines = []
    for path in sorted((chosen.folder / "sets").glob("*.csv")):
        key = json.loads((chosen.folder / "keys" / f"{path.stem}.json").read_text())
        with tempfile.TemporaryDirectory() as folder:
            asked = of_one_sensor(path, Path(folder)) if chosen.one_sensor else path
            lines.append(scored(asked, key))
        tell(**lines[-1])
        jax.clear_caches()  # every set compiles its own programs
    errors = [e for line in lines for e in line["errors_std"] if e is not None]
    missing = sum(e is None for line in lines for e in line["errors_std"])
    off = [line["left_out"] for line in lines if line["left_out"] is not None]
    tell(
        sets=len(lines),
        right=sum(line["kind"] == line["answer"] for line in lines),
        coefficients=len(errors),
        inside=sum(abs(e) < 1.96 for e in errors),
        left_out_of_the_model=missing,
        within_1_percent=sum(o < 0.01 for o in off),
        responses=len(off),
        median_off=float(np.median(off)),
        **{part: bias_counts(lines, part) for part in ("frequency", "damping")},
        median_seconds=float(np.median([line["seconds"] for line in lines])),
    )


if __name__ == "__main__":
    main()
