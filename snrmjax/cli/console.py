"""What the commands say on standard error, and how they end."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from rich.console import Console

from snrmjax.report.writing import page_of

console = Console(stderr=True, highlight=False, soft_wrap=True)


def say(message: str) -> None:
    """A line on progress or on a result."""
    console.print(message, markup=False)


def warn(message: object) -> None:
    """A note that the reader of the results should know."""
    console.print(f"note: {message}", style="yellow", markup=False)


def refuse(message: str) -> None:
    """What is wrong with the input."""
    console.print(f"error: {message}", style="red", markup=False)


def tell(result: Any, notes: Iterable[object] | None = None) -> None:
    """The notes of a pipeline's result, and its headline."""
    for note in result.notes if notes is None else notes:
        warn(note)
    for line in page_of(result).headline(result):
        say(line)


def written(out: Path, page: str = "report.html") -> None:
    """Where the results are."""
    say(f"written to {out}: open {out / page}" if page else f"written to {out}")
