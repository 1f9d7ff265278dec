"""The commands `study run` and `study report`."""

import dataclasses
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from snrmjax.cli.console import INTERRUPTED, console, print_line, warn
from snrmjax.cli.options import FILES, Out, add_command, stated_options, with_options
from snrmjax.numerics.rules import InputError
from snrmjax.pipelines.options import option
from snrmjax.report.writing import staged

if TYPE_CHECKING:
    from snrmjax.study.analysis.digest import StudyDigest
    from snrmjax.study.run import Progress, ProgressReport, StudyRun
    from snrmjax.study.study import Study

_QUIET_SECONDS = 30.0  # between lines of progress in a log

_ROWS_SHOWN = 12  # of the summary on the screen

study_app = typer.Typer(
    name="study",
    help="Sweeps and uncertainty studies of one model, in one data set.",
    no_args_is_help=True,
    rich_markup_mode="rich",
)

Store = Annotated[
    Path,
    typer.Argument(help="The data set of a complete study.", metavar="STORE", show_default=False),
]
StudyOut = Annotated[
    Path,
    typer.Option(
        "--out",
        help="The data set: a Zarr store that xarray opens.",
        metavar="OUT",
        rich_help_panel=FILES,
        show_default=False,
    ),
]


@dataclasses.dataclass(frozen=True)
class StudyOptions:
    """Options of `study run`."""

    processes: int | None = option(
        None,
        "Processes of this machine, each on one core; by default one for every core.",
        least=1,
    )
    scheduler: str | None = option(
        None,
        "Address of a running Dask scheduler whose workers see the same folders, such as "
        "tcp://node1:8786.",
        "ADDRESS",
    )
    shard: str | None = option(
        None,
        "Compute only the I-th of N parts, on a shared folder; the last one to end makes the "
        "data set.",
        "I/N",
    )
    quiet: bool = option(False, "Print errors and warnings only.")


def run(
    file: Annotated[
        Path,
        typer.Argument(
            help="Varied quantities and computation (TOML).", metavar="STUDY", show_default=False
        ),
    ],
    out: StudyOut,
    **options: Any,
) -> None:
    """Run a study, or continue one that was stopped: the same command again.

    Writes the data set OUT. Stopping loses only the chunks in progress. The parts are kept in
    OUT.parts, to complete or repair the data set; remove them to save disk.
    """
    from snrmjax.study.execution import ClusterGone
    from snrmjax.study.run import run_study
    from snrmjax.study.study_file import read_study

    stated = stated_options(StudyOptions, options)
    quiet = stated.quiet
    part = (1, 1) if stated.shard is None else _shard(stated.shard)
    study = read_study(file)
    if not quiet:
        _print_study(study)
    try:
        with _progress(quiet) as progress:
            done = run_study(
                study,
                out,
                processes=stated.processes,
                scheduler=stated.scheduler,
                shard=part,
                progress=progress,
            )
    except KeyboardInterrupt:
        warn("stopped; the same command continues the study.")
        sys.exit(INTERRUPTED)
    except ClusterGone as error:
        warn(f"{error}; completed chunks are kept, and the same command continues with a new one.")
        sys.exit(1)
    if not quiet:
        _print_done(done, out)


with_options(run, StudyOptions)
add_command(
    study_app,
    run,
    "run",
    (
        "snrmjax study run study.toml --out study.zarr",
        "snrmjax study run study.toml --out study.zarr --shard 3/4",
    ),
    reads_models=True,
)


def report(
    store: Store,
    out: Out,
) -> None:
    """Draw a study: distributions, main effects, response bands, failures.

    Writes summary.csv, main_effects.csv, figures (PNG) and report.html.
    """
    from snrmjax.report.study.study_report import members_ended, write_study_report
    from snrmjax.study.run import open_study

    data = open_study(store)
    with staged(out) as folder:
        results = write_study_report(folder, data)
    print_line(members_ended(results))
    _print_summary(results)
    print_line(f"written to {out}")


add_command(study_app, report, "report", ("snrmjax study report study.zarr --out report",))


