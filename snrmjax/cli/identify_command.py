"""The command `identify`: backbone and damping from measured steady states."""

from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from snrmjax.cli.console import say, staged, warn
from snrmjax.cli.options import Linear, OptionRow, Out, require_positive, with_options
from snrmjax.identify.pointwise.backbone_points import AmplitudeArgument, AmplitudeMeasure
from snrmjax.identify.prediction.new_level import DayToDay
from snrmjax.io.models import read_model
from snrmjax.io.tables import read_steady_states


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
    model: Linear,
    out: Out,
    **options: Any,
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
    forces, drives = options["predict_force"], options["predict_drive"]
    require_positive("--predict-force", forces, "N")
    require_positive("--predict-drive", drives, "V")
    day = options["day_std"]
    loads = Loads(
        *(tuple(forces), tuple(drives), options["extrapolate"]),
        day=None if day is None else _day_to_day(day),
        self_excited=options["self_excited"],
    )
    with staged(out) as folder:
        structure = read_model(model)
        measured = read_steady_states(data, structure)
        if given & _ASK_FOR_FIT:
            found = workflow.identify_jointly(
                *(measured, structure, loads),
                families=options["fit"] or "auto",
                free=options["free"],
                robust=options["robust"],
                further=options["further"] or 0,
            )
        else:
            found = workflow.identify_by_points(
                *(measured, structure, loads),
                amplitude=options["amplitude"],
                measure=options["measure"],
                n_knots=options["knots"],
            )
        for note in found.notes:
            warn(note)
        files = {"data": data.name, "model": f"{structure.name} ({model.name})"}
        shown = SHOWN_AMPLITUDES[options["axis"]]
        workflow.write_findings(folder, found, data.stem.replace("_", " "), files, shown)
    for line in workflow.headline(found):
        say(line)
    say(f"written to {out}: open {out / 'report.html'}")


_GENERAL = (
    OptionRow(
        *("axis", Literal["velocity", "displacement", "acceleration"]),
        "Amplitude over which backbone, damping, the joint fit's curves and residuals are drawn; "
        "responses over frequency stay velocities. Displacement and acceleration also add a column "
        "to points.csv and backbone.csv.",
        *(None, "velocity"),
    ),
)
_PREDICTION = (
    OptionRow(
        *("predict_force", list[float]),
        "Predict resonance and response under this force in N; give it again for more.",
        "N",
    ),
    OptionRow(
        *("predict_drive", list[float]),
        "The same under this drive voltage in V, for data with drive_v.",
        "V",
    ),
    OptionRow(
        *("extrapolate", float),
        "Predict up to this multiple of the largest measured amplitude; 1 ends where the data end.",
        *("RATIO", 1.5),
        least=1.0,
    ),
    OptionRow(
        *("day_std", str),
        "Predict for another day's test, which differs from this one by so much: relative 1σ of "
        "natural frequency, damping and gain, as 0.001,0.05,0.02.",
        "FREQUENCY,DAMPING,GAIN",
    ),
    OptionRow(
        *("self_excited", bool),
        "Let extrapolated damping be negative, as no passive structure's is.",
        *(None, False),
    ),
)
_CURVES = (
    OptionRow(
        *("amplitude", AmplitudeArgument),
        "Amplitude of which natural frequency and damping are functions: displacement (right for a "
        "nonlinear stiffness) or velocity.",
        *(None, "displacement"),
    ),
    OptionRow(
        *("measure", AmplitudeMeasure),
        "Take the amplitude of the fundamental, or the peak of the motion with its measured "
        "harmonics.",
        *(None, "fundamental"),
    ),
    OptionRow(
        *("knots", int),
        "Knots of each curve at most. Default: up to 42; curves bend as much as the data ask for.",
        least=2,
    ),
)
_JOINT = (
    OptionRow(
        *("fit", str),
        "Family of the backbone and, after a comma, of the damping: auto (a smooth curve that "
        "bends as much as the data ask for), polynomial:2, power_law, spline:5, smoothing_spline; "
        "for damping also constant, viscous_quadratic, viscous_coulomb, viscous_microslip. :2 is "
        "its size (left out: the simplest in the smooth curve's band), @velocity its amplitude. "
        "Default: auto,auto where another option asks for a joint fit.",
        "BACKBONE[,DAMPING]",
    ),
    OptionRow(
        *("free", list[str]),
        "Errors of the instruments to be found with the curves: force_gain (N per V for data with "
        "drive_v), force_offset, instrument_phase; several with commas.",
        "NAME[,NAME]",
    ),
    OptionRow("robust", bool, "Give outlying states less weight.", None, False),
    OptionRow(
        *("further", int),
        "Advise this many further measurements, those that narrow the bands most.",
        "COUNT",
        least=1,
        flag="--next",
    ),
)
with_options(
    identify,
    {
        None: _GENERAL,
        "Predicted responses": _PREDICTION,
        "Curves through points (without --fit)": _CURVES,
        "Joint fit of all states": _JOINT,
    },
)
_ASK_FOR_FIT = {"fit", "free", "further"}
_NOT_WITH_FIT = {
    "amplitude": "name the amplitude with the family, as in `--fit polynomial:2@velocity`",
    "measure": "a joint fit takes the fundamental",
    "knots": "give the size with the family, as in `--fit spline:5`",
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
