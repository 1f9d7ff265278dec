"""The command `import`: what a laboratory's files hold, and their way to our tables."""

import os
from pathlib import Path
from typing import Annotated

import typer

from snrmjax.cli.console import say, staged, warn
from snrmjax.cli.options import FILES

_CHANNELS, _MEANING, _TEXT = "Channels and columns", "What the numbers are", "Text files"


def import_(
    files: Annotated[
        list[Path],
        typer.Argument(
            help="UFF, MATLAB, HDF5, netCDF, TDMS, CSV or other text; several files are one test.",
            metavar="FILE…",
            show_default=False,
        ),
    ],
    out: Annotated[
        Path | None,
        typer.Option(
            help="Folder for measured.csv (or record.csv) and map.toml; without channels and map "
            "nothing is written.",
            metavar="DIR",
            rich_help_panel=FILES,
        ),
    ] = None,
    map_file: Annotated[
        Path | None,
        typer.Option(
            "--map",
            help="Map of an earlier import (map.toml); options win over it.",
            metavar="TOML",
            rich_help_panel=FILES,
        ),
    ] = None,
    force: Annotated[
        str,
        typer.Option(
            help="Channel or column of the force.", metavar="NAME", rich_help_panel=_CHANNELS
        ),
    ] = "",
    response: Annotated[
        list[str] | None,
        typer.Option(
            help="Channel or column of a response, as CH2:acceleration or CH2:acceleration:g "
            "(repeatable, one a sensor).",
            metavar="NAME[:KIND[:UNIT]]",
            rich_help_panel=_CHANNELS,
        ),
    ] = None,
    sensor: Annotated[
        list[str] | None,
        typer.Option(
            help="Names of the sensors as the model has them, in the order of --response.",
            metavar="NAME",
            rich_help_panel=_CHANNELS,
        ),
    ] = None,
    frequency: Annotated[
        str,
        typer.Option(help="Column of the frequency.", metavar="NAME", rich_help_panel=_CHANNELS),
    ] = "",
    phase: Annotated[
        list[str] | None,
        typer.Option(
            help="Column of the phase of each response.",
            metavar="NAME",
            rich_help_panel=_CHANNELS,
        ),
    ] = None,
    imaginary: Annotated[
        list[str] | None,
        typer.Option(
            help="Column of the imaginary part of each response (lock-in Y).",
            metavar="NAME",
            rich_help_panel=_CHANNELS,
        ),
    ] = None,
    amplitude_std: Annotated[
        list[str] | None,
        typer.Option(
            help="Column of the standard deviation of each response's amplitude, in its unit "
            "(default: by name, as R_std beside R).",
            metavar="NAME",
            rich_help_panel=_CHANNELS,
        ),
    ] = None,
    phase_std: Annotated[
        list[str] | None,
        typer.Option(
            help="Column of the standard deviation of each phase, in its unit (default: by name).",
            metavar="NAME",
            rich_help_panel=_CHANNELS,
        ),
    ] = None,
    force_phase: Annotated[
        str,
        typer.Option(
            help="Column of the force's own phase (default: phases are relative to the force).",
            metavar="NAME",
            rich_help_panel=_CHANNELS,
        ),
    ] = "",
    drive: Annotated[
        str,
        typer.Option(
            help="Channel of the generator, by which steps are recognised.",
            metavar="NAME",
            rich_help_panel=_CHANNELS,
        ),
    ] = "",
    dataset: Annotated[
        str,
        typer.Option(
            help="Which of the file's datasets.", metavar="NAME", rich_help_panel=_CHANNELS
        ),
    ] = "",
    level: Annotated[
        str,
        typer.Option(
            help="What numbers the levels: a column, or file, force, drive, runs, order, z.",
            metavar="RULE",
            rich_help_panel=_CHANNELS,
        ),
    ] = "",
    unit: Annotated[
        str,
        typer.Option(
            help="Unit of the responses: m/s, mm/s, g, m/s^2, mm, …; of our own table, what its "
            "velocity columns are.",
            metavar="UNIT",
            rich_help_panel=_MEANING,
        ),
    ] = "",
    force_unit: Annotated[
        str,
        typer.Option(
            help="Unit of the force: N, lbf, …; V for a drive voltage.",
            metavar="UNIT",
            rich_help_panel=_MEANING,
        ),
    ] = "",
    frequency_unit: Annotated[
        str, typer.Option(help="Hz or rad/s.", metavar="UNIT", rich_help_panel=_MEANING)
    ] = "",
    phase_unit: Annotated[
        str, typer.Option(help="deg or rad.", metavar="UNIT", rich_help_panel=_MEANING)
    ] = "",
    phase_sign: Annotated[
        str,
        typer.Option(
            help="lead: a positive phase is ahead of the force; lag: behind it.",
            metavar="SIGN",
            rich_help_panel=_MEANING,
        ),
    ] = "",
    amplitude: Annotated[
        str,
        typer.Option(help="peak, rms or peak_to_peak.", metavar="SIZE", rich_help_panel=_MEANING),
    ] = "",
    over_force: Annotated[
        bool,
        typer.Option(
            "--over-force",
            help="Responses of a table are divided by the force.",
            rich_help_panel=_MEANING,
        ),
    ] = False,
    force_amplitude: Annotated[
        list[str] | None,
        typer.Option(
            help="Force in N behind frequency responses: one for all, one a set (repeatable), or "
            "z: the z axis states it.",
            metavar="N",
            rich_help_panel=_MEANING,
        ),
    ] = None,
    record: Annotated[
        str,
        typer.Option(
            help="What a time record is: steps, sweep, decay, broadband.",
            metavar="KIND",
            rich_help_panel=_MEANING,
        ),
    ] = "",
    separator: Annotated[
        str,
        typer.Option(help="comma, semicolon, tab or space.", metavar="NAME", rich_help_panel=_TEXT),
    ] = "",
    decimal: Annotated[
        str, typer.Option(help="point or comma.", metavar="NAME", rich_help_panel=_TEXT)
    ] = "",
    header_row: Annotated[
        int, typer.Option(help="Row of the names, from 1 (0: found).", min=0, rich_help_panel=_TEXT)
    ] = 0,
) -> None:
    """Read a laboratory's files and write steady states as identify takes them.

    Without channels and map it prints what the files hold, and a command that imports them. With
    them it writes measured.csv, and map.toml with all that was stated, found and assumed, for the
    next test. Records of free decays and broadband tests are written as record.csv.
    """
    from snrmjax.io.exchange.exports import write_import
    from snrmjax.io.exchange.import_options import map_of_options
    from snrmjax.io.exchange.importing import import_files
    from snrmjax.io.exchange.listing import listed_contents, suggested_command
    from snrmjax.io.laboratory.reading import read_laboratory_file

    told = map_of_options(
        map_file,
        response or (),
        unit=unit,
        sensor=sensor or (),
        phase=phase or (),
        imaginary=imaginary or (),
        amplitude_std=amplitude_std or (),
        phase_std=phase_std or (),
        force_amplitude=force_amplitude or (),
        words={
            "force": force,
            "frequency": frequency,
            "force_phase": force_phase,
            "drive": drive,
            "dataset": dataset,
            "level": level,
            "force_unit": force_unit,
            "frequency_unit": frequency_unit,
            "phase_unit": phase_unit,
            "phase_sign": phase_sign,
            "amplitude": amplitude,
            "record": record,
            "separator": separator,
            "decimal": decimal,
        },
        over_force=over_force,
        header_row=header_row,
    )
    if told.is_empty and (map_file is None) and out is None:
        for path in files:
            held = read_laboratory_file(path, told.text_format)
            typer.echo("\n".join((*listed_contents(held), *suggested_command([path], held))))
        return
    if out is None:
        raise ValueError("where shall measured.csv be written? --out DIR.")
    found = import_files(files, told)
    with staged(out) as folder:
        written = write_import(folder, found, [os.path.relpath(one, out) for one in files])
    for note in dict.fromkeys(found.notes):
        warn(note)
    for key, why in found.assumed.items():
        warn(f"assumed {key}: {why}")
    if found.states is not None:
        for line in found.states.summary()[:3]:
            say(line)
    say(f"written to {out}: {', '.join(written)}")
