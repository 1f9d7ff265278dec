"""Options and arguments that several commands have, and the panels of their help."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

FILES = "Files"

Model = Annotated[
    Path,
    typer.Argument(
        help="Structure to simulate (TOML): modes, potential, effects.",
        metavar="MODEL",
        show_default=False,
    ),
]
Out = Annotated[
    Path,
    typer.Option(
        "--out",
        help="Folder for the results, made if missing; files of the same names are replaced.",
        metavar="DIR",
        rich_help_panel=FILES,
        show_default=False,
    ),
]
Harmonics = Annotated[
    int,
    typer.Option(help="Harmonics of the motion that are balanced, beside its mean.", min=1, max=99),
]


def require_positive(option: str, values: Sequence[float], unit: str) -> None:
    """Raise `ValueError` where a number that an option was given is not above zero."""
    for value in values:
        if not 0 < value < float("inf"):
            raise ValueError(f"`{option}` must be above zero, but is {value:g} {unit}.")
