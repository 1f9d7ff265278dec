"""The tables of the validation pages, from the committed results."""

from collections import Counter
from collections.abc import Iterable
from itertools import groupby

import numpy as np
import validation_results as of

_RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def number(value: float | None, digits: int = 3) -> str:
    """A number as it is read: 0.0123, 1.2·10⁻⁶, and counts as they are."""
    if value is None:
        return "–"
    if isinstance(value, int):
        return str(value)
    text = f"{value:.{digits}g}"
    if "e+" in text:
        text = f"{float(text):.0f}"
    if "e" in text:
        mantissa, power = text.split("e")
        text = f"{mantissa}·10{str(int(power)).translate(_RAISED)}"
    return text.replace("-", "−")


def per_cent(share: float | None, digits: int = 2) -> str:
    """A share or a relative error in per cent."""
    return "–" if share is None else f"{number(100 * share, digits)}\N{NO-BREAK SPACE}%"


def table(head: Iterable[str], rows: Iterable[Iterable[object]]) -> str:
    """A table; its first column is text, the others are on the right."""
    head, rows = list(head), [[str(c).replace("|", "\\|") for c in row] for row in rows]
    if not rows:
        raise ValueError(f"A table of validation is empty: {', '.join(head)}.")
    lines = [head, ["---", *["--:"] * (len(head) - 1)], *rows]
    text = "\n".join(f"| {' | '.join(line)} |" for line in lines)
    return f'<div class="results" markdown>\n\n{text}\n\n</div>'


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
    return table(["problem", "why"], of.sources()["left_out"].items()).replace("--:", "---")


# Other programs


def peers() -> str:
    """Structures with elements at points: every program's speed and error."""
    head = ["problem", "program", "seconds", "points", "ms a point", "error of points", "of chords"]
    rows = []
    for r in of.results("element_peers"):
        program = of.PROGRAMS.get(r["program"], r["program"])
        values = [number(r[k]) for k in ("seconds", "points", "milliseconds_a_point")]
        errors = [number(r[k], 2) for k in ("error", "chords")]
        rows.append([of.PROBLEMS[r["problem"]], program, *values, *errors])
    return table(head, rows)


def beams() -> str:
    """The two beams of modes: every program's speed and error."""
    head = ["problem", "program", "seconds", "points", "solves", "error of points", "of chords"]
    rows = []
    for r in of.chosen("simulator_speed", measurement="forced_response"):
        program = of.PROGRAMS.get(r["method"], r["method"])
        values = [number(r[k]) for k in ("seconds", "points", "n_solves")]
        errors = (r["distance_to_9_harmonics"], r["reference_not_covered"])
        row = [of.PROBLEMS[r["beam"]], program, *values, *(number(e, 2) for e in errors)]
        rows.append(row)
    return table(head, rows)


def faster() -> str:
    """Where another program is the faster one: stability included in ours, and left out."""
    found = []
    for r in of.chosen("simulator_speed", measurement="ratios"):
        for key in ("jaxcont", "numpy_scipy", "pyharm"):
            bare, full = r[f"{key}_over_no_stability"], r[f"{key}_over_snrmjax"]
            if full < 1:
                found.append(
                    f"{of.PROBLEMS[r['beam']]}: {of.PROGRAMS[key]} takes {full:.2f} of our "
                    f"time with stability, {bare:.2f} of it without"
                )
    for r in of.chosen("simulator_speed", measurement="batch_of_forces"):
        ours, theirs = r["batch_seconds_a_curve"], r["jaxcont_one_by_one_seconds_a_curve"]
        if theirs < ours:
            found.append(
                f"{of.PROBLEMS[r['beam']]}, {r['forces']} forces in one batch, "
                f"{'with' if r['stability'] else 'without'} stability: jaxcont, one by one, takes "
                f"{number(theirs / ours, 2)} of our time"
            )
    for problem, rows in groupby(of.results("element_peers"), key=lambda r: r["problem"]):
        those = {r["program"]: r for r in rows}
        for key in of.PROGRAMS:
            if key in those and those[key]["error"] < those["snrmjax"]["error"]:
                theirs, own = (number(those[p]["error"], 2) for p in (key, "snrmjax"))
                found.append(
                    f"{of.PROBLEMS[problem]}: points of {of.PROGRAMS[key]} are the more exact, "
                    f"{theirs} against {own}"
                )
    return "\n".join(f"- {one}." for one in found) or "- Nowhere in these results."


def unanswered() -> str:
    """Problems on which a program left no result."""
    kept = of.results("element_peers")
    found = [
        f"{of.PROBLEMS[problem]}: {', '.join(missing)}"
        for problem in dict.fromkeys(r["problem"] for r in kept)
        if (
            missing := [
                words
                for key, words in of.PROGRAMS.items()
                if key in ("pyharm", "nlvib", "tmdsimpy")
                and not of.chosen("element_peers", problem=problem, program=key)
            ]
        )
    ]
    return "; ".join(found) or "none"


