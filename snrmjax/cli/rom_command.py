"""The command `rom`: a reduced-order model from finite elements."""

from pathlib import Path
from typing import Annotated, Any

import typer

from snrmjax.cli.console import console, print_line, print_result, written
from snrmjax.cli.options import Out, stated_options, with_options
from snrmjax.pipelines.options import ReduceOptions
from snrmjax.report.writing import staged

_STEPS_A_LINE = 3  # steps of the study between lines in a log


def rom(
    out: Out,
    beam: Annotated[
        Path | None,
        typer.Argument(
            help="Beam or arch of the built-in finite elements (TOML): material, section, "
            "geometry, supports, modes.",
            metavar="BEAM",
            show_default=False,
        ),
    ] = None,
    **options: Any,
) -> None:
    """Condense static load cases of finite elements to a reduced model.

    Writes model.toml (ready for simulate and nnm), load_cases.csv, summary.json, figures (PNG)
    and report.html.
    """
    from snrmjax.pipelines.reduce import read_reduction_source, reduce_model
    from snrmjax.report.pages import reduction

    stated = stated_options(ReduceOptions, options)
    with staged(out) as folder:
        source = read_reduction_source(beam, stated)
        with console.status("static load cases …"):
            result = reduce_model(source, study=not stated.no_study, report=_progress)
        reduction.write(folder, result)
    print_result(result)
    written(out)


with_options(rom, ReduceOptions)


def _progress(done: int, scales: int) -> None:
    if not console.is_terminal and (done % _STEPS_A_LINE == 0 or done == scales):
        print_line(f"load scales: {done} of {scales}")
