"""The command `compare`: several methods on the same measured steady states."""

from pathlib import Path
from typing import Annotated

import typer

from snrmjax.cli.console import say, staged, warn
from snrmjax.cli.options import FILES, Out
from snrmjax.io.models import read_model
from snrmjax.io.tables import read_steady_states


def compare(
    data: Annotated[
        list[Path],
        typer.Argument(
            help="Measured steady states (CSV), as for identify; several files of one structure "
            "are one test.",
            metavar="DATA…",
            show_default=False,
        ),
    ],
    model: Annotated[
        Path,
        typer.Option(
            help="Linear model of the structure (TOML), as for identify.",
            metavar="MODEL",
            rich_help_panel=FILES,
            show_default=False,
        ),
    ],
    out: Out,
    method: Annotated[
        list[str] | None,
        typer.Option(
            help="A method to run (repeatable): snrm, concerto, arslan_ozguven, rct, "
            "harmonic_force_surface, phase_resonance. Default: all of them.",
            metavar="NAME",
            show_default=False,
        ),
    ] = None,
) -> None:
    """Run other methods beside the inverse SNRM on the same data.

    A method that the data do not allow is named with the reason, and the others still run.

    Writes compare.csv, summary.json, compare.png and report.html.
    """
    from snrmjax.measure.states import join_steady_states
    from snrmjax.report.methods import comparison_report

    with staged(out) as folder:
        structure = read_model(model)
        tests, offset = [], 0
        for path in data:
            one = read_steady_states(path, structure).renumbered(offset)
            offset = int(one.level.max())
            tests.append(one)
        measured = tests[0] if len(tests) == 1 else join_steady_states(tests)
        found = comparison_report.run_methods(
            measured, structure, tuple(method) if method else None
        )
        for why in found.comparison.stopped.values():
            warn(f"did not run: {why}")
        name = ", ".join(path.stem.replace("_", " ") for path in data)
        comparison_report.write_comparison(folder, found, name)
    say(comparison_report.comparison_sentence(found))
    say(f"written to {out}: open {out / 'report.html'}")
