"""Score the diagnoses of blind sets against their keys: the table of the bar, row by row.

Run: python benchmarks/blind_sets/score.py --sets DIR/sets --keys DIR/keys --diagnoses OUT
     [--record NAME --write]

Reads OUT/NAME/diagnosis.json of every set. One JSON line: each row with its counts, and every miss.
How a row is counted:
- in class: each true effect stands in a class of its own among `candidates`;
- not seen: an effect that changes nothing in the columns given (`none` is then right as well);
- confidently wrong: `named` or `ambiguous` with a true effect in no class (`unknown` is p < 1e-3);
- drawn: right where the true force is inside the drawn band over 90 % of the measured range, be it
  an effect of the library or a law outside (`drawn`). It names nothing, so it stands in no class;
  wrong, or where there is no such force, it is confidently wrong, on a set without effects too;
- outside the library: `unknown`, drawn right, or `ambiguous` with a held-out gap within 1.3 noise
  floors;
- gap closed: 1 − (after − floor)/(before − floor) on the held-out level, where before > 1.5 floors.
"""

import json
import sys
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from itertools import permutations
from pathlib import Path

import numpy as np
from drawn import RIGHT, WRONG, judged_drawing

sys.path.append(str(Path(__file__).resolve().parents[1]))
from harness import options, teller

tell = teller(__file__, append=True)

VISIBLE_UNITS = 1.0  # an effect below this distance per point is not seen in the columns given
WITHIN_NOISE = 1.3
ANSWERED = ("named", "ambiguous")
DRAWN = "drawn"
# The sign of these is a matter of the added mode's own sign, or of the side of the mean.
SIGN_FREE = ("internal_resonance_1_3.coefficient", "internal_resonance_1_2.coefficient")
SIGN_FREE_WITHOUT_HARMONICS = (
    *("quadratic_stiffness.coefficient", "static_preload.constant_force"),
)


@dataclass(frozen=True)
class Result:
    """A key and what was answered."""

    key: dict
    diagnosis: dict | None

    @property
    def verdict(self) -> str:
        """The verdict, or `missing`."""
        return "missing" if self.diagnosis is None else self.diagnosis["verdict"]

    @property
    def classes(self) -> list[list[str]]:
        """The classes that were answered; none unless something was named."""
        if self.diagnosis is None or self.verdict not in ANSWERED:
            return []
        return [list(names) for names in self.diagnosis["candidates"]]

    @property
    def answered(self) -> list[str]:
        """The single best answer."""
        if self.diagnosis is None or self.verdict not in ANSWERED:
            return []
        return list(self.diagnosis["effects"])

    @property
    def in_class(self) -> bool:
        """Whether every true effect stands in a class of its own."""
        truth, classes = self.key["effects"], self.classes
        if len(classes) < len(truth):
            return False
        return any(
            all(kind in names for kind, names in zip(truth, some, strict=True))
            for some in permutations(classes, len(truth))
        )

    @property
    def exact(self) -> bool:
        """Whether exactly the true effects were answered."""
        return sorted(self.answered) == sorted(self.key["effects"])

    @property
    def extra(self) -> bool:
        """Whether more effects were answered than there are."""
        return len(self.answered) > len(self.key["effects"])

    @property
    def seen(self) -> bool:
        """Whether the columns given show the effect at all."""
        units = self.key["noise_units"]
        names = ["bottom", "top"]
        if self.key["harmonics"]:
            names += ["harmonics_bottom", "harmonics_top"]
        return max(units.get(name, 0.0) for name in names) >= VISIBLE_UNITS

    @property
    def drawing(self) -> str:
        """How a drawn law counts; empty where none was drawn."""
        if self.diagnosis is None or self.verdict != DRAWN:
            return ""
        return judged_drawing(self.key, self.diagnosis)[0]

    @property
    def confidently_wrong(self) -> bool:
        """Named something whose classes leave a true effect out, or drew a force that is not so."""
        if self.verdict == DRAWN:
            return self.drawing == WRONG
        return self.verdict in ANSWERED and (not self.key["effects"] or not self.in_class)

    @property
    def honest_outside(self) -> bool:
        """Unknown, a true force drawn, or an ambiguous answer that predicts the level left out."""
        if self.verdict == "ambiguous" and self.diagnosis is not None:
            gap = self.diagnosis["gap"]
            after = gap.get("held_out_after")
            return after is not None and after <= WITHIN_NOISE * gap.get("noise_floor", 1.0)
        return self.verdict == "unknown" or self.drawing == RIGHT


