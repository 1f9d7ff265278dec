"""The command `identify`: backbone and damping from measured steady states."""

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from snrmjax.cli.console import say, staged, warn
from snrmjax.cli.options import FILES, Out, require_positive
from snrmjax.identify.prediction.new_level import DayToDay
from snrmjax.io.models import read_model
from snrmjax.io.tables import read_steady_states

_PREDICTION = "Predicted responses"
_CURVES, _JOINT = "Curves through points (without --fit)", "Joint fit of all states"


class Amplitude(StrEnum):
    """The amplitude of which an identified frequency and damping are functions."""

    displacement = "displacement"
    velocity = "velocity"


class AmplitudeAxis(StrEnum):
    """The amplitude that figures and tables show."""

    velocity = "velocity"
    displacement = "displacement"
    acceleration = "acceleration"


class Measure(StrEnum):
    """The amplitude of the measured motion that enters the equations."""

    fundamental = "fundamental"
    peak = "peak"


def identify(
    context: typer.Context,
    data: Annotated[
        Path,
        typer.Argument(
            help="Measured steady states (CSV): level, frequency_hz, force_n (or drive_v), "
            "velocity_re_m_s, velocity_im_m_s.",
            metavar="DATA",
            show_default=False,
        ),
    ],
    model: Annotated[
        Path,
        typer.Option(
            help="Linear model of the structure (TOML): frequencies, damping ratios, mass-"
            "normalised shapes, participations.",
            metavar="MODEL",
            rich_help_panel=FILES,
            show_default=False,
        ),
    ],
    out: Out,
    predict_force: Annotated[
        list[float] | None,
        typer.Option(
            help="Predict resonance and response under this force in N; give it again for more.",
            metavar="N",
            rich_help_panel=_PREDICTION,
        ),
    ] = None,
    predict_drive: Annotated[
        list[float] | None,
        typer.Option(
            help="The same under this drive voltage in V, for data with drive_v.",
            metavar="V",
            rich_help_panel=_PREDICTION,
        ),
    ] = None,
    extrapolate: Annotated[
        float,
        typer.Option(
            help="Predict up to this multiple of the largest measured amplitude; 1 ends where the "
            "data end.",
            metavar="RATIO",
            min=1.0,
            rich_help_panel=_PREDICTION,
        ),
    ] = 1.5,
    day_std: Annotated[
        str | None,
        typer.Option(
            help="Predict for another day's test, which differs from this one by so much: relative "
            "1σ of natural frequency, damping and gain, as 0.001,0.05,0.02.",
            metavar="FREQUENCY,DAMPING,GAIN",
            rich_help_panel=_PREDICTION,
        ),
    ] = None,
    self_excited: Annotated[
        bool,
        typer.Option(
            "--self-excited",
            help="Let extrapolated damping be negative, as no passive structure's is.",
            rich_help_panel=_PREDICTION,
        ),
    ] = False,
    axis: Annotated[
        AmplitudeAxis,
        typer.Option(
            help="Amplitude over which backbone, damping, the joint fit's curves and residuals "
            "are drawn; responses over frequency stay velocities. Displacement and acceleration "
            "also add a column to points.csv and backbone.csv.",
        ),
    ] = AmplitudeAxis.velocity,
    amplitude: Annotated[
        Amplitude,
        typer.Option(
            help="Amplitude of which natural frequency and damping are functions: displacement "
            "(right for a nonlinear stiffness) or velocity.",
            rich_help_panel=_CURVES,
        ),
    ] = Amplitude.displacement,
    measure: Annotated[
        Measure,
        typer.Option(
            help="Take the amplitude of the fundamental, or the peak of the motion with its "
            "measured harmonics.",
            rich_help_panel=_CURVES,
        ),
    ] = Measure.fundamental,
    knots: Annotated[
        int | None,
        typer.Option(
            help="Knots of each curve at most. Default: up to 42; curves bend as much as the data "
            "ask for.",
            min=2,
            rich_help_panel=_CURVES,
        ),
    ] = None,
    anchor: Annotated[
        bool,
        typer.Option(
            "--anchor",
            help="Make both curves start at the linear frequency and damping of the model.",
            rich_help_panel=_CURVES,
        ),
    ] = False,
    fit: Annotated[
        str | None,
        typer.Option(
            help="Family of the backbone and, after a comma, of the damping: auto (a smooth curve "
            "that bends as much as the data ask for), polynomial:2, power_law, spline:5, "
            "smoothing_spline; for damping also constant, viscous_quadratic, viscous_coulomb, "
            "viscous_microslip. :2 is its size (left out: the simplest in the smooth curve's "
            "band), @velocity its amplitude. Default: auto,auto where another option asks for a "
            "joint fit.",
            metavar="BACKBONE[,DAMPING]",
            rich_help_panel=_JOINT,
        ),
    ] = None,
    free: Annotated[
        list[str] | None,
        typer.Option(
            help="Errors of the instruments to be found with the curves: force_gain (N per V for "
            "data with drive_v), force_offset, instrument_phase; several with commas.",
            metavar="NAME[,NAME]",
            rich_help_panel=_JOINT,
        ),
    ] = None,
    robust: Annotated[
        bool,
        typer.Option(
            "--robust",
            help="Give outlying states less weight.",
            rich_help_panel=_JOINT,
        ),
    ] = False,
    further: Annotated[
        int | None,
        typer.Option(
            "--next",
            help="Advise this many further measurements, those that narrow the bands most.",
            metavar="COUNT",
            min=1,
            rich_help_panel=_JOINT,
        ),
    ] = None,
) -> None:
    """Identify backbone and damping from measured steady states, and predict responses.

    State by state with curves through the points, or by one joint fit of all states, which knows
    errors that the states of a level share (asked for by --fit, --free or --next).

    Writes points.csv, backbone.csv, summary.json, figures and report.html; with predictions
    also prediction.csv, with a joint fit fit.json, with --next also next.csv.
    """
    from snrmjax.report import workflow
    from snrmjax.report.prediction.predictions import Loads
    from snrmjax.report.sampling import SHOWN_AMPLITUDES

    given = {name for name in context.params if _was_given(context, name)}
    _check_options(given)
    require_positive("--predict-force", predict_force or (), "N")
    require_positive("--predict-drive", predict_drive or (), "V")
    loads = Loads(
        *(tuple(predict_force or ()), tuple(predict_drive or ()), extrapolate),
        day=None if day_std is None else _day_to_day(day_std),
        self_excited=self_excited,
    )
    with staged(out) as folder:
        structure = read_model(model)
        measured = read_steady_states(data, structure)
        if given & _ASK_FOR_FIT:
            settings = workflow.JointFitSettings(
                fit or "auto", tuple(free or ()), robust=robust, further=further or 0
            )
            found = workflow.identify_jointly(measured, structure, settings, loads)
        else:
            curves = workflow.CurveSettings(
                amplitude.value, measure.value, n_knots=knots, anchor=anchor
            )
            found = workflow.identify_by_points(measured, structure, curves, loads)
        for note in found.notes:
            warn(note)
        files = {"data": data.name, "model": f"{structure.name} ({model.name})"}
        shown = SHOWN_AMPLITUDES[axis.value]
        workflow.write_findings(folder, found, data.stem.replace("_", " "), files, shown)
    for line in workflow.headline(found):
        say(line)
    say(f"written to {out}: open {out / 'report.html'}")


