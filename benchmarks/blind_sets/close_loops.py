"""Does the measurement that an ambiguous diagnosis asks for decide it?

Run, with the sets, keys and diagnoses of a half:
    python benchmarks/blind_sets/close_loops.py --ask --keys DIR/keys --diagnoses OUT > asked.json
    python benchmarks/blind_sets/generate.py --half HALF --requests asked.json --out DIR2
    snrmjax diagnose DIR2/sets/*.csv --model any.toml --out OUT2
    python benchmarks/blind_sets/close_loops.py --keys DIR2/keys --diagnoses OUT2

`ask` takes the ambiguous sets whose truth is in the library and whose classes have several effects,
in the order of their names, and prints the requests of the first 20 that the generator can serve
and that the diagnosis expects to be enough; the standard error lists what was done with all.
`score` counts those that collapse: every class has one effect, and these are the true ones. One
line a set, then the count.
"""

import json
import sys
from pathlib import Path

from further import SERVED

sys.path.append(str(Path(__file__).resolve().parents[1]))
from harness import options

_MOST = 20


def asked(keys: Path, diagnoses: Path) -> dict[str, dict]:
    """What ambiguous sets ask for, by their names."""
    found = {}
    for path in sorted(keys.glob("*.json")):
        key = json.loads(path.read_text(encoding="utf-8"))
        answer = json.loads((diagnoses / path.stem / "diagnosis.json").read_text(encoding="utf-8"))
        several = any(len(group) > 1 for group in answer["candidates"])
        if answer["verdict"] != "ambiguous" or not several or not key["effects"]:
            continue
        request = answer["request"] or {"kind": "none"}
        enough = request.get("settles") and not request.get("calibration_too")
        served = request["kind"] in SERVED and enough and len(found) < _MOST
        if served:
            found[path.stem] = request
        word = request["kind"] if enough else f"not enough: {request['kind']}"
        truth = "+".join(key["effects"])
        print(f"{path.stem} {truth}: {word}{'' if served else ', left out'}", file=sys.stderr)
    return found


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
        kind, truth = key["request"]["kind"], "+".join(key["effects"])
        verdict = answer["verdict"]
        print(f"{path.stem} {truth} ({kind}): {word}, {verdict}, {answer['candidates']}")
    print(f"{collapsed} of {len(every)} collapse to the truth")


def main() -> None:
    """One of the two."""
    chosen = options(__doc__, ask=False, keys=Path, diagnoses=Path)
    if chosen.ask:
        print(json.dumps(asked(chosen.keys, chosen.diagnoses), indent=1))
    else:
        score(chosen.keys, chosen.diagnoses)


if __name__ == "__main__":
    main()