def read_results(sets: Path, keys: Path, diagnoses: Path) -> list[Result]:
    """Every set that has a table and a key, with its diagnosis where there is one."""
    results = []
    for path in sorted(sets.glob("*.csv")):
        truth = json.loads((keys / f"{path.stem}.json").read_text(encoding="utf-8"))
        file = diagnoses / path.stem / "diagnosis.json"
        found = json.loads(file.read_text(encoding="utf-8")) if file.exists() else None
        results.append(Result(truth, found))
    return results


def fraction(results: Iterable[Result], good: Callable[[Result], bool]) -> str:
    """Count and percentage."""
    every = list(results)
    n = sum(good(r) for r in every)
    return f"{n} of {len(every)}" + (f" ({100 * n / len(every):.1f} %)" if every else "")


def parameter_errors(results: list[Result]) -> list[tuple[str, str, float, bool]]:
    """(set, parameter, relative error, inside the 95 % interval) where the kind was answered."""
    rows = []
    for r in results:
        if r.key["outside"] or r.diagnosis is None or r.verdict not in ANSWERED:
            continue
        free = SIGN_FREE + (() if r.key["harmonics"] else SIGN_FREE_WITHOUT_HARMONICS)
        for name, truth in r.key["parameters"].items():
            answer = r.diagnosis["parameters"].get(name)
            if answer is None or name.split(".")[0] not in r.answered:
                continue
            value, std = answer["value"], answer["std"]
            if name in free:
                value, truth = abs(value), abs(truth)
            inside = std is not None and abs(value - truth) <= 1.96 * std
            rows.append((r.key["name"], name, abs(value - truth) / abs(truth), inside))
    return rows


def gaps_closed(results: list[Result]) -> tuple[list[float], list[str]]:
    """Share of the excess gap closed on the held-out level, and the sets made worse by 10 %."""
    closed, worse = [], []
    for r in results:
        if r.diagnosis is None or not (r.answered or r.verdict == DRAWN):
            continue
        gap = r.diagnosis["gap"]
        before, after = gap.get("held_out_before"), gap.get("held_out_after")
        floor = gap.get("noise_floor", 1.0)
        if before is None or after is None:
            continue
        if before > 1.5 * floor:
            closed.append(1 - (after - floor) / (before - floor))
        if after > 1.1 * max(before, floor):
            worse.append(r.key["name"])
    return closed, worse


