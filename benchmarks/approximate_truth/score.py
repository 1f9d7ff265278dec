"""Score of `snrmjax` on structures that no library has exactly: laws, fractions and their bands.

    python benchmarks/approximate_truth/score.py --folder DIR [--write]

DIR is what `draw.py` wrote. Every set is diagnosed as a user would, without simulated responses.
One line a set, then one with the counts:

- named: of the sets whose law explains 80 % and more, those in which the part of the law is named
  or ambiguous and its class holds the law.
- named where less than half is explained: of the sets whose drawn law explains less than half,
  those in which a part is named; most are neighbours that do explain it (|v|v for |v|^1.5), so
  each is printed.
- inside: of the sets whose one law is the only one of its part, those whose true fraction lies in
  the 95 % band; near: within 0.1 of the stated fraction.
"""

import json
import sys
import time
from pathlib import Path

sys.path.append(str(Path(__file__).resolve().parents[1]))
from harness import options, teller

tell = teller(__file__)

_ROUNDING = 1e-3  # of a fraction


def diagnosed(table: Path, key: dict) -> dict:
    """What is said of the part that the law changes."""
    import snrmjax as sj

    model = sj.read_model(table.with_suffix(".toml"))
    begin = time.process_time()
    found = sj.diagnose_model(model, sj.read_steady_states(table, model))
    part = next(part for part in found.parts if part.part == key["part"])
    return {
        "verdict": str(found.verdict), "part_verdict": part.verdict,
        "candidates": [list(group) for group in part.candidates],
        "fraction": None if part.explained is None else list(part.explained),
        "cpu_s": time.process_time() - begin,
    }  # fmt: skip


def main() -> None:
    """Diagnose all sets, and count."""
    given = options(__doc__, folder=Path)
    rows = []
    for table in sorted((given.folder / "sets").glob("*.csv")):
        key = json.loads((given.folder / "keys" / f"{table.stem}.json").read_text("utf-8"))
        found = diagnosed(table, key)
        rows.append((key, found))
        tell(case=table.stem, law=key["law"], other=key["other"], true=key["explained"], **found)

    def there(key: dict, found: dict) -> bool:
        return any(key["law"] in group for group in found["candidates"])

    def is_named(found: dict) -> bool:
        return found["part_verdict"] in ("named", "ambiguous")

    most = [is_named(found) and there(key, found) for key, found in rows if key["explained"] >= 0.8]
    least = [is_named(found) for key, found in rows if key["explained"] < 0.5]
    alone = [
        (key["explained"], *found["fraction"])
        for key, found in rows
        if found["candidates"] == [[key["law"]]]
    ]
    inside = [low - _ROUNDING <= true <= high + _ROUNDING for true, _, low, high in alone]
    near = [abs(true - value) < 0.1 for true, value, _, _ in alone]
    cpu = sorted(found["cpu_s"] for _, found in rows)
    tell(
        case="all", sets=len(rows), named=sum(most), named_of=len(most),
        named_where_less_than_half=sum(least), of=len(least), inside=sum(inside), near=sum(near),
        alone=len(alone), cpu_s_median=cpu[len(cpu) // 2],
    )  # fmt: skip


if __name__ == "__main__":
    main()
