"""The command `identify`: backbone and damping from measured steady states."""

from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from snrmjax.cli.console import print_result, written
from snrmjax.cli.options import Linear, Out, stated_options, with_options
from snrmjax.pipelines.options import IdentifyOptions
from snrmjax.report.writing import staged


def identify(
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
    axis: Annotated[
        Literal["velocity", "displacement", "acceleration"],
        typer.Option(
            help="Amplitude over which backbone, damping, the joint fit's curves and residuals are "
            "drawn; responses over frequency stay velocities. Displacement and acceleration also "
            "add a column to points.csv and backbone.csv.",
            rich_help_panel="Drawing",
        ),
    ] = "velocity",
    **options: Any,
) -> None:
    """Identify backbone and damping from steady states, and predict responses.

    State by state with curves through the points, or by one joint fit of all states, which models
    errors common to the states of a level (requested by --fit, --free or --next).

    Families of --fit: auto, polynomial:2, power_law, spline:5, smoothing_spline; for damping also
    constant, viscous_quadratic, viscous_coulomb, viscous_microslip. :2 is the order (left out: the
    simplest in the smooth curve's band), @velocity the amplitude. Where only --free or --next
    requests a joint fit, the families are auto,auto. The force_gain of --free is in N per V for
    data with drive_v.

    Writes points.csv, backbone.csv, summary.json, figures and report.html; with predictions
    also prediction.csv, with a joint fit fit.json, with --next also next.csv.
    """
    from snrmjax.io.models import read_model
    from snrmjax.io.tables import read_steady_states
    from snrmjax.pipelines.identify import identify_test
    from snrmjax.report.pages import identified_test as page

    stated = stated_options(IdentifyOptions, options)
    with staged(out) as folder:
        structure = read_model(model)
        identified = identify_test(read_steady_states(data, structure), structure, stated)
        files = {"data": data.name, "model": f"{structure.name} ({model.name})"}
        page.write(folder, identified, title=data.stem.replace("_", " "), axis=axis, **files)
    print_result(identified)
    written(out)


with_options(identify, IdentifyOptions)
