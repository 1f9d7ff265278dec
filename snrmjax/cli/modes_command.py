"""The command `modes`: linear modes from frequency responses, low levels and decays."""

from pathlib import Path
from typing import Annotated, Any

import typer

from snrmjax.cli.console import print_line, print_result
from snrmjax.cli.options import FILES, stated_options, with_options
from snrmjax.numerics.rules import InputError
from snrmjax.pipelines.options import ModesOptions
from snrmjax.report.writing import staged


def modes(
    data: Annotated[
        list[Path],
        typer.Argument(
            help="Frequency responses (UFF, MATLAB, HDF5, netCDF, CSV), low-level steady states "
            "(CSV as for identify), or records of free decays; several files are one test.",
            metavar="FRF…",
            show_default=False,
        ),
    ],
    out: Annotated[
        Path,
        typer.Option(
            "--out",
            help="Model to write (TOML); modes.csv and report.html go to its folder.",
            metavar="MODEL",
            rich_help_panel=FILES,
            show_default=False,
        ),
    ],
    interest: Annotated[int, typer.Option(help="Mode of interest, from 1.", min=1)] = 1,
    **options: Any,
) -> None:
    """Find linear modes with their errors and write them as a model.

    Poles of all model orders are fitted to all responses together. Low-level stepped sines that
    already harden or soften are extrapolated to zero amplitude by a joint fit of their levels.
    Shapes are mass-normalised by the drive point, an added mass, masses at the sensors or a known
    shape, or refused.

    Writes the model (TOML), modes.csv and report.html.
    """
    from snrmjax.pipelines.modes import find_linear_modes, read_modal_sources
    from snrmjax.report.pages import modes as page

    if out.suffix.lower() != ".toml":
        raise InputError(f"--out must be a model to write (.toml), but is {out.name!r}.")
    if out.is_dir():
        raise InputError(f"--out {out} is a folder, but a file to write is expected.")
    stated = stated_options(ModesOptions, options)
    with staged(out.parent) as folder:
        second = read_modal_sources(stated.with_mass) if stated.with_mass else None
        result = find_linear_modes(
            read_modal_sources(data),
            stated,
            with_mass=second,
            interest=interest - 1,
            name=out.stem.replace("_", " "),
            progress=_print_part,
        )
        page.write(folder, result, file=out.name)
    print_result(result)
    print_line(f"written to {out}: open {out.parent / 'report.html'}")


def _print_part(done: int, parts: int) -> None:
    print_line(f"the decay is not linear throughout: part {done} of {parts} fitted")


with_options(modes, ModesOptions)