def rows_of(results: list[Result]) -> dict[str, str]:
    """The rows of the bar by their titles, each "found (bar)"."""
    rows: dict[str, str] = {}

    def of(group: str, **wanted: object) -> list[Result]:
        return [
            r
            for r in results
            if r.key["group"] == group and all(r.key[k] == v for k, v in wanted.items())
        ]

    def row(title: str, bar: str, some: list[Result], good: Callable[[Result], bool]) -> None:
        rows[title] = fraction(some, good) + (f"; bar {bar}" if bar else "")

    for shared, bar in ((False, "<= 2 %"), (True, "<= 5 %")):
        title = "false alarms, no effect" + (", shared level errors" if shared else "")
        none = of("none", level_errors=shared)
        row(title, bar, none, lambda r: r.verdict not in ("none", "missing"))
    wrong = of("noise_wrong")
    row("noise stated wrongly", "all", wrong, lambda r: r.verdict == "noise_rejected")
    row("noise stated wrongly: wrong names", "<= 2 %", wrong, lambda r: r.confidently_wrong)
    for harmonics, bar in ((True, ">= 97 %, size <= 1.3"), (False, ">= 90 %, size <= 1.8")):
        columns = "harmonics 1-3" if harmonics else "fundamental"
        for group, label in (("one_effect", "one strong effect"), ("beam", "flat beam")):
            strong = [r for r in of(group, strength=1.0, harmonics=harmonics) if r.seen]
            sizes = [len(names) for r in strong for names in r.classes]
            title = f"{label}, {columns}"
            row(f"{title}: in class", bar, strong, lambda r: r.in_class)
            rows[f"{title}: size"] = f"{np.mean(sizes):.2f}" if sizes else "-"
            row(f"{title}: best answer exact", "", strong, lambda r: r.exact)
            row(f"{title}: answered none", "", strong, lambda r: r.verdict == "none")
            row(f"{title}: an effect too many", "", strong, lambda r: r.extra)
    for strength, bars in ((0.5, ("", "")), (0.25, (">= 95 %", ">= 75 %"))):
        weak, title = [r for r in of("one_effect", strength=strength) if r.seen], f"at {strength:g}"
        row(
            *(f"one effect {title}: in class, drawn or none", bars[0], weak),
            lambda r: r.in_class or r.verdict == "none" or r.drawing == RIGHT,
        )
        row(f"one effect {title}: in class", bars[1], weak, lambda r: r.in_class)
    unseen = [r for r in of("one_effect") if not r.seen]
    row("not seen: in class or none", "", unseen, lambda r: r.in_class or r.verdict == "none")
    known = [r for r in results if not r.key["outside"]]
    row("confidently wrong", "<= 2 %", known, lambda r: r.confidently_wrong)
    row("two effects: exact", ">= 85 %", of("two_effects"), lambda r: r.exact)
    row("two effects: in class", ">= 92 %", of("two_effects"), lambda r: r.in_class)
    for group in ("outside", "law"):
        row(f"{group}: honest", ">= 95 %", of(group), lambda r: r.honest_outside)
        row(f"{group}: unknown", "", of(group), lambda r: r.verdict == "unknown")
    drawings = [r for r in results if r.verdict == DRAWN]
    row("drawn laws: right, of all groups", "", drawings, lambda r: r.drawing == RIGHT)
    closed, worse = gaps_closed([r for r in results if r.key["effects"]])
    if closed:
        middle = f"median {100 * np.median(closed):.1f} % of {len(closed)}; bar >= 95 %"
        rows["excess gap closed on the held-out level"] = middle
    rows["held-out level made worse by 10 %"] = f"{len(worse)} {' '.join(worse)}"
    errors = parameter_errors(results)
    if errors:
        strong_names = {r.key["name"] for r in results if r.key["strength"] == 1.0}
        for title, some in (
            ("all", [e for _, _, e, _ in errors]),
            ("of strong effects", [e for name, _, e, _ in errors if name in strong_names]),
        ):
            rows[f"parameters: median error, {title}"] = f"{100 * np.median(some):.2f} %"
        inside = sum(e[3] for e in errors)
        rows["parameters: 95 % intervals hold the truth"] = f"{inside} of {len(errors)}"
    row("sets without a diagnosis", "0", results, lambda r: r.verdict == "missing")
    return rows


def missed(r: Result) -> bool:
    """Whether a set was answered otherwise than it should be."""
    group = r.key["group"]
    if group == "none":
        return r.verdict != "none"
    if group == "noise_wrong":
        return r.verdict != "noise_rejected"
    if group in ("outside", "law"):
        return not r.honest_outside
    if group == "one_effect" and (r.key["strength"] < 1 or not r.seen) and r.verdict == "none":
        return False
    return not r.in_class or (group == "two_effects" and not r.exact)


def told_miss(r: Result) -> str:
    """Name, truth, verdict, effects and classes of a miss."""
    k = r.key
    truth = "+".join(k["effects"]) or k["outside"] or "none"
    units = "/".join(f"{v:.1f}" for v in k["noise_units"].values())
    return (
        f"{k['name']} {k['group']} x{k['strength']:g} {truth} "
        f"[{'H' if k['harmonics'] else 'F'}{'L' if k['level_errors'] else ''} "
        f"S={units}] -> {r.drawing or r.verdict} {'+'.join(r.answered) or '-'} {r.classes}"
    )


def main() -> None:
    """Print the table and the misses."""
    chosen = options(__doc__, sets=Path, keys=Path, diagnoses=Path, record="")
    results = read_results(chosen.sets, chosen.keys, chosen.diagnoses)
    if not results:
        sys.exit(f"{chosen.sets} holds no sets.")
    misses = [told_miss(r) for r in results if missed(r)]
    tell(record=chosen.record, sets=len(results), rows=rows_of(results), misses=misses)


if __name__ == "__main__":
    main()
