"""What the commands say on standard error, and folders that are written whole or not at all."""

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from rich.console import Console

console = Console(stderr=True, highlight=False, soft_wrap=True)


def say(message: str) -> None:
    """A line on progress or on a result."""
    console.print(message, markup=False)


def warn(message: str) -> None:
    """A note that the reader of the results should know."""
    console.print(f"note: {message}", style="yellow", markup=False)


def refuse(message: str) -> None:
    """What is wrong with the input."""
    console.print(f"error: {message}", style="red", markup=False)


@contextmanager
def staged(out: Path) -> Iterator[Path]:
    """A folder to write into whose files move to `out` together, or not at all."""
    out = Path(os.path.abspath(out))
    if out.exists() and not out.is_dir():
        raise ValueError(f"--out {out} is a file, but a folder is expected.")
    made = [p for p in (out, *out.parents) if not p.exists()]
    try:
        out.mkdir(parents=True, exist_ok=True)
        staging = Path(tempfile.mkdtemp(prefix=".snrmjax-", dir=out))
    except OSError as error:
        raise ValueError(f"--out {out} cannot be written: {error.strerror}.") from error
    done = False
    try:
        yield staging
        for file in sorted(one for one in staging.rglob("*") if one.is_file()):
            target = out / file.relative_to(staging)
            target.parent.mkdir(parents=True, exist_ok=True)
            os.replace(file, target)
        done = True
    finally:
        shutil.rmtree(staging)
        if not done:
            for folder in made:
                folder.rmdir()
