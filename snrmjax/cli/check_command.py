"""The command `check`: errors of import and of the test, before anything is identified."""

from pathlib import Path
from typing import Annotated

import typer

from snrmjax.cli.console import print_line, print_result
from snrmjax.cli.options import FILES, Out
from snrmjax.report.writing import staged


def check(
    data: Annotated[
        list[Path],
        typer.Argument(
            help="Measured steady states (CSV), as for identify; several files of one structure "
            "are compared.",
            metavar="DATA…",
            show_default=False,
        ),
    ],
    out: Out,
    model: Annotated[
        Path | None,
        typer.Option(
            help="Linear model of the structure (TOML); without it scales are not checked.",
            metavar="MODEL",
            rich_help_panel=FILES,
            show_default=False,
        ),
    ] = None,
    record: Annotated[
        list[Path] | None,
        typer.Option(
            help="Time record of the same test (UFF, MATLAB, HDF5, TDMS, CSV; repeatable).",
            metavar="FILE",
            rich_help_panel=FILES,
            show_default=False,
        ),
    ] = None,
) -> None:
    """Look for errors of import and of the test before identification.

    Conjugated responses, accelerations or displacements for velocities, volts for newtons, rms for
    peak, degrees for radians, clipped channels, unsettled steps, drop-out and harmonics of the
    force, drift, files of different structures, shapes of another scale, aliased frequencies; each
    with its evidence and correction, as an import command where possible.

    A common scale error of force and response cannot be detected: rms for peak in both, or one
    wrong range for both, keeps their ratio and changes all amplitudes.

    Writes check.json, a list that is empty without findings; the exit code is 0 either way.
    """
    from snrmjax.pipelines.check import check_files
    from snrmjax.report.pages import checkup

    with staged(out) as folder:
        result = check_files(data, model, record or ())
        checkup.write(folder, result)
    print_result(result)
    print_line(f"written to {out / 'check.json'}")
