"""Options and arguments that several commands have, and a help that fits a screen.

`--help` shows the options that most tests need, those without a panel or in that of files. Options
of a topic are in its panel, which `--help-all` shows.
"""

import copy
import dataclasses
import functools
import inspect
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, TypeVar, get_args, get_origin, get_type_hints

import typer
from typer.core import TyperCommand

from snrmjax.numerics.rules import InputError
from snrmjax.pipelines.options import FILES, checked, flag_of

Options = TypeVar("Options")

_ALL, _EFFECTS = "help_all", "effects"

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
        help="Folder for the results; files of the same names are replaced.",
        metavar="DIR",
        rich_help_panel=FILES,
        show_default=False,
    ),
]
Linear = Annotated[
    Path,
    typer.Option(
        "--model",
        help="Linear model (TOML): frequencies, damping ratios, mass-normalised shapes, "
        "participations.",
        metavar="MODEL",
        rich_help_panel=FILES,
        show_default=False,
    ),
]
Harmonics = Annotated[
    int,
    typer.Option(help="Highest balanced harmonic of the motion.", min=1, max=99),
]


class Command(TyperCommand):
    """A command whose `--help` has the main options, and `--help-all` all of them."""

    def collect_usage_pieces(self, ctx: Any) -> list[str]:
        """Required arguments and options, then `[OPTIONS]`."""
        every: list[Any] = ctx.command.params
        arguments = [one for one in every if one.param_type_name == "argument"]
        stated = [one.metavar if one.required else f"[{one.metavar}]" for one in arguments]
        needed = [one for one in every if one.required and one not in arguments]
        return [*stated, *(f"{one.opts[0]} {one.metavar}" for one in needed), "[OPTIONS]"]

    def format_help(self, ctx: Any, formatter: Any) -> None:
        """The first sentence of the help, the main options and an example."""
        (sentence, *_), (first, *_) = (
            (text or "").split("\n\n") for text in (self.help, self.epilog)
        )
        shown = copy.copy(self)
        if ctx.meta.get(_ALL):
            shown.epilog = f"Examples:\n\n{self.epilog}"
        else:
            panels = {one: one.rich_help_panel for one in self.params}  # type: ignore[attr-defined]
            further = [panel for panel in panels.values() if panel not in (None, FILES)]
            shown.params = [_unpanelled(one) for one in panels if panels[one] in (None, FILES)]
            shown.help = sentence
            shown.epilog = f"Example:\n\n{first}"
            if further:
                topics = "; ".join(dict.fromkeys(further))
                shown.epilog += (
                    f"\n\n{len(further)} more option{'s' if len(further) > 1 else ''} ({topics}): "
                    f"{ctx.command_path} --help-all"
                )
        super(Command, shown).format_help(ctx, formatter)


def _unpanelled(parameter: Any) -> Any:
    """The parameter without its panel, and without repeating the usage."""
    same = copy.copy(parameter)
    same.required, same.rich_help_panel = False, None
    return same


def _show_all(context: typer.Context, requested: bool) -> None:
    if requested:
        context.meta[_ALL] = True
        typer.echo(context.get_help())
        raise typer.Exit


def add_command(
    app: typer.Typer,
    command: Callable[..., None],
    name: str,
    examples: Sequence[str],
    *,
    reads_models: bool = False,
) -> None:
    """Add a command to an app; `--help` shows its first example, `--help-all` all of them.

    A command that reads models also accepts files with user-defined effects.
    """

    @functools.wraps(command)
    def run(**stated: Any) -> None:
        del stated[_ALL]
        files = stated.pop(_EFFECTS, ())
        if files:
            from snrmjax.io.programs.effect_files import load_effects

            for file in files:
                load_effects(file)
        command(**stated)

    signature = inspect.signature(command)
    effects = inspect.Parameter(
        _EFFECTS,
        inspect.Parameter.KEYWORD_ONLY,
        default=[],
        annotation=Annotated[
            list[Path],
            typer.Option(
                "--effects",
                help="Python file with your own effects, which is run: models and diagnoses can "
                "then use them (repeatable).",
                metavar="FILE",
                rich_help_panel="Own effects",
                show_default=False,
            ),
        ],
    )
    every = inspect.Parameter(
        _ALL,
        inspect.Parameter.KEYWORD_ONLY,
        default=False,
        annotation=Annotated[
            bool,
            typer.Option(
                "--help-all",
                help="Show all options and exit.",
                is_eager=True,
                callback=_show_all,
                show_default=False,
            ),
        ],
    )
    run.__signature__ = signature.replace(  # type: ignore[attr-defined]
        parameters=[*signature.parameters.values(), *([effects] if reads_models else []), every]
    )
    text = inspect.getdoc(command) or ""
    paragraphs = (" ".join(one.split()) for one in text.split("\n\n"))  # the terminal wraps them
    app.command(name, cls=Command, help="\n\n".join(paragraphs), epilog="\n\n".join(examples))(run)


def completion(choices: Sequence[str]) -> Callable[[str], list[str]]:
    """Shell completion of an option by one of these words, or several with commas."""

    def complete(incomplete: str) -> list[str]:
        stated, comma, begun = incomplete.rpartition(",")
        return [f"{stated}{comma}{word}" for word in choices if word.startswith(begun)]

    return complete


def require_positive(option: str, values: Sequence[float], unit: str) -> None:
    """Raise `ValueError` for a value of an option that is not above zero."""
    for value in values:
        if not 0 < value < float("inf"):
            raise InputError(f"`{option}` must be above zero, but is {value:g} {unit}.")


def with_options(command: Callable[..., None], *of: Any) -> None:
    """Add the options of pipelines (dataclasses) to a command that takes `**options`.

    A switch that is off by default has no `--no-` form; a tuple is a repeatable option.
    """
    signature = inspect.signature(command)
    own = [
        parameter
        for parameter in signature.parameters.values()
        if parameter.kind is not parameter.VAR_KEYWORD
    ]
    made = [_parameter(kind, field) for kind in of for field in dataclasses.fields(kind)]
    command.__signature__ = signature.replace(parameters=[*own, *made])  # type: ignore[attr-defined]


def stated_options(kind: type[Options], options: Mapping[str, Any]) -> Options:
    """The options of a pipeline from those of a command, if all have an effect."""
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
        flag,
        help=about.help,
        metavar=about.metavar,
        rich_help_panel=about.panel,
        min=about.least,
        autocompletion=completion(about.choices) if about.choices else None,
        show_default=isinstance(default, float) or bool(default),
    )
    return inspect.Parameter(
        field.name,
        inspect.Parameter.KEYWORD_ONLY,
        default=default,
        annotation=Annotated[kind, option],
    )
