"""Score of `snrmjax` on the map of the regime: answers, honesty and bands, as tables and maps.

    python benchmarks/regime_map/score.py DIR [--only diagnose] [--jobs 2] [--timeout 300]
    python benchmarks/regime_map/score.py DIR --report            tables and figures alone

DIR is what `generate.py` wrote. Answers are appended to diagnose.jsonl and identify.jsonl there, a
line a set, and sets that are there are not asked again: an interrupted run goes on. Another folder
(`--results`) keeps the answers of another version.

- right: one effect whose class holds the truth, or "none" where there is none. A class with the
  small cubic stiffness beside a quadratic one counts as no further effect.
- honest: the truth in a class; "unknown" or "noise_rejected"; a drawn law where there is one; or
  "none" where the law changes χ² by less than 15 (`chi_squared` of the key).
- wrong: answered and not honest. "further": the truth is in a class, beside an effect that is not.
- frequency, damping: share of five points of the true backbone inside the 95 % bands of a joint
  fit; next, next speed: is the resonance of a level that was not measured, as that level would
  record it, inside what is predicted from its force? predicted: the probability that it is reached.
"""

import argparse
import contextlib
import json
import signal
import time
import traceback
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from pathlib import Path

import numpy as np

_BAND = 1.96
_DECADES = ["none", "damping law", "0.1 to 1", "1 to 10", "10 to 100", "100 to 1000"]
_AXES = {  # of the maps: value of a key, edges of the cells
    "damping ratio": (lambda k: k["damping_ratio"], [2e-4, 6e-4, 2e-3, 6e-3, 2e-2, 5.1e-2]),
    "levels": (lambda k: k["levels"], [1, 2, 3, 5, 7, 9]),
    "level frequency error": (lambda k: k["errors"]["frequency"], [0, 5e-4, 2e-3, 7e-3, 2e-2]),
}


def decade(key: dict) -> str:
    """Shift of the resonance in bandwidths, where the law shifts it."""
    if key["law"] == "none":
        return _DECADES[0]
    if key["law"] in ("coulomb", "quadratic_damping"):
        return _DECADES[1]
    return _DECADES[2 + int(np.clip(np.log10(key["share"]) + 1, 0, 3))]


_GROUPS = {
    "all": lambda _: "",
    "law": lambda k: k["law"],
    "shift": lambda k: f"{_DECADES.index(decade(k))} {decade(k)}",
    "levels": lambda k: k["levels"],
    "level errors": lambda k: (
        ("stated" if k["errors_stated"] else "not stated") if any(k["errors"].values()) else "no"
    ),
    "level frequency error": lambda k: k["errors"]["frequency"],
    "level gain error": lambda k: k["errors"]["gain"],
    "level phase error, rad": lambda k: round(k["errors"]["phase"], 3),
    "noise": lambda k: "stated" if k["noise_stated"] else "not stated",
    "side": lambda k: k["side"],
}


def diagnosed(sj, model, data, key: dict) -> dict:
    """The verdict on one set."""
    found = sj.diagnose_model(model, data)
    return {
        "verdict": str(found.verdict), "effects": list(found.effects),
        "candidates": [list(group) for group in found.candidates],
        "probability": float(found.probability),
        "probabilities": dict(list(found.probabilities.items())[:4]),
    }  # fmt: skip


def identified(sj, model, data, key: dict) -> dict:
    """Errors of a joint fit and of its prediction in 1σ."""
    fit, true, extra = sj.fit_jointly(data, model), key["backbone"], key["extra_level"]
    hertz = 2 * np.pi

    def values(displacement, **settings):
        at = np.atleast_1d(np.asarray(displacement, float))
        return sj.identify.fitted_values(fit, displacement=at, **settings)

    found = values(true["displacement_m"])
    off = np.asarray(found.natural_frequency) / hertz - true["frequency_hz"]
    damping = np.asarray(found.damping_ratio) - true["damping_ratio"]
    answer = {
        "converged": bool(fit.converged), "noise_scale": float(fit.noise.scale),
        "frequency": (off * hertz / np.asarray(found.natural_frequency_std)).tolist(),
        "damping": (damping / np.asarray(found.damping_ratio_std)).tolist(),
        "off_bandwidths": float(np.max(np.abs(off / (2 * np.array(true["damping_ratio"])
                                                     * true["frequency_hz"])))),
        "off_damping": float(np.max(np.abs(damping / true["damping_ratio"]))),
    }  # fmt: skip
    tip = sj.identify.predicted_resonance(fit, extra["force_n"])
    if not tip.probability > 0:
        return answer | {"predicted": 0.0, "next": None, "next speed": None}

    def place(true: float, quantiles) -> float:
        """Below and above the 95 % band it is beyond −1 and 1."""
        low, middle, high = np.asarray(quantiles)[[0, 2, -1]]
        return float((true - middle) / ((high if true > middle else low) - middle) *
                     np.sign(true - middle))  # fmt: skip

    return answer | {
        "predicted": float(tip.probability),
        "next": place(hertz * extra["recorded_frequency_hz"], tip.frequency),
        "next speed": place(extra["recorded_velocity_m_s"], tip.velocity),
    }


