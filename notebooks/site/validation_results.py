"""The committed results of benchmarks/, and what the validation pages take from them.

Everything here is computed from `benchmarks/*.jsonl` and `benchmarks/published_sources.toml`.
"""

import json
import re
import tomllib
from collections.abc import Sequence
from decimal import Decimal
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.stats import beta

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"
BAND = 1.96
SURE = 0.95
Row = dict[str, Any]


@cache
def results(name: str) -> list[Row]:
    """The lines of a benchmark's results."""
    lines = (BENCHMARKS / f"{name}.jsonl").read_text(encoding="utf-8").splitlines()
    return [json.loads(line) for line in lines]


def chosen(name: str, **wanted: Any) -> list[Row]:
    """The lines with these values."""
    return [r for r in results(name) if all(r.get(k) == v for k, v in wanted.items())]


def only(name: str, **wanted: Any) -> Row:
    """The one line with these values."""
    (row,) = chosen(name, **wanted)
    return row


def last(name: str, **wanted: Any) -> Row:
    """The newest line with these values, of results that are appended."""
    return chosen(name, **wanted)[-1]


@cache
def sources() -> Row:
    """Who has the published numbers, and the paper's."""
    return tomllib.loads((BENCHMARKS / "published_sources.toml").read_text(encoding="utf-8"))


# Published problems


class Comparison(NamedTuple):
    """A number of a published problem beside ours."""

    problem: str
    quantity: str
    published: str
    found: str
    difference: float
    origin: str

    @property
    def agrees(self) -> bool:
        """Whether ours is the published number when it is rounded to as many digits."""
        wanted = Decimal(self.published)
        return Decimal(self.found).quantize(wanted) == wanted


def comparisons() -> list[Comparison]:
    """All numbers of the published problems, each with who has it."""
    found = []
    for row in results("published_elements"):
        if "quantity" not in row:
            continue
        of = sources()["problem"][row["problem"].split()[0]]
        special = [o for key, o in of.get("but", {}).items() if row["quantity"].startswith(key)]
        values = (row[k] for k in ("problem", "quantity", "published", "found", "difference"))
        found.append(Comparison(*values, origin=special[0] if special else of["origin"]))
    return found


# Error bars


class Coverage(NamedTuple):
    """How often a 95 % band held the truth."""

    what: str
    about: str
    tests: int  # independent ones
    inside: float  # of these; a test of several numbers counts by its share
    ours: bool = True

    @property
    def fraction(self) -> float:
        """Share of the tests."""
        return self.inside / self.tests

    @property
    def interval(self) -> tuple[float, float]:
        """95 % interval of the share (Clopper and Pearson)."""
        return binomial(self.inside, self.tests)

    @property
    def says(self) -> str:
        """Whether the interval holds 95 %."""
        low, high = self.interval
        return "too narrow" if high < 0.95 else "too wide" if low > 0.95 else "as stated"


def binomial(right: float, of: int) -> tuple[float, float]:
    """95 % interval of a share (Clopper and Pearson)."""
    low = beta.ppf(0.025, right, of - right + 1) if right > 0 else 0.0
    high = beta.ppf(0.975, right + 1, of - right) if right < of else 1.0
    return float(low), float(high)


def _inside(rows: Sequence[Row], key: str, most: float = BAND) -> Coverage:
    """Of lines with one error or several, in units of `most`; None where there is no band."""
    each = [np.atleast_1d(np.array(r[key], dtype=float)) for r in rows]
    fractions = [np.mean(np.abs(e[np.isfinite(e)]) <= most) for e in each if np.isfinite(e).any()]
    return Coverage("", "", len(fractions), float(np.sum(fractions)))


