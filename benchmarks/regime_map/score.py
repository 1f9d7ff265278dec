"""Score of `snrmjax` on the map of the regime: answers, honesty and bands, as tables.

    python benchmarks/regime_map/score.py --folder DIR [--only diagnose] [--jobs 2] [--write]
    python benchmarks/regime_map/score.py --folder DIR --report            tables alone

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

import contextlib
import json
import signal
import sys
import time
import traceback
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from pathlib import Path

import numpy as np

sys.path.append(str(Path(__file__).resolve().parents[1]))
from harness import options, teller

tell = teller(__file__)

_BAND = 1.96
_DECADES = ["none", "damping law", "0.1 to 1", "1 to 10", "10 to 100", "100 to 1000"]


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
    "diagnose": (diagnosed, marks),
    "identify": (identified, inside),
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


def report(question: str, folder: Path, results: Path) -> None:
    """Print the means of a question over groups of the sets, errors aside, and what was wrong."""
    import pandas as pd

    judged = _QUESTIONS[question][1]
    rows = []
    for name, answer in sorted(read_answers(results).items()):
        key = json.loads((folder / "keys" / f"{name}.json").read_text(encoding="utf-8"))
        groups = {f"_{title}": str(group(key)) for title, group in _GROUPS.items()}
        score = judged(answer, key)
        rows.append({"sets": 1, **score, "seconds": answer["seconds"], **groups})
        about = f"{name} {key['law']} {key['share']:.3g}"
        if "error" in answer:
            print(f"error: {about}: {answer['error']} ({answer['at']})")
        elif score.get("wrong"):
            print(f"wrong: {about}: {answer['verdict']} {answer['candidates']}")
    table = pd.DataFrame(rows)
    for title in _GROUPS if len(table) else ():
        groups = table.groupby(f"_{title}")
        means = groups.mean(numeric_only=True).assign(sets=groups.size())
        print(f"\n{question}, {title}\n{means.round(2).to_string()}")


def main() -> None:
    """Ask, and report."""
    given = options(
        __doc__, folder=Path, only=list(_QUESTIONS), results=Path, jobs=2, timeout=300, report=False
    )
    place = given.results or given.folder
    place.mkdir(parents=True, exist_ok=True)
    for question in given.only:
        results = place / f"{question}.jsonl"
        if not given.report:
            ask_all(question, given.folder, results, given.jobs, given.timeout)
        report(question, given.folder, results)
        if given.write:
            for name, answer in sorted(read_answers(results).items()):
                tell(question=question, **answer | {"name": name})


if __name__ == "__main__":
    main()
