"""The tables of the page on other programs, from the committed results."""

from itertools import groupby

import numpy as np
import validation_results as of
from validation_writing import number, per_cent, table


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


_WORK = {
    "responses": "responses of curved beams, with stability",
    "points": "states inverted point by point",
    "derivatives": "derivatives of their frequencies and damping by forces and frequencies",
}


def accelerator() -> str:
    """The same work on the cores of a machine and on its graphics processor."""
    kept = of.results("accelerator")
    rows = []
    for line in kept:
        same = [r for r in kept if (r["work"], r["count"]) == (line["work"], line["count"])]
        on = {r["platform"]: r for r in same}
        if line["platform"] == "cpu" and "cuda" in on:
            gpu = on["cuda"]
            ratio = gpu["seconds"] / line["seconds"]
            rows.append(
                [
                    _WORK[line["work"]],
                    f"{line['count']:,}".replace(",", " "),
                    *(number(r["seconds"]) for r in (line, gpu)),
                    number(ratio if ratio > 1 else 1 / ratio, 2)
                    + (" times slower" if ratio > 1 else " times faster"),
                    number(gpu["apart"], 2),
                ]
            )
    devices = {r["platform"]: r["device"] for r in kept}
    head = [
        "work",
        "number",
        f"seconds on {devices['cpu']}",
        f"on {devices['cuda']}",
        "there",
        "apart",
    ]
    return table(head, rows)
