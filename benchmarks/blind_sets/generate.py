"""Blind data sets for `snrmjax diagnose`: truth by time integration, with the errors of a test.

Run: python benchmarks/blind_sets/generate.py --half development|scoring --out DIR
     [--only N] [--names NAME …] [--requests FILE.json] [--seed 1] [--laws]

Writes DIR/sets/NAME.csv and NAME.toml (the baseline model, which lacks the effect) and, apart from
them, DIR/keys/NAME.json (the truth). No code is shared with the package that is tested.
`--requests` writes the sets named in a file of `close_loops.py`, each with the further measurement
that the diagnosis of it asked for. One JSON line at the end: sets, sweeps, seconds.
"""

import collections
import json
import sys
import time
from pathlib import Path

from further import answered
from plans import draw_cases
from records import write_set
from truth import calibrated

sys.path.append(str(Path(__file__).resolve().parents[1]))
from harness import options


def main() -> None:
    """Write one half."""
    chosen = options(
        __doc__,
        half="development",
        out=Path,
        only=int,
        names=[""],
        seed=1,
        requests=Path,
        laws=False,
    )
    begin = time.perf_counter()
    sets, keys = chosen.out / "sets", chosen.out / "keys"
    sets.mkdir(parents=True, exist_ok=True)
    keys.mkdir(parents=True, exist_ok=True)
    requests: dict[str, dict] = {}
    if chosen.requests is not None:
        requests = json.loads(chosen.requests.read_text(encoding="utf-8"))
    names = set(requests or filter(None, chosen.names))
    cases = draw_cases(chosen.half, chosen.seed, laws=chosen.laws)[: chosen.only]
    cases = [case for case in cases if not names or case.name in names]
    truths = calibrated(cases)
    for case, truth in zip(cases, truths, strict=True):
        if case.name in requests:
            request = requests[case.name]
            columns, whole = answered(case, truth, request)
            write_set(case, whole, sets, keys, columns, request)
        else:
            write_set(case, truth, sets, keys)
    line = {
        "half": chosen.half,
        "sets": len(cases),
        "groups": collections.Counter(case.plan.group for case in cases),
        "rows": sum(len(truth.level) for truth in truths),
        "jumps": sum(truth.jumps for truth in truths),
        "frequencies_left_out": sum(truth.left_out for truth in truths),
        "seconds": round(time.perf_counter() - begin, 1),
    }
    print(json.dumps(line))


if __name__ == "__main__":
    main()
