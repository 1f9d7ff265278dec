"""Files of results: `write_results`, and folders that are written completely or not at all."""

import importlib
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any

from snrmjax.io.files import FilePath
from snrmjax.numerics.rules import InputError

_unfinished: list[Callable[[], None]] = []  # how to remove each folder that is being written
# By the names of classes: no page is imported before there is a result of it.
_PAGES = {
    "Checkup": "checkup",
    "Comparison": "comparison",
    "DiagnosedTest": "diagnosis",
    "IdentifiedTest": "identified_test",
    "Imported": "imports",
    "LinearModesFound": "modes",
    "Reduction": "reduction",
    "SimulatedMode": "simulation",
    "SimulatedResponses": "simulation",
    "WholeTest": "whole_test",
}


def page_of(result: object) -> ModuleType:
    """The page module of a pipeline's result, with `write` and `headline`."""
    name = _PAGES.get(type(result).__name__)
    if name is None:
        raise InputError(
            f"a `{type(result).__name__}` has no files; results of pipelines have: "
            f"{', '.join(_PAGES)}."
        )
    return importlib.import_module(f"snrmjax.report.pages.{name}")


def write_results(result: object, out: FilePath, **settings: Any) -> None:
    """Write the tables, figures and page of a pipeline's result into a folder.

    Arguments: `result` of `sj.pipelines`; `out` is made if missing, files of the same names are
    replaced, all together or none; `settings` of the page, such as `title`.
    Raises `ValueError` for other results, and for a folder that cannot be written.
    """
    page = page_of(result)
    with staged(Path(out)) as folder:
        page.write(folder, result, **settings)


@contextmanager
def staged(out: Path) -> Iterator[Path]:
    """A folder to write into whose files move to `out` together, or not at all."""
    out = Path(os.path.abspath(out))
    if out.exists() and not out.is_dir():
        raise InputError(f"--out {out} is a file, but a folder is expected.")
    made = [p for p in (out, *out.parents) if not p.exists()]
    try:
        out.mkdir(parents=True, exist_ok=True)
        staging = Path(tempfile.mkdtemp(prefix=".snrmjax-", dir=out))
    except OSError as error:
        raise InputError(f"--out {out} cannot be written: {error.strerror}.") from error
    done = False

    def discard() -> None:
        shutil.rmtree(staging)
        if not done:
            for folder in made:
                folder.rmdir()

    _unfinished.append(discard)
    try:
        yield staging
        for file in sorted(one for one in staging.rglob("*") if one.is_file()):
            target = out / file.relative_to(staging)
            target.parent.mkdir(parents=True, exist_ok=True)
            os.replace(file, target)
        done = True
    finally:
        _unfinished.remove(discard)
        discard()


def discard_unfinished() -> None:
    """Remove staged files that are not yet moved: for a process that ends at once."""
    while _unfinished:
        _unfinished.pop()()
