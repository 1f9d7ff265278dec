"""Options and arguments that several commands have, and the panels of their help."""

import dataclasses
import inspect
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, TypeVar, get_args, get_origin, get_type_hints

import typer

from snrmjax.pipelines.options import FILES, checked, flag_of

Asked = TypeVar("Asked")

Model = Annotated[
    Path,
    typer.Argument(
        help="Structure to simulate (TOML): modes, potential, effects; or matrices, "
        "with elements at points.",
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


def with_options(command: Callable[..., None], *of: Any) -> None:
    """Give a command, which takes them as `**options`, the options of pipelines (dataclasses).

    A switch that is off by default has no `--no-` form; a tuple is an option to be repeated.
    """
    signature = inspect.signature(command)
    own = [
        parameter
        for parameter in signature.parameters.values()
        if parameter.kind is not parameter.VAR_KEYWORD
    ]
    made = [_parameter(kind, field) for kind in of for field in dataclasses.fields(kind)]
    command.__signature__ = signature.replace(parameters=[*own, *made])  # type: ignore[attr-defined]


def asked_for(kind: type[Asked], options: Mapping[str, Any]) -> Asked:
    """The options of a pipeline from those that a command was given, if all have an effect."""
    names = [field.name for field in dataclasses.fields(kind)]  # type: ignore[arg-type]
    values = {name: options[name] for name in names}
    return checked(kind(**{k: tuple(v) if isinstance(v, list) else v for k, v in values.items()}))


def _parameter(of: Any, field: dataclasses.Field) -> inspect.Parameter:
    about, kind, default = field.metadata["option"], get_type_hints(of)[field.name], field.default
    flag = flag_of(field)
    if bool in (kind, *get_args(kind)) and default is not False:
        flag = f"{flag}/--no-{flag[2:]}"
    if get_origin(kind) is tuple:
        kind, default = list[get_args(kind)[0]], []  # type: ignore[misc]
    option = typer.Option(
        *(flag,),
        help=about.help,
        metavar=about.metavar,
        rich_help_panel=about.panel,
        min=about.least,
        show_default=isinstance(default, float) or bool(default),
    )
    return inspect.Parameter(
        *(field.name, inspect.Parameter.KEYWORD_ONLY),
        default=default,
        annotation=Annotated[kind, option],
    )
