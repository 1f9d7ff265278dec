"""The command `test`: a folder of a laboratory's files to one report."""

import time
from pathlib import Path
from typing import Annotated, Any

import typer

from snrmjax.cli.console import say, staged, warn
from snrmjax.cli.options import FILES, OptionRow, Out, with_options


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

    Files are sorted by their content. Where a guess would be needed the command stops with a
    question and the option that answers it.

    Writes report.html (zoom, hover, linked levels), measured.csv, check.json, model.toml
    where the linear modes were found here, and the files of identify and diagnose in folders of
    these names.
    """
    from snrmjax.report.whole_test.folder_contents import read_test_files
    from snrmjax.report.whole_test.mends import files_of_test
    from snrmjax.report.whole_test.stages import TestRequest, run_whole_test

    with staged(out) as target:
        began = time.perf_counter()
        files = read_test_files(folder, options["model"])
        say(f"files: {time.perf_counter() - began:.1f} s")
        read = files_of_test(folder, files)
        request = TestRequest(
            *(options["drive_point"], options["go_on"], options["diagnose"]), read=read
        )
        name = folder.resolve().name
        notes, lines = run_whole_test(target, files, name, request, progress=say)
    for note in notes:
        warn(note)
    for line in lines:
        say(line)
    say(f"written to {out}: open {out / 'report.html'}")


_MODEL = OptionRow(
    "model", Path, "Linear model, in place of the folder's or of frequency responses.", "MODEL"
)
_FURTHER = (
    OptionRow("drive_point", str, "Sensor at the force, by which mode shapes are scaled.", "NAME"),
    OptionRow("go_on", bool, "Go on in spite of errors that the check finds.", None, False),
    OptionRow(
        "diagnose", bool, "Look for what the model lacks, too (a minute or more).", None, True
    ),
)
with_options(whole_test, {FILES: (_MODEL,), None: _FURTHER})
