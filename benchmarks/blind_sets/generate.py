"""Blind data sets for `snrmjax diagnose`: truth by time integration, with the errors of a test.

Run: python benchmarks/blind_sets/generate.py --half development|scoring --out DIR
     [--only N] [--names NAME,NAME…] [--requests FILE.json] [--seed 1] [--laws first|fresh]

Writes DIR/sets/NAME.csv and NAME.toml (the baseline model, which lacks the effect) and, apart from
them, DIR/keys/NAME.json (the truth). No code is shared with the package that is tested.
`--requests` writes the sets named in a file of `close_loops.py`, each with the further measurement
that the diagnosis of it asked for. One JSON line at the end: sets, sweeps, seconds.
"""

import argparse
import collections
import json
import time
from pathlib import Path

from further import answered
from plans import HALVES, LAW_SETS, Case, draw_cases
from records import write_set
from truth import Truth, calibrated


def generate(
    half: str,
    seed: int,
    only: int | None = None,
    names: list[str] | None = None,
    *,
    laws: str | None = None,
) -> tuple[list[Case], list[Truth]]:
    """Draw and simulate the sets of one half, the first `only` of them or those of some names."""
    cases = draw_cases(half, seed, laws=laws)[:only]
    if names is not None:
        cases = [case for case in cases if case.name in names]
    truths = calibrated(cases)
    return cases, truths


def main() -> None:
    """Write one half."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--half", choices=HALVES, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--only", type=int)
    parser.add_argument("--names", type=lambda text: text.split(","))
    parser.add_argument("--requests", type=Path)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument(
        "--laws",
        choices=LAW_SETS,
        nargs="?",
        const="first",
        help="laws instead",
    )
    options = parser.parse_args()
    begin = time.perf_counter()
    sets, keys = options.out / "sets", options.out / "keys"
    sets.mkdir(parents=True, exist_ok=True)
    keys.mkdir(parents=True, exist_ok=True)
    requests: dict[str, dict] = {}
    if options.requests is not None:
        requests = json.loads(options.requests.read_text(encoding="utf-8"))
        options.names = list(requests)
    cases, truths = generate(
        options.half, options.seed, options.only, options.names, laws=options.laws
    )
    for case, truth in zip(cases, truths, strict=True):
        if case.name in requests:
            request = requests[case.name]
            columns, whole = answered(case, truth, request)
            write_set(case, whole, sets, keys, columns, request)
        else:
            write_set(case, truth, sets, keys)
    line = {
        "half": options.half,
        "sets": len(cases),
        "groups": collections.Counter(case.plan.group for case in cases),
        "sweeps": sum(2 * len(case.sequence) for case in cases),
        "rows": sum(len(truth.level) for truth in truths),
        "jumps": sum(truth.jumps for truth in truths),
        "frequencies_left_out": sum(truth.left_out for truth in truths),
        "seconds": round(time.perf_counter() - begin, 1),
    }
    print(json.dumps(line))


if __name__ == "__main__":
    main()
