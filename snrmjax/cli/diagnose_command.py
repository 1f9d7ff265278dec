"""The command `diagnose`: what a model lacks."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from snrmjax.cli.console import say, staged, warn
from snrmjax.cli.options import FILES, OptionRow, Out, with_options
from snrmjax.io.models import read_model
from snrmjax.io.tables import read_steady_states

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
    """Find the physics that a model lacks: where it disagrees with the data, and what that is.

    Writes diagnosis.json, figures, report.html and model.toml, the completed model; of several
    files each into a folder of its own name.

    Without phases (`velocity_m_s`, or a `phase_std_deg` of 60 or more) the notes say what
    these data cannot decide.
    """
    from snrmjax.io.measurement_plans import read_former_answer, read_further_states
    from snrmjax.report.diagnosis_report import readable_verdict, write_diagnosis

    several = len(data) > 1
    plan, add, former = options["plan"], options["add"], options["former"]
    for option, given in (("--plan", plan), ("--add", add), ("--continue", former)):
        if several and given:
            raise ValueError(f"`{option}` is for one data file, but {len(data)} are given.")
    if former is not None and not add:
        raise ValueError("`--continue` needs further states: name their file with `--add`.")
    if plan is not None and not plan.parent.is_dir():
        raise ValueError(f"--plan {plan} cannot be written: its folder does not exist.")
    before = None if former is None else read_former_answer(former)
    if len({path.stem for path in data}) < len(data):
        raise ValueError("two of the data files have the same name: they would share a folder.")
    refused = []
    for path in data:
        beside = path.with_suffix(".toml")
        own = beside if several and beside.exists() else model
        try:
            with staged(out / path.stem if several else out) as folder:
                structure = read_model(own)
                measured = read_steady_states(path, structure)
                for file in add:
                    measured = read_further_states(file, structure, measured)
                for note in measured.notes:
                    warn(note)
                simulate = not several if options["responses"] is None else options["responses"]
                found, _ = write_diagnosis(
                    folder, path.stem, structure, measured, simulate=simulate, former=before
                )
                if plan is not None:
                    _write_plan(plan, found)
        except ValueError as error:
            if not several:
                raise
            warn(f"{path.name}: {error}")
            refused.append(path.name)
            continue
        if not several:
            for note in found.notes:
                warn(note)
        effects = ", ".join(found.effects)
        if effects:
            effects = f" ({effects})" if found.verdict.is_answer else f"; best attempt: {effects}"
        say(f"{path.name}: {found.verdict.replace('_', ' ')}{effects}")
        say(f"  {readable_verdict(found)}")
        say(f"  probability: {found.most_probable()}")
        if found.decide_by:
            say(f"  what would decide: {found.decide_by}")
    if not several:
        say(f"written to {out}: open {out / 'report.html'}")
    if refused:
        raise ValueError(f"no diagnosis for {len(refused)} of {len(data)}: {', '.join(refused)}.")


_RESPONSES = OptionRow(
    *("responses", bool),
    "Simulate the responses of the model as given and as completed, for comparison with the data. "
    "Default: for a single file.",
)
_FILE_ROWS = (
    OptionRow(
        *("plan", Path),
        "Write the measurement that would decide an open answer: a CSV of steady states to be "
        "filled in.",
        "FILE",
    ),
    OptionRow(
        *("add", list[Path]),
        "Further steady states of the same structure, such as a plan that was filled in: one "
        "diagnosis of all states (repeatable).",
        "FILE",
    ),
    OptionRow(
        *("former", Path),
        "diagnosis.json of the states without those of `--add`: fits begin at its answers too, and "
        "the notes say what the further states changed.",
        "FILE",
        flag="--continue",
    ),
)
with_options(diagnose, {None: (_RESPONSES,), FILES: _FILE_ROWS})


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
