"""What every benchmark shares: options from defaults, results as JSON lines, medians of timings."""

import argparse
import json
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

HERE = Path(__file__).resolve().parent
WRITE = "--write"


def options(doc: str | None, **defaults: Any) -> argparse.Namespace:
    """Options by name and default: a list takes several, a type has no default, False is a flag."""
    parser = argparse.ArgumentParser(description=(doc or "").splitlines()[0])
    parser.add_argument(WRITE, action="store_true", help="keep the lines beside the benchmark")
    for name, default in defaults.items():
        flag = f"--{name.replace('_', '-')}"
        if default is False:
            parser.add_argument(flag, action="store_true")
        elif isinstance(default, type):
            parser.add_argument(flag, type=default)
        elif isinstance(default, list | tuple):
            kind = type(default[0])
            parser.add_argument(flag, type=kind, nargs="+", default=list(default))
        else:
            parser.add_argument(flag, type=type(default), default=default)
    return parser.parse_args()


def teller(file: str, *, append: bool = False) -> Callable[..., None]:
    """The function that prints a JSON line of a benchmark, and with `--write` keeps all of a run.

    They are kept in NAME.jsonl beside the benchmark NAME.py, or beside the folder NAME of `file`,
    in place of those of the last run; with `append` after them.
    """
    path = Path(file).resolve()
    name = path.stem if path.parent == HERE else path.parent.name
    kept = HERE / f"{name}.jsonl"
    lines = kept.read_text(encoding="utf-8").splitlines() if append and kept.exists() else []

    def tell(**fields: Any) -> None:
        lines.append(json.dumps({"benchmark": name, **short(fields)}))
        print(lines[-1], flush=True)
        if WRITE in sys.argv:
            kept.write_text("\n".join(lines) + "\n", encoding="utf-8")

    return tell


def short(value: Any) -> Any:
    """A value as JSON has it: numbers with four digits, null for what is none."""
    if isinstance(value, dict):
        return {str(key): short(one) for key, one in value.items()}
    if hasattr(value, "tolist"):  # arrays and their numbers
        value = value.tolist()
    if isinstance(value, list | tuple):
        return [short(one) for one in value]
    if isinstance(value, float):
        return float(f"{value:.4g}") if np.isfinite(value) else None
    return value


def seconds_of(function: Callable[[], Any]) -> tuple[float, Any]:
    """Seconds of a call, and what it gave."""
    begin = time.perf_counter()
    result = function()
    return time.perf_counter() - begin, result


def medians(rounds: int, **functions: Callable[[], Any]) -> dict[str, float]:
    """Median seconds of functions that take turns, after one run of each."""
    seconds: dict[str, list[float]] = {name: [] for name in functions}
    for turn in range(rounds + 1):
        for name, function in functions.items():
            spent, _ = seconds_of(function)
            if turn:
                seconds[name].append(spent)
    return {name: float(np.median(times)) for name, times in seconds.items()}
