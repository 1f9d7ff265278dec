"""Score `snrmjax check` on the tests of generate.py: found, named right, raised wrongly.

    python benchmarks/blind_checks/score.py --folder DIR [--show] [--write]

A finding counts unless its severity is `info`. Found: any finding on a test with an error. Named
right: its kind among the findings. False alarm: any finding on a test without one. One JSON line.
"""

import collections
import json
import sys
import time
from pathlib import Path

import numpy as np

import snrmjax as sj
from snrmjax.measure.recordings.channels import Channel
from snrmjax.measure.recordings.time_recording import time_recording

sys.path.append(str(Path(__file__).resolve().parents[1]))
from harness import options, teller

tell = teller(__file__)


def findings(folder: Path) -> list:
    """What the program says of one test, through its Python verb."""
    model = sj.read_model(folder / "model.toml")
    tables = [
        sj.read_steady_states(path, model)
        for path in (folder / "measured.csv", folder / "other.csv")
        if path.exists()
    ]
    recordings = []
    if (folder / "record.npz").exists():
        held = np.load(folder / "record.npz")
        channels = [Channel("force", "force", "N"), Channel("velocity", "velocity", "m/s")]
        samples = np.stack([held["force"], held["velocity"]])
        recordings.append(time_recording(samples, channels, float(held["rate"])))
    found = sj.doctor.check_test(tables, model, recordings)
    return [(one.kind, one.severity, one.evidence) for one in found.findings]


def main() -> None:
    """Score all tests of a folder."""
    chosen = options(__doc__, folder=Path, show=False)
    begin = time.perf_counter()
    tally: dict[str, collections.Counter] = collections.defaultdict(collections.Counter)
    for path in sorted((chosen.folder / "keys").glob("*.json")):
        key = json.loads(path.read_text(encoding="utf-8"))
        said = findings(chosen.folder / "sets" / path.stem)
        raised = [kind for kind, severity, _ in said if severity != "info"]
        count = tally[key["kind"]]
        count["tests"] += 1
        count["found"] += bool(raised)
        count["named"] += key["kind"] in raised
        count["others"] += len(set(raised) - {key["kind"]})
        right = not raised if key["kind"] == "none" else key["kind"] in raised
        if chosen.show and not right:
            print(json.dumps({"test": path.stem, **key, "said": said}), flush=True)
    wrong = {kind: count for kind, count in tally.items() if kind != "none"}
    total = sum(count["tests"] for count in wrong.values())
    good = tally["none"]
    line = {
        "wrong_tests": total,
        "found": sum(count["found"] for count in wrong.values()) / max(total, 1),
        "named_right": sum(count["named"] for count in wrong.values()) / max(total, 1),
        "other_names_beside": sum(count["others"] for count in wrong.values()),
        "good_tests": good["tests"],
        "false_alarms": good["found"] / max(good["tests"], 1),
        "seconds_a_test": round((time.perf_counter() - begin) / max(total + good["tests"], 1), 2),
        "by_kind": {kind: [c["tests"], c["found"], c["named"]] for kind, c in tally.items()},
    }
    tell(**line)


if __name__ == "__main__":
    main()