def marks(answer: dict, key: dict) -> dict[str, float]:
    """What a diagnosis is worth (see above)."""
    if "error" in answer:
        return {"error": 1.0}
    verdict, kinds, classes = answer["verdict"], key["kinds"], answer["candidates"]
    named = verdict in ("named", "ambiguous")
    there = named and bool(kinds) and any(set(kinds) & set(group) for group in classes)
    beside = {"cubic_stiffness"} if key["law"] == "quadratic" else set()
    further = [group for group in classes if not (set(kinds) | beside) & set(group)]
    nothing = verdict == "none" and not kinds
    honest = there or nothing or verdict in ("unknown", "noise_rejected")
    honest = honest or (verdict == "drawn" and bool(kinds))
    honest = honest or (verdict == "none" and not key["detectable"])
    given = {"right": (there and not further) or nothing, "honest": honest, "wrong": not honest,
             "further": there and bool(further),
             "answered": named or verdict == "none"}  # fmt: skip
    size = np.mean([len(group) for group in classes]) if named and classes else np.nan
    return {name: float(value) for name, value in given.items()} | {"size": size, "error": 0.0}


def inside(answer: dict, _: dict) -> dict[str, float]:
    """What of the truth is inside the bands."""
    if "error" in answer:
        return {"error": 1.0}
    score: dict[str, float] = {}
    for name, most in (("frequency", _BAND), ("damping", _BAND), ("next", 1), ("next speed", 1)):
        off = np.abs(np.array([answer[name]], float).ravel())
        score[name] = np.mean(off <= most) if np.isfinite(off).all() else np.nan
    further = {name: float(answer[name]) for name in ("predicted", "converged")}
    return score | further | {"error": 0.0}


_QUESTIONS = {
    "diagnose": (diagnosed, marks, ("right", "honest", "wrong")),
    "identify": (identified, inside, ("frequency", "damping", "next")),
}


def _too_long(*_: object) -> None:
    raise TimeoutError("stopped at the limit of time")


def asked(question: str, table: Path, key_file: Path, timeout: int) -> dict:
    """Ask one question of one set; an answer, or the error that came in its place."""
    import snrmjax as sj

    key, begin = json.loads(key_file.read_text(encoding="utf-8")), time.perf_counter()
    signal.signal(signal.SIGALRM, _too_long)
    signal.alarm(timeout)
    try:
        model = sj.read_model(table.with_suffix(".toml"))
        data = sj.read_steady_states(table, model)
        answer = _QUESTIONS[question][0](sj, model, data, key)
    except Exception as error:
        where = traceback.extract_tb(error.__traceback__)[-1]
        answer = {"error": f"{type(error).__name__}: {error}"[:300],
                  "at": f"{Path(where.filename).name}:{where.lineno}"}  # fmt: skip
    finally:
        signal.alarm(0)
    line = {"name": table.stem, "law": key["law"], "share": key["share"], **answer}
    return line | {"seconds": round(time.perf_counter() - begin, 2)}


def read_answers(results: Path) -> dict[str, dict]:
    """Answers by the names of their sets; a line that was cut off is left out."""
    answers = {}
    for line in results.read_text(encoding="utf-8").splitlines() if results.exists() else []:
        with contextlib.suppress(json.JSONDecodeError):
            answer = json.loads(line)
            answers[answer["name"]] = answer
    return answers


def ask_all(question: str, folder: Path, results: Path, jobs: int, timeout: int) -> None:
    """Ask one question of every set that has no answer yet."""
    known = read_answers(results)
    tables = [t for t in sorted((folder / "sets").glob("*.csv")) if t.stem not in known]
    cut_off = results.exists() and not results.read_text(encoding="utf-8").endswith("\n")
    # A fork would take over the threads of what was imported.
    with ProcessPoolExecutor(jobs, get_context("spawn")) as pool, results.open("a") as file:
        waiting = [pool.submit(asked, question, table, folder / "keys" / f"{table.stem}.json",
                               timeout) for table in tables]  # fmt: skip
        for one in as_completed(waiting):
            answer = one.result()
            file.write("\n" * cut_off + json.dumps(answer) + "\n")
            cut_off = False
            file.flush()
            said = answer.get("error") or answer.get("candidates") or answer.get("frequency")
            print(answer["name"], answer["law"], f"{answer['share']:.3g}",
                  answer.get("verdict", ""), said, answer["seconds"], flush=True)  # fmt: skip


