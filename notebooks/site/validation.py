"""The pages on validation: their numbers, tables and figures, from the committed results.

A hook of MkDocs, and a command of its own that writes the pages with all that is put into them:

    python notebooks/site/validation.py FOLDER

A page under `pages/validation` holds no number of its own. It names what it shows in double braces:
a figure, a table, or one number. They are computed from `benchmarks/*.jsonl` and
`benchmarks/published_sources.toml` alone (`validation_results.py`), written as tables
(`validation_tables.py`, `validation_programs.py`) and drawn (`validation_figures.py`).
"""

import re
import sys
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import validation_programs as programs
import validation_results as of
import validation_tables as tables
from validation_figures import FIGURES, drawn
from validation_writing import number, per_cent

PAGES = Path(__file__).parent / "pages" / "validation"
NAMED = re.compile(r"\{\{ *(.+?) *\}\}")

ALT = {
    "figure_7": "Three panels for the flat beam: recorded states on both sides of the backbone and "
    "identified points on the true mode; phases of the states, all well away from resonance; "
    "damping ratio falling with amplitude, on the curve of constant damping",
    "figure_8": "Velocity and phase over frequency at four forces: predicted responses of the flat "
    "beam lie on those of harmonic balance, unstable parts dotted, stars at the resonances",
    "figure_9": "Sketch of the curved beam between two clamps under a uniform force",
    "figure_10": "Three panels for the curved beam: the backbone falls to its lowest frequency and "
    "then rises, identified points on it; phases of the states on both sides of resonance; damping "
    "ratio with a spike where the frequency is lowest",
    "figure_11": "Velocity and phase over frequency at three forces: predicted responses of the "
    "curved beam lie on those of harmonic balance near resonance, and leave them far below it",
    "programs": "Seconds of a forced response on a logarithmic axis, by program, five structures",
    "measured": "Natural frequency and damping of the Brake-Reuss beam and of the suspended beam "
    "over velocity amplitude, with 95 % bands",
    "reliability": "Five panels: share of right answers over stated probability with 95 % "
    "intervals, beside the diagonal",
    "coverage": "Shares of tests whose 95 % band holds the truth, with binomial intervals, beside "
    "a line at 95 %",
}


def figure(name: str, alt: str) -> str:
    """A figure for a light page and one for a dark page; it scrolls where the page is narrow."""
    images = [
        f'<img src="../../assets/validation/{name}-{mode}.svg#only-{mode}" alt="{alt}">'
        for mode in ("light", "dark")
    ]
    return f'<div class="figure" markdown="0">{"".join(images)}</div>'


def _of_problems() -> dict[str, str]:
    those, missed = of.comparisons(), tables.printed_misses()
    return {
        "compared": str(len(those)),
        "agree": str(sum(c.agrees for c in those)),
        "count": str(len({c.problem for c in those})),
        "missed": str(len(missed)),
        "largest": per_cent(abs(missed[0].difference)),
    }


def _of_programs() -> dict[str, str]:
    events = of.chosen("simulator_accuracy", measurement="events")
    kinds = ("fold", "peak", "phase_resonance")
    stability = of.chosen("simulator_accuracy", measurement="stability")
    worst = programs.worst_closure()
    rom = of.only("rom_load_scale", structure="flat_clamped")
    return {
        "unanswered": programs.unanswered(),
        "events": str(sum(r[kind] for r in events for kind in kinds)),
        "lost": str(sum(r["lost"] for r in events)),
        "event error": number(max(r.get(f"{kind}_error", 0) for r in events for kind in kinds), 2),
        "stability points": str(sum(r["points"] for r in stability)),
        "stability wrong": str(sum(r["disagreements"] for r in stability)),
        "closure": per_cent(worst["largest"]),
        "closure where": f"{number(1e3 * worst['force'])} mN, {number(worst['largest_at_hz'])} Hz",
        "rom closed form": per_cent(rom["over_closed_form"] - 1),
    }


def _of_paper() -> dict[str, str]:
    paper, found = of.sources()["paper"], {}
    for beam in ("flat", "curved"):
        states = of.only("paper_figures", beam=beam, curve="states")["indicator"]
        ours, as_printed = (r for r in of.chosen("paper_figures", beam=beam) if "errors" in r)
        found |= {
            f"{beam} indicator": " to ".join(map(number, paper[beam]["indicator"])),
            f"{beam} recorded": f"{number(min(states))} to {number(max(states))}",
            f"{beam} damping": paper[beam]["damping_at_large_amplitude"],
            f"{beam} error": per_cent(ours["median"]),
            f"{beam} error as printed": per_cent(as_printed["median"]),
        }
    (rest,) = (r for r in of.results("paper_figures") if "from_rest" in r)
    found["rest force"] = f"{number(1e3 * rest['from_rest'], 4)} mN"
    found["rest frequency"] = f"{number(rest['frequency_hz'])} Hz"
    found["rest first"], found["rest second"] = (f"{number(v, 2)} m/s" for v in rest["velocity"])
    return found


