"""The command `check`: errors of import and of the test, before anything is identified."""

from pathlib import Path
from typing import Annotated

import typer

from snrmjax.cli.console import say, staged, warn
from snrmjax.cli.options import FILES, Out
from snrmjax.io.models import read_model
from snrmjax.io.tables import read_steady_states


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
            help="Linear model of the structure (TOML); without it scales are not looked at.",
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
    force, drift, files of different structures, shapes of another scale, folded frequencies; each
    with its evidence and what mends it, as an import where it can. Nothing is said where all
    is well.

    What scales force and response alike cannot be seen: rms for peak in both, or one wrong range
    for both, leaves their ratio right and moves all amplitudes.

    Writes check.json, a list that is empty when all is well; the exit code is 0 either way.
    """
    from snrmjax.doctor.check import check_test
    from snrmjax.io.laboratory.checkups import read_recordings, write_checkup
    from snrmjax.report.whole_test.mends import FilesRead, with_imports

    with staged(out) as folder:
        structure = None if model is None else read_model(model)
        tables = [read_steady_states(path, structure) for path in data]
        recordings = [one for path in record or () for one in read_recordings(path)]
        found = check_test(tables, structure, recordings)
        found = with_imports(found, FilesRead(tuple(data)))
        write_checkup(folder / "check.json", found)
    for note in found.notes:
        warn(str(note))
    if not found.findings:
        say("nothing found")
    for one in found.findings:
        say(f"{one.severity}: {one.kind} in {one.where}: {one.evidence}")
        say(f"  mend: {one.mend}")
    say(f"written to {out / 'check.json'}")
