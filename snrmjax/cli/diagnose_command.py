"""The command `diagnose`: missing physics of a model."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from snrmjax.cli.console import print_line, warn, written
from snrmjax.cli.options import FILES, Out, stated_options, with_options
from snrmjax.numerics.rules import InputError
from snrmjax.pipelines.options import DiagnoseOptions
from snrmjax.report.writing import staged

if TYPE_CHECKING:
    from snrmjax.diagnose.diagnosis_result import Diagnosis


def diagnose(
    data: Annotated[
        list[Path],
        typer.Argument(
            help="Measured steady states (CSV), one file or more. A file with `velocity_m_s` "
            "instead of real and imaginary parts has amplitudes without phases.",
            metavar="DATA",
            show_default=False,
        ),
    ],
    model: Annotated[
        Path,
        typer.Option(
            help="Assumed model of the structure (TOML); with several files, a model with the same "
            "name in the folder of a CSV replaces it.",
            metavar="MODEL",
            rich_help_panel=FILES,
            show_default=False,
        ),
    ],
    out: Out,
    **options: Any,
) -> None:
    """Find the physics that a model lacks, with probabilities.

    Where model and data disagree, the effects of the library that explain it, and which
    measurement decides between several.

    Writes diagnosis.json, figures, report.html and model.toml, the completed model; for several
    files each in a folder of its name.

    Without phases (`velocity_m_s`, or a `phase_std_deg` of 60 or more) the notes state what the
    data cannot decide.
    """
    from snrmjax.io.measurement_plans import read_former_answer
    from snrmjax.pipelines.diagnose import diagnose_test, read_test
    from snrmjax.report.pages import diagnosis as page

    stated, several = stated_options(DiagnoseOptions, options), len(data) > 1
    for option in ("plan", "add", "former") if several else ():
        if getattr(stated, option):
            flag = {"former": "continue"}.get(option, option)
            raise InputError(f"`--{flag}` is for one data file, but {len(data)} are given.")
    if stated.plan is not None and not stated.plan.parent.is_dir():
        raise InputError(f"--plan {stated.plan} cannot be written: its folder does not exist.")
    if len({path.stem for path in data}) < len(data):
        raise InputError("two of the data files have the same name: they would share a folder.")
    former = None if stated.former is None else read_former_answer(stated.former)
    simulate = not several if stated.responses is None else stated.responses
    refused = []
    for path in data:
        own_model = path.with_suffix(".toml")
        try:
            with staged(out / path.stem if several else out) as folder:
                given = own_model if several and own_model.exists() else model
                structure, measured = read_test(path, given, stated.add)
                for note in measured.notes:
                    warn(note)
                points = [one.strip() for one in stated.where.split(",") if one.strip()]
                diagnosed = diagnose_test(
                    measured, structure, simulate=simulate, former=former, where=points
                )
                title = path.stem.replace("_", " ")
                page.write(folder, diagnosed, title=title, data=path.name)
                if stated.plan is not None:
                    _write_plan(stated.plan, diagnosed.diagnosis)
        except InputError as error:
            if not several:
                raise
            warn(InputError.located(path.name, error))
            refused.append(path.name)
            continue
        if not several:
            for note in diagnosed.diagnosis.notes:
                warn(note)
        print_line(f"{path.name}: {page.answer_in_words(diagnosed)}")
        for line in page.headline(diagnosed):
            print_line(f"  {line}")
    if not several:
        written(out)
    if refused:
        raise InputError(f"no diagnosis for {len(refused)} of {len(data)}: {', '.join(refused)}.")


with_options(diagnose, DiagnoseOptions)


def _write_plan(file: Path, diagnosis: "Diagnosis") -> None:
    """Write the measurement plan, or warn why there is none."""
    from snrmjax.diagnose.measurement_plan import measurement_plan
    from snrmjax.io.measurement_plans import write_plan

    plan = measurement_plan(diagnosis)
    if plan is None:
        why = "no measurement of steady states would decide."
        if diagnosis.decide_by is None:
            why = "no open question remains that a measurement would decide."
        warn(f"no plan is written to {file}: {why}")
        return
    write_plan(file, plan)
    print_line(f"  {plan.states.n_states} steady states to be measured are written to {file}")
