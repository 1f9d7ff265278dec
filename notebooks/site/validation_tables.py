"""The tables of the validation pages, from the committed results."""

from collections import Counter
from collections.abc import Iterable
from itertools import groupby

import numpy as np
import validation_programs as programs
import validation_results as of
from validation_writing import number, per_cent, table

# Published problems

ORIGINS = {
    "printed": "printed by the source",
    "reduced": "printed by the source, from a reduced model",
    "closed form": "closed form",
    "independent": "independent harmonic balance, not published",
}


def _counted(those: list[of.Comparison]) -> list[str]:
    sizes = [abs(c.difference) for c in those]
    agree = sum(c.agrees for c in those)
    return [f"{agree} of {len(those)}", number(np.median(sizes), 2), number(max(sizes), 2)]


def by_origin() -> str:
    """How many published numbers are found to the last digit, by who has them."""
    rows = []
    for key, words in ORIGINS.items():
        those = [c for c in of.comparisons() if c.origin == key]
        rows.append([words, *_counted(those)])
    head = ["who has the number", "same digits", "median difference", "largest difference"]
    return table(head, [*rows, ["**all**", *_counted(of.comparisons())]])


def printed_misses() -> list[of.Comparison]:
    """Numbers that a source prints and that are not found to the last digit, largest first."""
    printed = [c for c in of.comparisons() if c.origin in ("printed", "reduced") and not c.agrees]
    return sorted(printed, key=lambda c: -abs(c.difference))


def _compared(those: Iterable[of.Comparison], *, with_problem: bool) -> str:
    head = ["quantity", "published", "ours", "relative difference", "same digits", "who has it"]
    rows = []
    for c in those:
        what = f"{c.problem}: {c.quantity}" if with_problem else c.quantity
        same = "yes" if c.agrees else "**no**"
        values = [_plain(c.published), _plain(c.found), number(c.difference, 2), same, c.origin]
        rows.append([what, *values])
    return table(head, rows)


def _plain(text: str) -> str:
    return number(float(text), 12) if "e" in text else text


def printed_missed() -> str:
    """The numbers that a source prints and that are not found to the last digit."""
    return _compared(printed_misses(), with_problem=True)


def problems() -> str:
    """A section for each published problem."""
    blocks = []
    seconds = {
        r["problem"]: r["seconds"] for r in of.results("published_elements") if "seconds" in r
    }
    for name, those in groupby(of.comparisons(), key=lambda c: c.problem):
        source = of.sources()["problem"][name.split()[0]]
        text = f"{source['source']}. All of these numbers: {number(seconds[name])} s."
        if "elsewhere" in source:
            text += f" Printed beside it: {'; '.join(source['elsewhere'])}."
        blocks += [f"### {name}", text, _compared(those, with_problem=False)]
    return "\n\n".join(blocks)


def left_out() -> str:
    """Problems of the same list that are not compared."""
    return table(["problem", "why"], of.sources()["left_out"].items())


# The paper


def paper_errors() -> str:
    """Errors of the backbones of both beams."""
    head = ["beam", "point drawn over", "median error", "largest error", "points"]
    return table(
        head,
        (
            [r["beam"], r["over"], per_cent(r["median"]), per_cent(r["largest"]), r["points"]]
            for r in of.results("paper_figures")
            if "errors" in r
        ),
    )


def paper_resonances() -> str:
    """Predicted resonances beside those of harmonic balance."""
    head = ["beam", "force, mN", "predicted, Hz", "harmonic balance, Hz", "error"]
    head += ["predicted, m/s", "harmonic balance, m/s", "error"]
    rows = []
    for r in of.results("paper_figures"):
        if "resonance" in r:
            row = [r["beam"], number(1e3 * r["resonance"], 4)]
            row += [*(number(v, 4) for v in r["frequency_hz"]), per_cent(r["frequency_error"])]
            row += [*(number(v, 4) for v in r["velocity"]), per_cent(r["velocity_error"])]
            rows.append(row)
    return table(head, rows)


