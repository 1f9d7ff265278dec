"""Whether the measurement that an ambiguous diagnosis asks for settles it.

Run, with the sets, keys and diagnoses of a half:
    python benchmarks/blind_sets/close_loops.py names --keys DIR/keys --diagnoses OUT
    python benchmarks/blind_sets/generate.py --half HALF --names NAMES --with-harmonics --out DIR2
    snrmjax diagnose DIR2/sets/*.csv --model any.toml --out OUT2
    python benchmarks/blind_sets/close_loops.py score --keys DIR2/keys --diagnoses OUT2

`names` prints the sets of fundamentals whose diagnosis is ambiguous and asks for harmonics, in
order, at most 20. `score` counts those that collapse: every class has one effect, and these are
the true ones. One line a set, then the count.
"""

import argparse
import json
from pathlib import Path

_MOST = 20


def names(keys: Path, diagnoses: Path) -> list[str]:
    """Ambiguous sets of fundamentals, of effects in the library, that ask for harmonics."""
    found = []
    for path in sorted(keys.glob("*.json")):
        key = json.loads(path.read_text(encoding="utf-8"))
        answer = json.loads((diagnoses / path.stem / "diagnosis.json").read_text(encoding="utf-8"))
        asks = "harmonic" in (answer["decide_by"] or "").lower()
        several = any(len(group) > 1 for group in answer["candidates"])
        fundamental = not key["harmonics"] and bool(key["effects"])
        if answer["verdict"] == "ambiguous" and several and asks and fundamental:
            found.append(path.stem)
    return found[:_MOST]


def score(keys: Path, diagnoses: Path) -> None:
    """Print what became of every set, and how many collapsed to the truth."""
    collapsed = 0
    every = sorted(keys.glob("*.json"))
    for path in every:
        key = json.loads(path.read_text(encoding="utf-8"))
        answer = json.loads((diagnoses / path.stem / "diagnosis.json").read_text(encoding="utf-8"))
        alone = all(len(group) == 1 for group in answer["candidates"])
        right = sorted(answer["effects"]) == sorted(key["effects"])
        collapsed += alone and right
        word = "collapsed" if alone and right else "not"
        print(f"{path.stem} {'+'.join(key['effects'])}: {word}, {answer['candidates']}")
    print(f"{collapsed} of {len(every)} collapse to the truth")


def main() -> None:
    """One of the two."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("what", choices=("names", "score"))
    parser.add_argument("--keys", type=Path, required=True)
    parser.add_argument("--diagnoses", type=Path, required=True)
    options = parser.parse_args()
    if options.what == "names":
        print(",".join(names(options.keys, options.diagnoses)))
    else:
        score(options.keys, options.diagnoses)


if __name__ == "__main__":
    main()