def _of_beams() -> dict[str, str]:
    between = of.only("joint_fit_measured", measurement="left-out levels", levels="inside")
    halves = of.only("joint_fit_measured", measurement="two halves of the levels")
    kept = of.results("compare_records")
    seconds = [
        f"{r['record'].replace('_', ' ')} {number(r['test_s'])} s" for r in kept if "record" in r
    ]
    (command,) = (r["command_s"] for r in kept if "command_s" in r)
    return {
        **{f"{beam} source": text for beam, text in of.sources()["measured"].items()},
        "velocity": per_cent(between["velocity_error_median"]),
        "frequency": number(between["frequency_error_median_hz"], 2),
        "halves frequency": number(1e3 * halves["frequency_gap_hz"], 2),
        "halves damping": per_cent(halves["damping_gap_relative"]),
        "record seconds": ", ".join(seconds),
        "command seconds": number(command),
    }


def _of_blind() -> dict[str, str]:
    checked = of.only("blind_checks")
    coupled = [r for r in of.results("coupled_sets") if "sets" in r][-1]
    several, single = (of.last("location_sets", one_sensor=one) for one in (False, True))
    bars, latest, kinds = of.bars(), of.latest_half(), [tables.kind(r) for r in of.diagnosed()]
    sure = [r for r in of.diagnosed() if r["probability"] >= of.SURE and r["verdict"] != "drawn"]
    wrong = [r for r in sure if not of.named_rightly(r)]
    refused = [r for r in wrong if tables.kind(r) == "unknown"]
    return {
        "half": of.latest()["record"],
        "with a bar": str(sum(b.met is not None for b in bars)),
        "missed": str(sum(b.met is False for b in bars)),
        "confidently wrong": latest["confidently wrong"],
        "outside": latest["outside: honest"],
        "regime sets": str(len(kinds)),
        "regime right": str(kinds.count("right")),
        "regime wrong": str(kinds.count("wrong")),
        "regime beside": str(kinds.count("beside")),
        "regime unknown": str(kinds.count("unknown") + kinds.count("drawn")),
        "sure": str(len(sure)),
        "sure wrong": str(len(wrong)),
        "sure refused": str(len(refused)),
        "sure shift": number(float(np.median([r["share"] for r in refused])), 2),
        "coupled": f"{coupled['right']} of {coupled['sets']}",
        "coupled responses": f"{coupled['within_1_percent']} of {coupled['responses']}",
        "coupled coefficients": f"{coupled['inside']} of {coupled['coefficients']}",
        "places": f"{several['right']} of {several['sets']}",
        "places, one sensor": f"{single['right']} of {single['sets']}",
        "laws": f"{several['right_laws']} of {several['laws']}",
        "checks": f"{per_cent(checked['found'], 3)} of {checked['wrong_tests']}",
        "false alarms": f"{per_cent(checked['false_alarms'])} of {checked['good_tests']}",
    }


def _of_coverage() -> dict[str, str]:
    ours = [c for c in of.coverages() if c.ours]
    return {
        "count": str(len(ours)),
        "as stated": str(sum(c.says == "as stated" for c in ours)),
        "narrow": str(sum(c.says == "too narrow" for c in ours)),
        "by chance": number(0.05 * len(ours), 2),
    }


@cache
def put_in() -> dict[str, str]:
    """What the pages name in double braces."""
    numbers = {
        **{"problems": _of_problems(), "programs": _of_programs(), "paper": _of_paper()},
        **{"beams": _of_beams(), "blind": _of_blind(), "coverage": _of_coverage()},
    }
    return {
        **{f"figure {name}": figure(name, alt) for name, alt in ALT.items()},
        **{f"table {name}": draw() for name, draw in tables.TABLES.items()},
        **{f"notes {beam}": tables.notes(beam) for beam in of.sources()["measured"]},
        **{
            f"{page} {name}": text
            for page, of_page in numbers.items()
            for name, text in of_page.items()
        },
    }


def filled(markdown: str) -> str:
    """A page with all that it names in double braces."""
    unknown = [name for name in NAMED.findall(markdown) if name not in put_in()]
    if unknown:
        raise ValueError(f"No result is called {', '.join(unknown)}.")
    return NAMED.sub(lambda found: put_in()[found[1]], markdown)


def figures() -> dict[str, str]:
    """The figures as SVG by their names below assets/validation."""
    return {
        f"{name}-{mode}.svg": drawn(draw, mode)
        for name, draw in FIGURES.items()
        for mode in ("light", "dark")
    }


def on_files(files: Any, config: Any) -> Any:
    """Add the figures."""
    from mkdocs.structure.files import File  # the command does without MkDocs

    for name, content in figures().items():
        files.append(File.generated(config, f"assets/validation/{name}", content=content))
    return files


def on_page_markdown(markdown: str, page: Any, **_: object) -> str:
    """Fill the pages on validation."""
    return filled(markdown) if page.file.src_uri.startswith("validation/") else markdown


if __name__ == "__main__":
    folder = Path(sys.argv[1])
    (folder / "assets" / "validation").mkdir(parents=True, exist_ok=True)
    (folder / "validation").mkdir(exist_ok=True)
    for path in sorted(PAGES.glob("*.md")):
        text = filled(path.read_text(encoding="utf-8"))
        (folder / "validation" / path.name).write_text(text, encoding="utf-8")
    for name, content in figures().items():
        (folder / "assets" / "validation" / name).write_text(content, encoding="utf-8")