def paper_damping() -> str:
    """Identified modal damping beside the beams' own."""
    head = [
        "beam",
        "amplitude by",
        "linear damping, 1/s",
        "identified, 1/s",
        "at largest amplitude, 1/s",
    ]
    rows = []
    for r in of.results("paper_figures"):
        if "damping" in r:
            low, high = r["range"]
            span = f"{number(low, 4)} to {number(high, 4)}"
            rows.append(
                [r["beam"], r["damping"], number(r["linear"], 4), span, number(r["at_largest"], 4)]
            )
    return table(head, rows)


# Measured beams


def left_out_levels() -> str:
    """Predictions of levels that the fit had not seen."""
    head = ["levels left out", "predictions", "velocity error, median", "largest"]
    head += ["frequency error, median, Hz", "largest, Hz", "velocity in 95 % band", "not found"]
    rows = []
    for r in of.chosen("joint_fit_measured", measurement="left-out levels"):
        place = {"inside": "between others", "ends": "lowest and highest"}[r["levels"]]
        row = [place, r["predicted"], per_cent(r["velocity_error_median"])]
        row += [per_cent(r["velocity_error_largest"]), number(r["frequency_error_median_hz"], 2)]
        row += [number(r["frequency_error_largest_hz"], 2), per_cent(r["velocity_inside_95"], 3)]
        rows.append([*row, r["not_found"]])
    return table(head, rows)


def notes(beam: str) -> str:
    """What the fit of a measured beam says of it."""
    row = of.only("joint_fit_measured", measurement="fit", beam=beam)
    return "\n".join(f"- {note[0].upper()}{note[1:]}" for note in row["notes"])


def records() -> str:
    """All methods on the records of one virtual laboratory."""
    head = [
        "method",
        "points",
        "frequency error, median",
        "largest",
        "damping error, median",
        "largest",
    ]
    rows = []
    for r in of.results("compare_records"):
        if "method" in r:
            errors = [
                r[f"{q}_error_{s}"] for q in ("frequency", "damping") for s in ("median", "largest")
            ]
            rows.append([of.METHODS[r["method"]], r["points"], *map(per_cent, errors)])
    return table(head, rows)


def linear_modes() -> str:
    """Linear modes from simulated tests."""
    words = {"coherence": "noise by a stated coherence", "close": "two close modes"}
    words |= {"random": "random test", "light": "random test, few lines in the band"}
    head = [
        "test",
        "frequency error",
        "damping error",
        "shape error",
        "another number of modes found",
    ]
    rows = []
    for r in of.results("linear_modes"):
        errors = [r[f"{q}_error_median_%"] / 100 for q in ("frequency", "damping", "shape")]
        rows.append([words[r["case"]], *map(per_cent, errors), r["other_number_of_modes"]])
    return table(head, rows)


# Blind sets


def latest_bars() -> str:
    """Scores of the last half beside the bars set before."""
    mark = {True: "met", False: "**missed**", None: ""}
    rows = [[b.score, b.value, b.bar, mark[b.met]] for b in of.bars()]
    return table(["score", "found", "bar", ""], rows)


def stated() -> str:
    """The reliability diagram in numbers."""
    rows = []
    for name, bins in of.reliability().items():
        for one in bins:
            low, high = of.binomial(one.right, one.answers)
            row = [
                name,
                f"{number(one.low)} to {number(one.high)}",
                f"{one.right} of {one.answers}",
            ]
            rows.append([*row, f"{per_cent(low)} to {per_cent(high)}"])
    return table(["question", "stated probability", "right", "95 % interval of the share"], rows)


def regime() -> str:
    """Diagnoses of one mode by law."""
    head = [
        "law",
        "sets",
        "right",
        "beside it another",
        "only wrong names",
        "unknown or noise",
        "drawn",
    ]
    rows = []
    for law, those in groupby(
        sorted(of.diagnosed(), key=lambda r: r["law"]), key=lambda r: r["law"]
    ):
        kinds = Counter(kind(row) for row in those)
        row = [kinds[k] for k in ("right", "beside", "wrong", "unknown", "drawn")]
        rows.append([law.replace("_", " "), sum(kinds.values()), *row])
    return table(head, rows)