def coverages() -> list[Coverage]:
    """All that is known of how often 95 % bands hold."""
    rows: list[Coverage] = []

    def add(what: str, about: str, of: Coverage, ours: bool = True) -> None:
        rows.append(of._replace(what=what, about=about, ours=ours))

    fits = chosen("regime_map", question="identify")
    title = "Joint fit of one mode, nine laws"
    for key, about, most in (
        ("frequency", "natural frequency", BAND),
        ("damping", "damping", BAND),
        ("next", "frequency of a new level", 1.0),
        ("next speed", "velocity of a new level", 1.0),
    ):
        add(title, about, _inside(fits, key, most))
    tests = [r for r in results("low_level_tests") if "seed" in r]
    for key in ("frequency", "damping"):
        low = _inside(tests, f"{key}_error_stds")
        add("Low-level test that already hardens or softens, at no amplitude", key, low)
    for key in ("frequency", "damping"):
        linear = _inside(tests, f"linear_{key}_error_stds")
        add("The same, lowest level read as linear", key, linear, False)
    for row in results("linear_modes"):
        for key in ("frequency", "damping", "shape"):
            held = row["seeds"] * row[f"{key}_coverage_%"] / 100
            words = {"close": "two close modes", "coherence": "noise by coherence"}
            words |= {"random": "random test", "light": "random test, few lines in the band"}
            add(f"Linear modes, {words[row['case']]}", key, Coverage("", "", row["seeds"], held))
    for row in results("decay_company"):
        for key in ("frequency", "damping"):
            held = row["answered"] * row[f"{key}_coverage"]
            title = f"Free decays among other modes, {METHODS[row['method']]}"
            add(title, key, Coverage("", "", row["answered"], held))
    coupled = [r for r in results("coupled_sets") if "set" in r]
    with_a_band = [r for r in coupled if any(e is not None for e in r["errors_std"])]
    add("Two coupled modes", "coefficients", _inside(with_a_band, "errors_std"))
    stated = latest_half()["parameters: 95 % intervals hold the truth"]
    held, of = map(int, re.findall(r"\d+", stated)[:2])
    add("Diagnosis, blind sets", "parameters of effects", Coverage("", "", of, float(held)))
    return rows


METHODS = {
    "snrm": "this method, point by point",
    "concerto": "CONCERTO",
    "rct": "response-controlled modal fit",
    "arslan_ozguven": "describing functions",
    "harmonic_force_surface": "harmonic force surface",
    "phase_resonance": "phase resonance",
    "resonant_decay": "resonant decay",
    "restoring_force": "restoring force",
    "ssm": "spectral submanifold",
    "pnlss": "polynomial state space",
    "pll": "phase-locked loop",
    "cbc": "control-based continuation",
}


# Blind sets


def latest_half() -> dict[str, str]:
    """The scores of the last half of the blind sets."""
    return {k: v.split(";")[0] for k, v in latest()["rows"].items()}


def latest() -> Row:
    """The last half of the blind sets."""
    return [r for r in results("blind_sets") if "rows" in r][-1]


class Bar(NamedTuple):
    """A score of the blind sets and the bar that had been set for it."""

    score: str
    value: str
    bar: str
    met: bool | None  # None: no bar


def bars() -> list[Bar]:
    """The scores of the last half beside their bars."""
    found, size = [], ""
    for score, text in latest()["rows"].items():
        value, _, bar = text.partition("; bar ")
        if score.endswith(": size"):
            bar = size
        bar, _, size = bar.partition(", size ")
        found.append(Bar(score, value, bar, _met(value, bar)))
    return found


def _met(value: str, bar: str) -> bool | None:
    if not bar or " of 0" in value:
        return None
    per_cent = re.search(r"([\d.]+) %", value)
    found = float(per_cent[1] if per_cent else value.split()[0])
    if bar in ("all", "0"):
        return found == (100.0 if bar == "all" else 0.0)
    stated = re.fullmatch(r"([<>])= ([\d.]+)(?: %)?", bar)
    if stated is None:
        raise ValueError(f"A bar of the blind sets is not understood: {bar!r}.")
    sign, limit = stated.groups()
    return found <= float(limit) if sign == "<" else found >= float(limit)