_ASK_FOR_FIT = {"fit", "free", "further"}
_NOT_WITH_FIT = {
    "amplitude": "name the amplitude with the family, as in `--fit polynomial:2@velocity`",
    "measure": "a joint fit takes the fundamental",
    "knots": "give the size with the family, as in `--fit spline:5`",
    "anchor": "a joint fit is not tied to the linear mode",
}


def _was_given(context: typer.Context, name: str) -> bool:
    source = context.get_parameter_source(name)
    return source is not None and source.name == "COMMANDLINE"


def _check_options(given: set[str]) -> None:
    """Refuse options of `identify` that would have no effect."""
    asking = [
        f"`--{'next' if name == 'further' else name}`" for name in sorted(given & _ASK_FOR_FIT)
    ]
    for name, remedy in _NOT_WITH_FIT.items():
        if asking and name in given:
            raise ValueError(
                f"`--{name}` belongs to the curves through points and has no effect on a joint "
                f"fit, which {' and '.join(asking)} asks for ({remedy}): leave one of them out."
            )
    if "robust" in given and not asking:
        raise ValueError("`--robust` belongs to a joint fit: add `--fit auto`, or leave it out.")
    for name in sorted(given & {"extrapolate", "day_std", "self_excited"}):
        if given & {"predict_force", "predict_drive"}:
            break
        raise ValueError(
            f"`--{name.replace('_', '-')}` belongs to predictions: add `--predict-force` (N) or, "
            "for data with a drive voltage, `--predict-drive` (V), or leave it out."
        )


def _day_to_day(text: str) -> DayToDay:
    """The option `--day-std`."""
    try:
        day = DayToDay(*map(float, text.split(",")))
    except (TypeError, ValueError):
        day = DayToDay(-1.0)
    if not all(0 <= one < 1 for one in day):
        raise ValueError(
            "`--day-std` takes up to three relative standard deviations from 0 to below 1, "
            f"FREQUENCY,DAMPING,GAIN as 0.001,0.05,0.02, but is {text!r}."
        )
    return day