def methods() -> str:
    """Methods of identification on the same virtual tests, by noise."""
    head = ["method", "noise", "frequency error", "damping error"]
    head += ["frequency in band", "damping in band", "worst structure, frequency"]
    rows = []
    for file in ("methods_table", "methods_loops_and_decays"):
        kept = of.results(file)
        for method in dict.fromkeys(r["method"] for r in kept):
            for noise in ("low", "high"):
                those = [r for r in kept if (r["method"], r["noise"]) == (method, noise)]
                row = [
                    per_cent(_median(those, f"{q}_error_median")) for q in ("frequency", "damping")
                ]
                row += [
                    per_cent(_median(those, f"{q}_coverage"), 3) for q in ("frequency", "damping")
                ]
                worst = max(r["frequency_error_median"] or 0.0 for r in those)
                rows.append([of.METHODS[method], noise, *row, per_cent(worst)])
    return table(head, rows)


def _median(rows: list[of.Row], key: str) -> float | None:
    values = [r[key] for r in rows if r.get(key) is not None]
    return float(np.median(values)) if values else None


def worst_closure() -> of.Row:
    """The motion that the default number of harmonics describes worst."""
    kept = of.chosen("simulator_accuracy", measurement="closure", harmonics=9)
    return max(kept, key=lambda r: r["largest"])


def closure() -> str:
    """Distance of a motion from its start after a period, by number of harmonics."""
    kept = of.chosen("simulator_accuracy", measurement="closure")
    rows = []
    for beam in ("flat", "curved"):
        for order in sorted({r["harmonics"] for r in kept}):
            those = [r for r in kept if (r["beam"], r["harmonics"]) == (beam, order)]
            worst = max(those, key=lambda r: r["largest"])
            place = f"{number(1e3 * worst['force'])} mN, {number(worst['largest_at_hz'])} Hz"
            middle = np.median([r["median"] for r in those])
            rows.append(
                [of.PROBLEMS[beam], order, number(middle, 2), number(worst["largest"], 2), place]
            )
    return table(["structure", "harmonics", "median", "largest", "where"], rows)


def event_curves() -> str:
    """Curves of events over the force."""
    head = ["curve of", "structure", "points", "ms", "100 responses instead, s", "difference"]
    return table(
        head,
        (
            (
                *(r["kind"].replace("_", " "), r["model"], r["points"]),
                *(number(1e3 * r["seconds"]), number(r["seconds_of_100_responses"])),
                number(r["largest_difference"], 2),
            )
            for r in of.results("event_curves")
        ),
    )


def rom() -> str:
    """Reduced models over the size of their load cases."""
    head = ["structure", "modes", "plateau, decades", "default inside", "default from its middle"]
    return table(
        head,
        (
            (
                *(r["structure"].replace("_", " "), ", ".join(map(str, r["modes"]))),
                *(number(r["decades"]), "yes" if r["default_inside"] else "**no**"),
                per_cent(r["default_from_middle"]),
            )
            for r in of.results("rom_load_scale")
        ),
    )


def growth() -> str:
    """Time a point over the size of the problem."""
    head = ["structure", "modes", "harmonics", "nonlinear points", "unknowns", "ms a point"]
    rows = [
        (
            *(r["model"], r["n_modes"], r["harmonics"], "–", r["unknowns"]),
            number(r["milliseconds_a_point"]),
        )
        for r in of.results("simulator_growth")
        if r["measurement"] in ("modes", "harmonics")
    ]
    for r in of.chosen("element_growth", measurement="points"):
        row = ["elements at points", r["n_modes"], "–", r["n_points"], "–"]
        rows.append([*row, number(r["milliseconds_a_point"])])
    return table(head, rows)


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
        row = [c.what, c.about, c.tests, per_cent(c.share, 3)]
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
        f"[Error bars](coverage.md): {c.what.lower()}, {c.about}: {per_cent(c.share, 3)} of "
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
    worst = worst_closure()
    found.append(
        f"[Forced responses](programs.md#accuracy-of-forced-responses): nine harmonics, the "
        f"default, leave a motion of the {worst['beam']} beam {per_cent(worst['largest'])} open"
    )
    return "\n".join(f"- {one}." for one in found)


TABLES = {
    **{"by origin": by_origin, "printed missed": printed_missed, "problems": problems},
    **{"left out": left_out, "peers": peers, "beams": beams, "faster": faster},
    **{"methods": methods, "closure": closure, "event curves": event_curves, "rom": rom},
    **{"growth": growth, "paper errors": paper_errors, "paper resonances": paper_resonances},
    **{"paper damping": paper_damping, "left-out levels": left_out_levels, "records": records},
    **{"linear modes": linear_modes, "bars": latest_bars, "stated": stated, "regime": regime},
    **{"checks": checks, "covered": covered, "misses": misses},
}
