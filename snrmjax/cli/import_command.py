"""The command `import`: contents of laboratory files, and their conversion to our tables."""

import dataclasses
import os
from pathlib import Path
from typing import Annotated, Any

import typer

from snrmjax.cli.console import print_line, print_result
from snrmjax.cli.options import FILES, with_options
from snrmjax.io.exchange.import_map import KEYS, RESPONSE_KEYS, ImportMap, MapKey
from snrmjax.numerics.rules import InputError
from snrmjax.pipelines.options import option
from snrmjax.report.writing import staged


def import_(
    files: Annotated[
        list[Path],
        typer.Argument(
            help="UFF, MATLAB, HDF5, netCDF, TDMS, LabVIEW, other text; several files: one test.",
            metavar="FILE…",
            show_default=False,
        ),
    ],
    out: Annotated[
        Path | None,
        typer.Option(
            help="Folder for measured.csv (or record.csv) and map.toml.",
            metavar="DIR",
            rich_help_panel=FILES,
        ),
    ] = None,
    map_file: Annotated[
        Path | None,
        typer.Option(
            "--map",
            help="Map of an earlier import (map.toml); options override it.",
            metavar="TOML",
            rich_help_panel=FILES,
        ),
    ] = None,
    **options: Any,
) -> None:
    """List the contents of laboratory files, or convert them to measured.csv.

    Without channels and map it writes nothing: it prints the contents of the files and a command
    that imports them. With them it writes measured.csv, steady states for identify, and map.toml
    with all that was stated, detected and assumed, for the next test. Records of free decays
    and broadband tests are written as record.csv.
    """
    from snrmjax.io.exchange.import_map import map_of_options
    from snrmjax.pipelines.imports import import_test, list_contents
    from snrmjax.report.pages import imports as page

    if map_file is None and out is None and map_of_options(None, options).is_empty:
        typer.echo("\n".join(list_contents(files, **options)))
        return
    if out is None:
        raise InputError("where shall measured.csv be written? State `--out DIR`.")
    imported = import_test(files, map_file, **options)
    with staged(out) as folder:
        written = page.write(folder, imported, files=[os.path.relpath(file, out) for file in files])
    print_result(imported, dict.fromkeys(imported.notes))
    print_line(f"written to {out}: {', '.join(written)}")


_RESPONSE = MapKey(
    "channel or column of a response, as CH2:acceleration or CH2:acceleration:g; one per sensor",
    "NAME[:KIND[:UNIT]]",
    None,
)


def _field(name: str, key: MapKey) -> tuple[str, Any, Any]:
    """A key of the map as an option: a switch, a number, a word, or repeated words."""
    default: Any = ImportMap._field_defaults.get(name, ())
    several = isinstance(default, tuple)
    text = f"{key.meaning[0].upper()}{key.meaning[1:]}{' (repeatable)' * several}."
    kind = tuple[str, ...] if several else type(default)
    least = 0 if kind is int else None
    made = option(
        () if several else default,
        text,
        key.metavar or None,
        panel=key.group,
        least=least,
        choices=key.choices,
    )
    return name, kind, made


_OPTIONS = {"force": KEYS["force"], "response": _RESPONSE, **RESPONSE_KEYS, **KEYS}
with_options(
    import_,
    dataclasses.make_dataclass(
        "ImportOptions",
        [
            _field(name, key)
            for group in dict.fromkeys(key.group for key in _OPTIONS.values())
            for name, key in _OPTIONS.items()
            if key.group == group
        ],
    ),
)