def kind(row: of.Row) -> str:
    if row["verdict"] in ("unknown", "noise_rejected"):
        return "unknown"
    if row["verdict"] == "drawn":
        return "drawn"
    right = "right" if of.named_rightly(row) else "beside"
    return "wrong" if of.wrongly_named(row) else right


def checks() -> str:
    """Errors of the laboratory found by `check`."""
    of_all = of.only("blind_checks")
    rows = []
    for kind, (tests, found, named) in sorted(of_all["by_kind"].items()):
        if kind == "none":
            kind, found, named = "no error (false alarms)", found, ""
        rows.append([kind.replace("_", " "), tests, found, named])
    return table(["hidden error", "tests", "found", "named rightly"], rows)


# Coverage


def covered() -> str:
    """How often 95 % bands held the truth."""
    head = ["band", "of", "tests", "held", "95 % interval", "band is"]
    rows = []
    for c in of.coverages():
        low, high = c.interval
        says = f"**{c.says}**" if c.says == "too narrow" and c.ours else c.says
        row = [c.what, c.about, c.tests, per_cent(c.fraction, 3)]
        rows.append([*row, f"{per_cent(low, 3)} to {per_cent(high, 3)}", says])
    return table(head, rows)


def narrow() -> list[of.Coverage]:
    """Our bands whose interval lies below 95 %."""
    return [c for c in of.coverages() if c.ours and c.says == "too narrow"]


def misses() -> str:
    """All that these results miss, in one list."""
    printed = printed_misses()
    most = printed[0]
    found = [
        f"[Published problems](problems.md): {len(printed)} numbers that a source prints are not "
        f"found to the last digit; the largest difference is {per_cent(abs(most.difference))} "
        f"({most.problem}: {most.quantity})"
    ]
    found += [
        f"[Error bars](coverage.md): {c.what.lower()}, {c.about}: {per_cent(c.fraction, 3)} of "
        f"{c.tests} instead of 95 %"
        for c in narrow()
    ]
    found += [
        f"[Blind sets](blind.md): {b.score}: {b.value} (bar: {b.bar})"
        for b in of.bars()
        if b.met is False
    ]
    found += [
        f"[Reduced models](programs.md#reduced-models-over-the-size-of-their-load-cases): "
        f"{r['structure'].replace('_', ' ')}: the default size of load cases is off the plateau"
        for r in of.results("rom_load_scale")
        if not r["default_inside"]
    ]
    found += [
        f"[Stated probabilities](blind.md): {name.lower()}: of answers with {number(b.low)} to "
        f"{number(b.high)}, {b.right} of {b.answers} are right"
        for name, bins in of.reliability().items()
        for b in bins
        if of.binomial(b.right, b.answers)[1] < b.low
    ]
    worst = programs.worst_closure()
    found.append(
        f"[Forced responses](programs.md#accuracy-of-forced-responses): nine harmonics, the "
        f"default, leave a motion of the {worst['beam']} beam {per_cent(worst['largest'])} open"
    )
    return "\n".join(f"- {one}." for one in found)


TABLES = {
    **{"by origin": by_origin, "printed missed": printed_missed, "problems": problems},
    **{"left out": left_out, "peers": programs.peers, "beams": programs.beams},
    **{"faster": programs.faster, "methods": programs.methods, "closure": programs.closure},
    "accelerator": programs.accelerator,
    **{"event curves": programs.event_curves, "rom": programs.rom, "growth": programs.growth},
    **{"paper errors": paper_errors, "paper resonances": paper_resonances},
    **{"paper damping": paper_damping, "left-out levels": left_out_levels, "records": records},
    **{"linear modes": linear_modes, "bars": latest_bars, "stated": stated, "regime": regime},
    **{"checks": checks, "covered": covered, "misses": misses},
}
