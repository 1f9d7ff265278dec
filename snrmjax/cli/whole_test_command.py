"""The command `test`: one report from a folder of laboratory files."""

from pathlib import Path
from typing import Annotated, Any

import typer

from snrmjax.cli.console import print_line, print_result, written
from snrmjax.cli.options import Out, stated_options, with_options
from snrmjax.pipelines.options import WholeTestOptions
from snrmjax.report.writing import staged


def whole_test(
    folder: Annotated[
        Path,
        typer.Argument(
            help="Folder with the files of one test: steady states (CSV), time records and "
            "frequency responses (UFF, MATLAB, HDF5, netCDF, TDMS, CSV), model.toml if there is "
            "one.",
            metavar="FOLDER",
            show_default=False,
        ),
    ],
    out: Out,
    **options: Any,
) -> None:
    """From a folder of raw files to one report: check, linear modes, backbone, diagnosis.

    Files are classified by their content. Where the input is ambiguous the command stops with a
    question and the option that answers it.

    Writes report.html (zoom, hover, linked levels), measured.csv, check.json, model.toml
    where the linear modes are identified here, and the files of identify and diagnose in folders of
    these names.
    """
    from snrmjax.pipelines.whole_test import run_whole_test
    from snrmjax.report.pages import whole_test as page

    with staged(out) as target:
        result = run_whole_test(
            folder, stated_options(WholeTestOptions, options), progress=_print_stage
        )
        page.write(target, result)
    print_result(result)
    written(out)


def _print_stage(stage: str, seconds: float) -> None:
    print_line(f"{stage}: {seconds:.1f} s")


with_options(whole_test, WholeTestOptions)
