"""Score the places of forces found in blind tests against their keys.

Run: python benchmarks/location_sets/score.py --folder DIR [--one-sensor] [--write]

Five candidates and "everywhere". One JSON line a set; at the end how many are right, and in five
bins of the stated probability of the first place how many of these are right.
"""

import itertools
import json
import sys
import time
from pathlib import Path

import jax
import numpy as np

import snrmjax as sj
from snrmjax.model.modes import OptionalModalData

sys.path.append(str(Path(__file__).resolve().parents[1]))
from harness import options, teller

tell = teller(__file__, append=True)
BINS = (0.0, 0.5, 0.75, 0.9, 0.98, 1.001)


def of_one_sensor(data, model):
    """The test as the sensor that sees the first mode best has it."""
    shape = np.abs(np.asarray(model.modes.mode_shape)[:, 0])
    k = int(np.argmax(shape))
    seen = {
        name: np.asarray(getattr(data, name))[:, [k]]
        for name in ("velocity", "velocity_std", "phase_std", "harmonics", "harmonic_std")
    }
    others = [
        name
        for name in (*model.modes.sensors, *model.modes.points)
        if name != model.modes.sensors[k]
    ]
    modes = sj.model.linear_modes(
        *(model.modes.natural_frequency, model.modes.damping_ratio),
        *(np.asarray(model.modes.mode_shape)[[k]], model.modes.participation),
        sensors=(data.sensors[k],),
        optional=OptionalModalData({name: model.modes.shape_at(name) for name in others}),
    )
    given = (data.level, data.frequency, data.force, seen.pop("velocity"))
    alone = sj.measure.steady_states(
        *given, sensors=(data.sensors[k],), harmonic_order=data.harmonic_order, **seen
    )
    return alone, sj.model.structure(modes)


def main() -> None:
    """Score all sets of a folder."""
    chosen = options(__doc__, folder=Path, one_sensor=False)
    lines = []
    for path in sorted((chosen.folder / "sets").glob("*.csv")):
        key = json.loads((chosen.folder / "keys" / f"{path.stem}.json").read_text())
        model = sj.read_model(path.with_suffix(".toml"))
        data = sj.read_steady_states(path, model)
        if chosen.one_sensor:
            data, model = of_one_sensor(data, model)
        begin = time.perf_counter()
        found = sj.diagnose.locate_force(data, model, key["candidates"])
        first = found.candidates[0]
        lines.append(
            {
                **{"set": path.stem, "kind": key["kind"], "sensors": len(data.sensors)},
                **{
                    "noise": key["noise"],
                    "harmonics": key.get("harmonics"),
                    "true": key["true"],
                    "found": first.name,
                },
                **{"probability": first.probability, "misfit": found.misfit},
                "law": None if first.law is None else first.law.kind,
                "determined": first.law is not None and first.law.determined,
                "of_true": dict(zip(found.name, found.probability.tolist(), strict=True)).get(
                    key["true"]
                ),
                "seconds": time.perf_counter() - begin,
            }
        )
        print(json.dumps(lines[-1]), flush=True)
        if len(lines) % 10 == 0:
            jax.clear_caches()
    stated = np.array([line["probability"] for line in lines])
    right = np.array([line["found"] == line["true"] for line in lines])
    bins = []
    for low, high in itertools.pairwise(BINS):
        at = (stated >= low) & (stated < high)
        if at.any():
            mean = float(stated[at].mean())
            bins.append(
                {"from": low, "sets": int(at.sum()), "right": int(right[at].sum()), "stated": mean}
            )
    tell(
        one_sensor=chosen.one_sensor,
        sets=len(lines),
        right=int(right.sum()),
        right_laws=sum(line["law"] == line["kind"] for line in lines if line["law"]),
        laws=sum(line["law"] is not None for line in lines),
        bins=bins,
        median_seconds=float(np.median([line["seconds"] for line in lines])),
        misses=[line for line, good in zip(lines, right, strict=True) if not good],
    )


if __name__ == "__main__":
    main()