def _mean(scores: list[dict], name: str) -> float:
    values = [score[name] for score in scores if np.isfinite(score.get(name, np.nan))]
    return float(np.mean(values)) if values else np.nan


def report(question: str, folder: Path, results: Path) -> None:
    """Print the table of a question and draw its maps."""
    _, judged, shown = _QUESTIONS[question]
    rows = []
    for name, answer in sorted(read_answers(results).items()):
        key = json.loads((folder / "keys" / f"{name}.json").read_text(encoding="utf-8"))
        rows.append((key, answer, judged(answer, key)))
    if not rows:
        return
    heads = list(max((score for *_, score in rows), key=len))
    print(f"\n{question}: {len(rows)} sets; means over those without an error")
    for title, group in _GROUPS.items():
        print(f"\n{title:24s} sets" + "".join(f"{head:>11s}" for head in heads) + "  seconds")
        for value in sorted({group(key) for key, *_ in rows}):
            here = [row for row in rows if group(row[0]) == value]
            means = "".join(f"{_mean([row[2] for row in here], head):11.2f}" for head in heads)
            seconds = np.median([answer["seconds"] for _, answer, _ in here])
            print(f"{value!s:24s} {len(here):4d}{means}  {seconds:.1f}")
    print()
    for key, answer, score in rows:
        about = f"{key['name']} {key['law']} {key['share']:.3g}"
        if "error" in answer:
            print(f"error: {about}: {answer['error']} ({answer['at']})")
        elif score.get("wrong"):
            print(f"wrong: {about}: {answer['verdict']} {answer['candidates']}"
                  f" {answer['probability']:.3f}")  # fmt: skip
    draw_maps(rows, shown, results.with_suffix(".png"))


def draw_maps(rows: list[tuple[dict, dict, dict]], shown: tuple[str, ...], file: Path) -> None:
    """Heat maps over shift and, side by side, the other axes; a line a score."""
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    figure, panels = plt.subplots(len(shown), len(_AXES), figsize=(16, 4.4 * len(shown)))
    for line, head in zip(panels, shown, strict=True):
        for panel, (label, (value, edges)) in zip(line, _AXES.items(), strict=True):
            cells = np.full((len(_DECADES), len(edges) - 1), np.nan)
            for i, j in np.ndindex(cells.shape):
                here = [score for key, _, score in rows if decade(key) == _DECADES[i]
                        and edges[j] <= value(key) < edges[j + 1]]  # fmt: skip
                cells[i, j] = _mean(here, head)
                if np.isfinite(cells[i, j]):
                    text = f"{100 * cells[i, j]:.0f} %\nof {len(here)}"
                    panel.text(j, i, text, ha="center", va="center", fontsize=8)
            colours = "Reds" if head == "wrong" else "RdYlGn"
            panel.imshow(cells, colours, vmin=0, vmax=1, alpha=0.6, aspect="auto", origin="lower")
            panel.set_xticks(np.arange(len(edges)) - 0.5, [f"{edge:g}" for edge in edges])
            panel.set_yticks(range(len(_DECADES)), _DECADES)
            panel.set(xlabel=label, title=head)
        line[0].set_ylabel("shift in half-power bandwidths")
    figure.tight_layout()
    figure.savefig(file, dpi=110)
    plt.close(figure)
    print(f"\nmaps: {file}")


def main() -> None:
    """Ask, and report."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--only", choices=tuple(_QUESTIONS))
    parser.add_argument("--results", type=Path, help="folder of the answers, in place of DIR")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--timeout", type=int, default=300, help="seconds a set")
    parser.add_argument("--report", action="store_true", help="no new answers")
    given = parser.parse_args()
    place = given.results or given.folder
    place.mkdir(parents=True, exist_ok=True)
    for question in (given.only,) if given.only else tuple(_QUESTIONS):
        results = place / f"{question}.jsonl"
        if not given.report:
            ask_all(question, given.folder, results, given.jobs, given.timeout)
        report(question, given.folder, results)


if __name__ == "__main__":
    main()
