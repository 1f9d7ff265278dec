"""Options and arguments that several commands have, and the panels of their help."""

import inspect
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, NamedTuple

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
Linear = Annotated[
    Path,
    typer.Option(
        "--model",
        help="Linear model of the structure (TOML): frequencies, damping ratios, mass-normalised "
        "shapes, participations.",
        metavar="MODEL",
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


class OptionRow(NamedTuple):
    """An option of a command: its name in Python, what it takes, and the line of its help.

    A `bool` that is `False` is a switch, another one has a `--no-` form; a list is repeatable.
    """

    name: str
    kind: Any
    help: str
    metavar: str | None = None
    default: Any = None
    least: float | None = None  # that a number may be
    flag: str = ""  # how it is written, where that is not the name


def with_options(
    command: Callable[..., None], panels: Mapping[str | None, Sequence[OptionRow]]
) -> None:
    """Give a command, which takes them as `**options`, the options of some panels of its help."""
    signature = inspect.signature(command)
    own = [one for one in signature.parameters.values() if one.kind is not one.VAR_KEYWORD]
    made = [_parameter(row, panel) for panel, rows in panels.items() for row in rows]
    command.__signature__ = signature.replace(parameters=[*own, *made])  # type: ignore[attr-defined]


def _parameter(row: OptionRow, panel: str | None) -> inspect.Parameter:
    flag = row.flag or f"--{row.name.replace('_', '-')}"
    if row.kind is bool and row.default is not False:
        flag = f"{flag}/--no-{flag[2:]}"
    said = isinstance(row.default, float) or bool(row.default)
    option = typer.Option(
        *(flag,),
        help=row.help,
        metavar=row.metavar,
        rich_help_panel=panel,
        min=row.least,
        show_default=said,
    )
    optional = row.default is None and not str(row.kind).startswith("list")
    kind = row.kind | None if optional else row.kind
    default = [] if row.default is None and not optional else row.default
    return inspect.Parameter(
        *(row.name, inspect.Parameter.KEYWORD_ONLY),
        default=default,
        annotation=Annotated[kind, option],
    )
