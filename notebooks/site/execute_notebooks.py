"""Run the notebooks and keep them with their outputs, for the site's tutorials.

    python notebooks/site/execute_notebooks.py [--only 03]

Writes `executed/NAME.ipynb` beside this file. A notebook is run again only after a change of its
script or of the package. Measured data are looked for as the notebooks do: in the folder that
the environment variable MEASURED_DATA names, else in `shared/data` beside the project.
"""

import argparse
import hashlib
import os
import sys
import time
from pathlib import Path

import jupytext
import nbclient
import nbformat

SITE = Path(__file__).resolve().parent
NOTEBOOKS = SITE.parent
EXECUTED = SITE / "executed"
DPI = 150  # of figures


def scripts() -> list[Path]:
    """Every notebook, in the order of its number."""
    return sorted(NOTEBOOKS.glob("[0-9]*.py"))


def key(script: Path) -> str:
    """What the outputs of a notebook depend on: its script and the package's source."""
    package = NOTEBOOKS.parent / "snrmjax"
    source = sorted(p for p in package.rglob("*") if p.suffix in (".py", ".pyi", ".html"))
    digest = hashlib.sha256()
    for path in (script, *source):
        digest.update(path.read_bytes())
    return digest.hexdigest()


def execute(script: Path) -> nbformat.NotebookNode:
    """The notebook with its outputs.

    A cell that raises SystemExit ends it, as where measured data are not there; a cell that fails
    raises `nbclient.exceptions.CellExecutionError`.
    """
    depends_on, notebook = key(script), jupytext.read(script)
    client = nbclient.NotebookClient(
        notebook,
        kernel_name="python3",
        timeout=None,
        extra_arguments=[f"--InlineBackend.print_figure_kwargs={{'dpi': {DPI}}}"],
        coalesce_streams=True,
    )
    project = os.pathsep.join(filter(None, (str(NOTEBOOKS.parent), os.environ.get("PYTHONPATH"))))
    ended = False
    try:
        client.execute(cwd=str(NOTEBOOKS), env={**os.environ, "PYTHONPATH": project})
    except nbclient.exceptions.CellExecutionError as error:
        if error.ename != "SystemExit":
            raise
        ended = True
        # What it printed, without the console's advice on how to exit.
        for cell in (cell for cell in notebook.cells if cell.cell_type == "code"):
            cell.outputs = [output for output in cell.outputs if output.get("name") == "stdout"]
    notebook.metadata["snrmjax"] = {"key": depends_on, "ended_early": ended}
    return notebook


def kept(script: Path) -> nbformat.NotebookNode | None:
    """The executed notebook, if its outputs are those of this script and this package."""
    path = EXECUTED / f"{script.stem}.ipynb"
    notebook = nbformat.read(path, 4) if path.is_file() else None
    if notebook is None or notebook.metadata["snrmjax"]["key"] != key(script):
        return None
    return notebook


def main() -> None:
    """Run what is not fresh."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--only", metavar="NUMBER", help="such as 03")
    only = parser.parse_args().only
    chosen = [script for script in scripts() if only is None or script.stem.startswith(only)]
    if not chosen:
        sys.exit(f"there is no notebook {only} in {NOTEBOOKS}")
    EXECUTED.mkdir(exist_ok=True)
    for script in chosen:
        before = kept(script)
        if before is not None and not before.metadata["snrmjax"]["ended_early"]:
            print(f"{script.stem}: unchanged")
            continue
        start = time.perf_counter()
        nbformat.write(execute(script), EXECUTED / f"{script.stem}.ipynb")
        print(f"{script.stem}: {time.perf_counter() - start:.0f} s", flush=True)


if __name__ == "__main__":
    main()
