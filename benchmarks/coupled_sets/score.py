"""Score coupled modes identified from blind tests against their keys.

Run: python benchmarks/coupled_sets/score.py --folder DIR [--one-sensor] [--write]

Of every set: whether the interaction is the true one (or none), whether the 95 % band of the
resonant coefficients holds the true ones, and how far the responses of the fitted model to the
force that was left out lie from the integrated ones, at all sensors, over the largest of them.
One JSON line a set, one at the end.
"""

import json
import re
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

import snrmjax as sj

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
    found = sj.identify.coupled_modes(sj.read_steady_states(path, model), model)
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
        "share": found.interactions[0].share if found.interactions else None,
        **{"scale": fit.noise_scale, "errors_std": held},
        **{"left_out": np.max(off) if off else None, "seconds": seconds},
        "terms": [name.removeprefix("potential.") for name in fit.names if name.startswith("p")],
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
        median_seconds=float(np.median([line["seconds"] for line in lines])),
    )


if __name__ == "__main__":
    main()