class Stated(NamedTuple):
    """Answers of similar stated probability."""

    low: float
    high: float
    answers: int
    right: int


def _binned(stated: Sequence[tuple[float, bool]], edges: Sequence[float]) -> list[Stated]:
    found = []
    for low, high in pairwise([*edges, 1.0]):
        mine = [ok for p, ok in stated if low <= p and (p < high or high == 1.0)]
        found.append(Stated(low, high, len(mine), sum(mine)))
    return [one for one in found if one.answers]


def reliability() -> dict[str, list[Stated]]:
    """Right answers in bins of the stated probability, by kind of blind set."""
    kept = results("blind_sets")
    (half,) = [r for r in kept if r["benchmark"] == "blind_sets_reliability"]
    edges = [b["from"] for b in half["bins"]]

    def taken(bins: list[Row]) -> list[Stated]:
        ends = [*(b["from"] for b in bins[1:]), 1.0]
        pairs = zip(bins, ends, strict=True)
        return [Stated(b["from"], end, b["sets"], b["right"]) for b, end in pairs if b["sets"]]

    one_mode = [
        (r["probability"], named_rightly(r)) for r in diagnosed() if r["verdict"] != "drawn"
    ]
    coupled = []
    for r in results("coupled_sets"):
        if "set" in r:
            p = r["probability"] or 0.0  # of the interaction; "none" is as probable as it is not
            coupled.append((1 - p if r["answer"] == "none" else p, r["answer"] == r["kind"]))
    return {
        "What is missing (220 structures)": taken(half["bins"]),
        "What is missing (one mode)": _binned(one_mode, edges),
        "Which modes interact": _binned(coupled, edges),
        "Where it acts, several sensors": taken(last("location_sets", one_sensor=False)["bins"]),
        "Where it acts, one sensor": taken(last("location_sets", one_sensor=True)["bins"]),
    }


def diagnosed() -> list[Row]:
    """Diagnoses of the map of the regime."""
    return chosen("regime_map", question="diagnose")


def named_rightly(row: Row) -> bool:
    """Whether a diagnosis of one law names its effect, and nothing else, or rightly none."""
    if row["law"] == "none":
        return row["verdict"] == "none"
    true = sources()["regime_map"][row["law"]]
    beside = {"cubic_stiffness"} if row["law"] == "quadratic" else set()
    groups = [set(group) for group in row["candidates"]]
    named = row["verdict"] in ("named", "ambiguous")
    return named and any(true in g for g in groups) and all(({true} | beside) & g for g in groups)


def wrongly_named(row: Row) -> bool:
    """Whether a diagnosis names only what is not there."""
    if row["verdict"] not in ("named", "ambiguous"):
        return False
    true = sources()["regime_map"].get(row["law"])
    return not any(true in group for group in row["candidates"])


# Other programs

PROGRAMS = {"pyharm": "pyHarm-os", "nlvib": "NLvib-py", "tmdsimpy": "tmdsimpy"}
PROGRAMS |= {"jaxcont": "jaxcont", "numpy_scipy": "NumPy/SciPy", "no_stability": "snrmjax, bare"}
PROBLEMS = {
    "pair": "Pair",
    "two masses": "Two masses",
    "beam with a slider": "Beam with a slider",
    "flat": "Flat beam",
    "curved": "Curved beam",
}


def speeds() -> dict[str, dict[str, float]]:
    """Seconds of a whole forced response by problem and program."""
    found: dict[str, dict[str, float]] = {}
    rows = [(r["problem"], r["program"], r["seconds"]) for r in results("element_peers")]
    for r in chosen("simulator_speed", measurement="forced_response"):
        rows.append((r["beam"], r["method"], r["seconds"]))
    for problem, program, seconds in rows:
        if "8 modes" not in program:
            of = found.setdefault(PROBLEMS[problem], {})
            of[PROGRAMS.get(program, program)] = seconds
    return found
