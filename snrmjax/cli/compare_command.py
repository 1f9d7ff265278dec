"""The command `compare`: several methods on the same measured tests."""

from pathlib import Path
from typing import Annotated

import typer

from snrmjax.cli.console import print_result, written
from snrmjax.cli.options import Linear, Out, completion
from snrmjax.report.writing import staged

METHOD_NAMES = (
    *("snrm", "concerto", "arslan_ozguven", "rct", "harmonic_force_surface", "phase_resonance"),
    *("resonant_decay", "restoring_force", "ssm", "pnlss"),
)


def compare(
    data: Annotated[
        list[Path],
        typer.Argument(
            help="Measured steady states (CSV), as for identify, and time records (CSV, UFF, "
            "MATLAB, HDF5, TDMS); several files of one structure are one test.",
            metavar="DATA…",
            show_default=False,
        ),
    ],
    model: Linear,
    out: Out,
    method: Annotated[
        list[str] | None,
        typer.Option(
            help="A method to run (repeatable): snrm, concerto, arslan_ozguven, rct, "
            "harmonic_force_surface, phase_resonance (steady states), resonant_decay, "
            "restoring_force, ssm (free decays), pnlss (multisines). Default: all of them.",
            metavar="NAME",
            autocompletion=completion(METHOD_NAMES),
            show_default=False,
        ),
    ] = None,
) -> None:
    """Run other methods in addition to the inverse SNRM on the same data.

    A time record is classified as free decay, stepped sine, slow sweep or broadband; the
    rule that decided is printed. Stepped sines and sweeps become steady states. A record's CSV has
    time_s, force_n or drive_v (neither for a free decay) and velocity_m_s, acceleration_m_s2 or
    displacement_m (of several sensors tip.velocity_m_s, …).

    A method that the data do not allow is named with the reason, and the others still run. The
    repository's benchmarks/methods_sources.py compares them with their sources.

    Writes compare.csv, summary.json, compare.png and report.html.
    """
    from snrmjax.io.models import read_model
    from snrmjax.methods.comparison import compare_methods
    from snrmjax.model.structures import modes_of
    from snrmjax.pipelines.measured_files import read_measured_test
    from snrmjax.report.pages import comparison

    with staged(out) as folder:
        structure = read_model(model)
        tests = [test for path in data for test in read_measured_test(path, structure)]
        result = compare_methods(tests, modes_of(structure), tuple(method) if method else None)
        title = ", ".join(path.stem.replace("_", " ") for path in data)
        comparison.write(folder, result, title=title, model=structure.name)
    print_result(result, comparison.notes_of(result))
    written(out)
