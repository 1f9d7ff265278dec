"""The command `diagnose`: what a model lacks."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from snrmjax.cli.console import say, warn, written
from snrmjax.cli.options import FILES, Out, asked_for, with_options
from snrmjax.pipelines.options import DiagnoseOptions
from snrmjax.report.writing import staged

if TYPE_CHECKING:
    from snrmjax.diagnose.diagnosis_result import Diagnosis


def diagnose(
    data: Annotated[
        list[Path],
        typer.Argument(
            help="Measured steady states (CSV), one file or more. A file with `velocity_m_s` in "
            "place of real and imaginary part has amplitudes without phases.",
            metavar="DATA",
            show_default=False,
        ),
    ],
    model: Annotated[
        Path,
        typer.Option(
            help="Model of the structure as it is believed to be (TOML); with several files, one "
            "of the same name beside a CSV takes its place.",
            metavar="MODEL",
            rich_help_panel=FILES,
            show_default=False,
        ),
    ],
    out: Out,
    **options: Any,
) -> None:
    """Find the physics that a model lacks, with probabilities.

    Where model and data disagree, the effects of the library that would explain it, and what to
    measure where several would.

    Writes diagnosis.json, figures, report.html and model.toml, the completed model; of several
    files each into a folder of its own name.

    Without phases (`velocity_m_s`, or a `phase_std_deg` of 60 or more) the notes say what
    these data cannot decide.
    """
    from snrmjax.io.measurement_plans import read_former_answer
    from snrmjax.pipelines.diagnose import diagnose_test, read_test
    from snrmjax.report.pages import diagnosis as page

    asked, several = asked_for(DiagnoseOptions, options), len(data) > 1
    for option in ("plan", "add", "former") if several else ():
        if getattr(asked, option):
            flag = {"former": "continue"}.get(option, option)
            raise ValueError(f"`--{flag}` is for one data file, but {len(data)} are given.")
    if asked.plan is not None and not asked.plan.parent.is_dir():
        raise ValueError(f"--plan {asked.plan} cannot be written: its folder does not exist.")
    if len({path.stem for path in data}) < len(data):
        raise ValueError("two of the data files have the same name: they would share a folder.")
    former = None if asked.former is None else read_former_answer(asked.former)
    simulate = not several if asked.responses is None else asked.responses
    refused = []
    for path in data:
        beside = path.with_suffix(".toml")
        try:
            with staged(out / path.stem if several else out) as folder:
                given = beside if several and beside.exists() else model
                structure, measured = read_test(path, given, asked.add)
                for note in measured.notes:
                    warn(note)
                places = [one.strip() for one in asked.where.split(",") if one.strip()]
                found = diagnose_test(
                    measured, structure, simulate=simulate, former=former, where=places
                )
                title = path.stem.replace("_", " ")
                page.write(folder, found, title=title, data=path.name)
                if asked.plan is not None:
                    _write_plan(asked.plan, found.diagnosis)
        except ValueError as error:
            if not several:
                raise
            warn(f"{path.name}: {error}")
            refused.append(path.name)
            continue
        if not several:
            for said in found.diagnosis.notes:
                warn(said)
        say(f"{path.name}: {page.answer_in_words(found)}")
        for line in page.headline(found):
            say(f"  {line}")
    if not several:
        written(out)
    if refused:
        raise ValueError(f"no diagnosis for {len(refused)} of {len(data)}: {', '.join(refused)}.")


with_options(diagnose, DiagnoseOptions)


def _write_plan(file: Path, found: "Diagnosis") -> None:
    """Write what to measure next, or say why there is nothing to measure."""
    from snrmjax.diagnose.measurement_plan import measurement_plan
    from snrmjax.io.measurement_plans import write_plan

    asked = measurement_plan(found)
    if asked is None:
        why = "what would decide is no measurement of steady states."
        if found.decide_by is None:
            why = "nothing is open that a measurement would decide."
        warn(f"no plan is written to {file}: {why}")
        return
    write_plan(file, asked)
    say(f"  {asked.states.n_states} steady states to be measured are written to {file}")
