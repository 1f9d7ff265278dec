"""The commands `simulate` and `nnm`: responses and normal mode of a model."""

from typing import Annotated, Literal

import typer

from snrmjax.cli.console import print_line, print_result, written
from snrmjax.cli.options import Harmonics, Model, Out, require_positive
from snrmjax.numerics.rules import InputError
from snrmjax.report.writing import staged

EventKind = Literal["fold", "peak", "phase_resonance", "period_doubling", "neimark_sacker"]
_MOTIONS = "Further motions"
_FOLLOWED = "Events over a parameter"


def simulate(
    model: Model,
    from_hz: Annotated[
        float,
        typer.Option(help="Lowest frequency of the force in Hz.", metavar="HZ", show_default=False),
    ],
    to_hz: Annotated[
        float,
        typer.Option(
            help="Highest frequency of the force in Hz.", metavar="HZ", show_default=False
        ),
    ],
    out: Out,
    force: Annotated[
        list[float] | None,
        typer.Option(
            help="Peak amplitude of the harmonic force in N; for base excitation, of the "
            "acceleration in m/s²; for an unbalance, as a multiple of the model's (default: 1). "
            "Repeatable.",
            metavar="N",
            show_default=False,
        ),
    ] = None,
    harmonics: Harmonics = 9,
    isolated: Annotated[
        bool,
        typer.Option(
            "--isolated",
            help="Also search for responses that are not connected to the main branch "
            "(takes longer).",
            rich_help_panel=_MOTIONS,
        ),
    ] = False,
    subharmonic: Annotated[
        list[int] | None,
        typer.Option(
            help="Also search for motions that repeat after N periods of the force: from period "
            "doublings (2, 4) and from the free oscillation of a mode near 1/N of the frequency. "
            "Repeatable.",
            metavar="N",
            rich_help_panel=_MOTIONS,
            show_default=False,
        ),
    ] = None,
    quasi_periodic: Annotated[
        bool,
        typer.Option(
            "--quasi-periodic",
            help="Also continue the quasi-periodic motions from every Neimark-Sacker "
            "bifurcation of the responses (quasi_periodic.csv and quasi_periodic.png).",
            rich_help_panel=_MOTIONS,
        ),
    ] = False,
    follow: Annotated[
        EventKind | None,
        typer.Option(
            help="Also continue events of the responses over a parameter (events.csv and "
            "events.png).",
            rich_help_panel=_FOLLOWED,
            show_default=False,
        ),
    ] = None,
    parameter: Annotated[
        str,
        typer.Option(
            help="The parameter: the force, or a number of the model such as "
            "mode_1.damping_ratio or potential.1111.",
            metavar="NAME",
            rich_help_panel=_FOLLOWED,
        ),
    ] = "force",
    to: Annotated[
        float | None,
        typer.Option(
            help="Final value of the parameter, in N, rad/s or the unit of the effect; a curve "
            "with a turning point before it returns.",
            rich_help_panel=_FOLLOWED,
            show_default=False,
        ),
    ] = None,
) -> None:
    """Simulate responses to a harmonic force, unstable parts included.

    Harmonic balance with arclength continuation around folds. Events are continued over the force
    or any number of the model, with their cusps and isolas. Writes response.csv, response.png,
    summary.json and report.html.
    """
    from snrmjax.io.models import read_model
    from snrmjax.pipelines.simulate import simulate_responses
    from snrmjax.report.pages import simulation

    if not 0 < from_hz < to_hz:
        raise InputError(
            "`--from-hz` must be above zero and below `--to-hz`, but they are "
            f"{from_hz:g} and {to_hz:g} Hz."
        )
    structure = read_model(model)
    if force is None and structure.modes.unbalance is None:
        raise InputError("`--force` must be given: the amplitude of the force in N.")
    if any(order < 2 for order in subharmonic or []):
        raise InputError("`--subharmonic` must be 2 or more: the number of periods of the force.")
    loads = force or [1.0]
    require_positive("--force", loads, structure.modes.force_unit)
    if follow and to is None:
        raise InputError("`--follow` needs `--to`, the value that the parameter goes to.")
    if follow is None and (to is not None or parameter != "force"):
        raise InputError("`--parameter` and `--to` need `--follow`, the kind of event.")
    with staged(out) as folder:
        result = simulate_responses(
            structure,
            loads,
            from_hz,
            to_hz,
            harmonics=harmonics,
            isolated=isolated,
            subharmonic=subharmonic or [],
            follow=[] if follow is None else [follow],
            parameter=parameter,
            to=to,
            quasi_periodic=quasi_periodic,
            progress=lambda load: print_line(f"{load:g} {structure.modes.force_unit}"),
        )
        simulation.write(folder, result)
    print_result(result)
    written(out)


def nnm(
    model: Model,
    to_hz: Annotated[
        float,
        typer.Option(
            help="Final frequency in Hz, above the linear one or, for a softening mode, below it.",
            metavar="HZ",
            show_default=False,
        ),
    ],
    out: Out,
    harmonics: Harmonics = 9,
    tongues: Annotated[
        Literal["follow", "skip"],
        typer.Option(
            help="At an internal resonance the mode has a tongue (out and back): follow it, "
            "or skip it."
        ),
    ] = "follow",
) -> None:
    """Follow the undamped nonlinear normal mode from its linear frequency.

    The mode is the model's mode of interest. Writes nnm.csv (frequency, velocity, energy,
    stability, internal resonances, shape) and nnm.png.
    """
    from snrmjax.io.models import read_model
    from snrmjax.pipelines.simulate import simulate_mode
    from snrmjax.report.pages import simulation

    require_positive("--to-hz", [to_hz], "Hz")
    with staged(out) as folder:
        result = simulate_mode(read_model(model), to_hz, harmonics=harmonics, tongues=tongues)
        simulation.write(folder, result)
    print_result(result)
    written(out, "")