def _shard(text: str) -> tuple[int, int]:
    part, slash, parts = text.partition("/")
    if not (slash and part.isdecimal() and parts.isdecimal()):
        raise InputError(f"`--shard` must be I/N, such as 2/8, but is {text!r}.")
    return int(part), int(parts)


def _print_study(study: "Study") -> None:
    names = ", ".join(study.names) or "only the noise"
    at_sensor = f"; velocities at {study.reported_sensor}" if study.reported_sensor else ""
    print_line(
        f"{study.name}: {study.n_members} members ({study.computation.kind}) in {study.n_chunks} "
        f"chunks; {names} {'vary' if len(study.names) > 1 else 'varies'}{at_sensor}"
    )


def _print_done(done: "StudyRun", out: Path) -> None:
    if done.damaged_chunks:
        warn(f"{done.damaged_chunks} chunks were damaged; they were computed again.")
    if done.failed and not done.complete:
        warn(f"{done.failed} of {done.computed} members have no complete result: see `status`.")
    if not done.complete:
        print_line(f"this shard is done; {done.missing_chunks} chunks are left to other shards.")
    elif done.computed:
        from snrmjax.report.study.study_report import members_ended
        from snrmjax.study.analysis.digest import digest

        results = digest(done.open())
        (warn if results.failures.n_failed else print_line)(members_ended(results))
        for fact in results.failures.facts:
            print_line(str(fact))
        _print_summary(results)
        print_line(f"{done.computed} members in {_duration(done.seconds)}; written to {out}")
        print_line(f"for figures and tables: snrmjax study report {out} --out report")
    else:
        print_line(f"nothing was left to compute; {done.members} members are in {out}")


def _print_summary(results: "StudyDigest") -> None:
    """Print the outputs that vary, as a table."""
    from rich.table import Table
    from rich.text import Text

    from snrmjax.report.study.study_report import summary_table

    rows = [
        row for row in results.summaries if (row.varies or row.outside) and not row.scalar.is_count
    ]
    shown = summary_table(rows[:_ROWS_SHOWN], "")
    table = Table(box=None)
    columns = ("output", "unit", "members", "median", "95 % range")
    shown_columns = [shown.header.index(name) for name in columns]
    for k in shown_columns:
        table.add_column(shown.header[k], no_wrap=k > 0)
    for row in shown.rows:
        table.add_row(*(Text(row[k]) for k in shown_columns))
    console.print(table)
    if len(rows) > _ROWS_SHOWN:
        print_line(f"and {len(rows) - _ROWS_SHOWN} more outputs")
    if results.sensor:
        print_line(f"velocities and their peaks are those at {results.sensor}")


@contextmanager
def _progress(quiet: bool) -> Iterator["ProgressReport | None"]:
    """A bar on a terminal, lines in a log, nothing with `--quiet`."""
    if quiet:
        yield None
        return
    if not console.is_terminal:
        yield _Lines()
        return
    from rich.progress import BarColumn, TextColumn, TimeRemainingColumn
    from rich.progress import Progress as Bar

    columns = (BarColumn(), TextColumn("{task.description}"), TimeRemainingColumn())
    with Bar(*columns, console=console, transient=True) as bar:
        task = bar.add_task("the first chunk compiles …", total=None)

        def show(now: "Progress") -> None:
            bar.update(task, completed=now.done, total=now.members, description=_line(now))

        yield show


class _Lines:
    """Progress as lines, at most every half minute."""

    def __init__(self) -> None:
        self.last = time.monotonic()

    def __call__(self, now: "Progress") -> None:
        """Print the progress of the run."""
        if now.done < now.members and time.monotonic() - self.last < _QUIET_SECONDS:
            return
        self.last = time.monotonic()
        left = f", {_duration(now.seconds_left)} left" if now.done < now.members else ""
        print_line(_line(now) + left)


def _line(now: "Progress") -> str:
    done = f"{now.done}/{now.members} members"
    return f"{done}, {now.failed} without a complete result, {now.per_second:.3g}/s"


def _duration(seconds: float) -> str:
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"
