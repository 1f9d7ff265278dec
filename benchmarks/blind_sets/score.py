"""Score the diagnoses of blind sets against their keys: the table of the bar, row by row.

Run: python benchmarks/blind_sets/score.py --sets DIR/sets --keys DIR/keys --diagnoses OUT
     [--figure confusion.png]

Reads OUT/NAME/diagnosis.json of every set. Prints each row with counts, then one line for each
miss, and draws the confusion matrix. How a row is counted:
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

import argparse
import json
import sys
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from itertools import permutations
from pathlib import Path

import numpy as np
from drawn import RIGHT, WRONG, judged_drawing

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


def share(results: Iterable[Result], good: Callable[[Result], bool]) -> str:
    """Count and percentage."""
    every = list(results)
    n = sum(good(r) for r in every)
    return f"{n} of {len(every)}" + (f" ({100 * n / len(every):.1f} %)" if every else "")


def _class_size(results: list[Result]) -> str:
    sizes = [len(names) for r in results for names in r.classes]
    return f"{np.mean(sizes):.2f}" if sizes else "-"


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


def _row(title: str, bar: str, value: str) -> None:
    print(f"{title:<52} | {bar:<26} | {value}")


def print_table(results: list[Result]) -> None:
    """The rows of the bar."""

    def of(group: str, **wanted: object) -> list[Result]:
        return [
            r
            for r in results
            if r.key["group"] == group and all(r.key[k] == v for k, v in wanted.items())
        ]

    _row("score", "bar", "found")
    for shared, bar in ((False, "<= 2 %"), (True, "<= 5 %")):
        title = "false alarms, no effect" + (", shared level errors" if shared else "")
        _row(
            title,
            bar,
            share(of("none", level_errors=shared), lambda r: r.verdict not in ("none", "missing")),
        )
    wrong = of("noise_wrong")
    _row(
        "noise stated wrongly",
        "noise_rejected",
        share(wrong, lambda r: r.verdict == "noise_rejected"),
    )
    _row("  wrong names", "<= 2 %", share(wrong, lambda r: r.confidently_wrong))
    for harmonics, bar in ((True, ">= 97 % / <= 1.3"), (False, ">= 90 % / <= 1.8")):
        columns = "harmonics 1-3" if harmonics else "fundamental"
        for group, label in (("one_effect", "one strong effect"), ("beam", "flat beam")):
            strong = [r for r in of(group, strength=1.0, harmonics=harmonics) if r.seen]
            value = share(strong, lambda r: r.in_class)
            _row(f"{label}, {columns}: in class / size", bar, f"{value} / {_class_size(strong)}")
            _row("  best answer exact", "", share(strong, lambda r: r.exact))
            _row("  answered none", "", share(strong, lambda r: r.verdict == "none"))
            _row("  an effect too many", "", share(strong, lambda r: r.extra))
    for strength in (0.5, 0.25):
        weak = [r for r in of("one_effect", strength=strength) if r.seen]
        honest = share(weak, lambda r: r.in_class or r.verdict == "none" or r.drawing == RIGHT)
        bars = (">= 95 %", ">= 75 %") if strength == 0.25 else ("", "")
        _row(f"one effect at {strength:g}: in class, drawn or none", bars[0], honest)
        _row("  in class", bars[1], share(weak, lambda r: r.in_class))
    unseen = [r for r in of("one_effect") if not r.seen]
    _row(
        "not seen: in class or none", "", share(unseen, lambda r: r.in_class or r.verdict == "none")
    )
    known = [r for r in results if not r.key["outside"]]
    _row("confidently wrong", "<= 2 %", share(known, lambda r: r.confidently_wrong))
    two = of("two_effects")
    _row("two effects: exact", ">= 85 %", share(two, lambda r: r.exact))
    _row("two effects: in class", ">= 92 %", share(two, lambda r: r.in_class))
    outside = of("outside")
    _row(
        "outside the library: unknown or honest imitation",
        ">= 95 %",
        share(outside, lambda r: r.honest_outside),
    )
    _row("  unknown", "", share(outside, lambda r: r.verdict == "unknown"))
    drawings = [r for r in results if r.verdict == DRAWN]
    _row("drawn laws: right, of all groups", "", share(drawings, lambda r: r.drawing == RIGHT))
    closed, worse = gaps_closed([r for r in results if r.key["effects"]])
    middle = f"median {100 * np.median(closed):.1f} % of {len(closed)}" if closed else "-"
    _row("excess gap closed on the held-out level", "median >= 95 %", middle)
    _row("  made worse by 10 %", "none", f"{len(worse)} {' '.join(worse)}")
    errors = parameter_errors(results)
    if errors:
        strong_names = {r.key["name"] for r in results if r.key["strength"] == 1.0}
        strong_errors = [e for name, _, e, _ in errors if name in strong_names]
        inside = sum(e[3] for e in errors)
        _row(
            "parameters: median error, all",
            "<= 3 %",
            f"{100 * np.median([e[2] for e in errors]):.2f} %",
        )
        if strong_errors:
            _row("  of strong effects", "", f"{100 * np.median(strong_errors):.2f} %")
        _row(
            "  95 % intervals hold the truth",
            "90-98 %",
            f"{inside} of {len(errors)} ({100 * inside / len(errors):.1f} %)",
        )
    missing = sum(r.verdict == "missing" for r in results)
    _row("sets without a diagnosis", "0", f"{missing} of {len(results)}")


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


def print_misses(results: list[Result]) -> None:
    """One line a miss: name, truth, verdict, effects, class."""
    for r in results:
        if missed(r):
            k = r.key
            truth = "+".join(k["effects"]) or k["outside"] or "none"
            units = "/".join(f"{v:.1f}" for v in k["noise_units"].values())
            print(
                f"{k['name']} {k['group']} x{k['strength']:g} {truth} "
                f"[{'H' if k['harmonics'] else 'F'}{'L' if k['level_errors'] else ''} "
                f"S={units}] -> {r.drawing or r.verdict} {'+'.join(r.answered) or '-'} {r.classes}"
            )


def confusion(results: list[Result]) -> tuple[list[str], list[str], np.ndarray]:
    """Truths, answers and counts; an effect among several counts under each truth."""
    known = sorted({kind for r in results for kind in r.key["effects"]})
    foreign = sorted({r.key["outside"] for r in results if r.key["outside"]})
    answers = sorted({kind for r in results for kind in r.answered} | set(known))
    rows = [*known, "none", "noise_wrong", *foreign]
    columns = [*answers, "none", "unknown", DRAWN, "noise_rejected", "missing"]
    counts = np.zeros((len(rows), len(columns)), dtype=int)
    for r in results:
        truths = list(r.key["effects"]) or [r.key["outside"] or "none"]
        if r.key["group"] == "noise_wrong":
            truths = ["noise_wrong"]
        left = [a for a in r.answered if a not in truths]
        for truth in truths:
            if not r.answered:
                answer = r.verdict
            elif truth in r.answered:
                answer = truth
            else:
                answer = left.pop(0) if left else "none"
            counts[rows.index(truth), columns.index(answer)] += 1
    return rows, columns, counts


def draw_confusion(results: list[Result], file: Path) -> None:
    """The confusion matrix as a figure."""
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    rows, columns, counts = confusion(results)
    figure, axes = plt.subplots(figsize=(0.3 * len(columns) + 3, 0.26 * len(rows) + 2.5))
    total = np.maximum(counts.sum(axis=1, keepdims=True), 1)
    axes.imshow(counts / total, cmap="Blues", vmin=0, vmax=1, aspect="auto")
    for i, j in zip(*np.nonzero(counts), strict=True):
        dark = counts[i, j] > 0.6 * total[i, 0]
        axes.text(
            j, i, counts[i, j], ha="center", va="center", fontsize=7,
            color="white" if dark else "black",
        )  # fmt: skip
    axes.set_xticks(range(len(columns)), [c.replace("_", " ") for c in columns], rotation=90)
    axes.set_yticks(range(len(rows)), [r.replace("_", " ") for r in rows])
    axes.tick_params(labelsize=7)
    axes.set_xlabel("best answer")
    axes.set_ylabel("truth")
    figure.tight_layout()
    figure.savefig(file, dpi=150)
    plt.close(figure)


def main() -> None:
    """Print the table and the misses."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--sets", type=Path, required=True)
    parser.add_argument("--keys", type=Path, required=True)
    parser.add_argument("--diagnoses", type=Path, required=True)
    parser.add_argument("--figure", type=Path)
    options = parser.parse_args()
    results = read_results(options.sets, options.keys, options.diagnoses)
    if not results:
        sys.exit(f"{options.sets} holds no sets.")
    print_table(results)
    print()
    print_misses(results)
    if options.figure is not None:
        draw_confusion(results, options.figure)


if __name__ == "__main__":
    main()
