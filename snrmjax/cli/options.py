"""Options and arguments that several commands have, and the panels of their help."""

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
