"""The command `rom`: a reduced-order model from finite elements."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from snrmjax.cli.console import console, say, staged, warn
from snrmjax.cli.options import FILES, OptionRow, Out, with_options

if TYPE_CHECKING:
    from snrmjax.io.reduction.source import ReductionSource
    from snrmjax.report.condense.reduction_report import Reduction

_SAID = 3  # steps of the study between lines in a log
_FEW_SCALES = (0.1, 0.3, 1.0, 3.0)  # of a study whose load cases take long


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
    """Condense static load cases of finite elements to a reduced-order model.

    Writes model.toml (ready for simulate and nnm), load_cases.csv, summary.json, figures (PNG)
    and report.html.
    """
    from snrmjax.report.condense.reduction_report import (
        reduce,
        reduction_sentence,
        write_reduction,
    )

    with staged(out) as folder:
        source = _source(beam, options["tables"], options["calculix"], options["modes"])
        with console.status("static load cases …"):
            found = reduce(source, study=not options["no_study"], report=_progress)
        write_reduction(folder, found)
    for note in found.notes:
        warn(note)
    _say_scale(found)
    say(reduction_sentence(found))
    say(f"written to {out}")


_SOURCES = (
    OptionRow(
        *("tables", Path),
        "Folder with cases.csv and modes.toml: load cases that another code has run.",
        "DIR",
    ),
    OptionRow(
        *("calculix", Path),
        "CalculiX deck of the structure, with its mesh, material and supports. Its load cases are "
        "kept in a folder beside it (deck.jobs for deck.inp), for later runs.",
        "DECK",
    ),
)
_FURTHER = (
    OptionRow("modes", str, "Numbers of the modes to keep, with --calculix.", "1,3"),
    OptionRow("no_study", bool, "Leave out the study over the size of the loads.", None, False),
)
with_options(rom, {FILES: _SOURCES, None: _FURTHER})


def _source(
    beam: Path | None, tables: Path | None, calculix: Path | None, modes: str | None
) -> "ReductionSource":
    """What is condensed: exactly one of a beam, tables and a deck."""
    named = {"BEAM": beam, "--tables": tables, "--calculix": calculix}
    given = [name for name, path in named.items() if path is not None]
    if len(given) != 1:
        found = " and ".join(given) or "none of them"
        raise ValueError(f"`rom` needs one of BEAM, --tables and --calculix, but has {found}.")
    if modes is not None and calculix is None:
        raise ValueError("`--modes` goes with --calculix: other sources state their modes.")
    if tables is not None:
        from snrmjax.io.reduction.load_tables import read_load_tables

        return read_load_tables(tables)
    if beam is not None:
        from snrmjax.io.reduction.beam_source import read_beam

        return read_beam(beam)
    from snrmjax.io.calculix.reduction import read_deck_source

    source = read_deck_source(calculix or "", _mode_numbers(modes))
    return source._replace(scales=_FEW_SCALES)


def _mode_numbers(modes: str | None) -> tuple[int, ...]:
    if modes is None:
        raise ValueError("`--modes` must be mode numbers such as 1,3,5, but is not given.")
    parts = [part.strip() for part in modes.split(",")]
    if not parts or not all(part.isdecimal() and int(part) > 0 for part in parts):
        raise ValueError(f"`--modes` must be mode numbers such as 1,3,5, but is {modes!r}.")
    numbers = tuple(int(part) for part in parts)
    if len(set(numbers)) < len(numbers):
        raise ValueError(f"`--modes` must be different numbers, but is {modes!r}.")
    return numbers


def _progress(done: int, scales: int) -> None:
    if not console.is_terminal and (done % _SAID == 0 or done == scales):
        say(f"load scales: {done} of {scales}")


def _say_scale(found: "Reduction") -> None:
    if found.displacement is not None and found.load_scale is not None:
        say(f"loads move single modes linearly by up to {found.load_scale:.3g} thicknesses")
    if found.study is not None:
        say("; ".join(found.study.summary()[1:]))
