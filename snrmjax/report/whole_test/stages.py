"""The stages of a test: linear modes, states of records, identification, diagnosis; one report."""

import itertools
import time
from collections.abc import Callable, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import NamedTuple

import numpy as np

from snrmjax.diagnose.diagnosis_result import Diagnosis
from snrmjax.doctor.check import check_test
from snrmjax.doctor.findings import Checkup, Finding
from snrmjax.identify.modal.free_decay import DecayModes
from snrmjax.identify.modal.modal_fit import LinearModalFit
from snrmjax.identify.modal.modes_of_tests import find_modes
from snrmjax.identify.modal.response_data import joined_responses
from snrmjax.identify.scaling.scale import DrivePoint, scale_modes
from snrmjax.identify.scaling.scaled_modes import ScaledModes
from snrmjax.io.laboratory.checkups import write_checkup
from snrmjax.io.models import read_model
from snrmjax.io.tables import write_steady_states
from snrmjax.io.units import HERTZ
from snrmjax.measure.recordings.step_counts import StepCounts, joined_counts
from snrmjax.measure.recordings.stepped_sine import SteppedSineStates, stepped_sine_states
from snrmjax.measure.states import (
    UNNAMED_SENSOR,
    SteadyStates,
    join_steady_states,
    with_levels_apart,
)
from snrmjax.methods.records.recorded_test import RecordedTest, RecordKind, recorded_test
from snrmjax.model.structures import Structure
from snrmjax.report.diagnosis_report import readable_verdict, write_diagnosis
from snrmjax.report.html import (
    LiveFigures,
    Report,
    ReportTable,
    Section,
    write_report,
)
from snrmjax.report.interactive.folded_records import folded_records
from snrmjax.report.interactive.live_figures import NEEDED, has_bokeh
from snrmjax.report.interactive.state_explorer import FoldedRecord, state_explorer
from snrmjax.report.modal.modal_report import modal_report, modes_sentence, write_modal_tables
from snrmjax.report.whole_test.folder_contents import NamedRecord, TestFiles
from snrmjax.report.whole_test.mends import FilesRead, is_certain, with_imports
from snrmjax.report.whole_test.undiagnosed import not_diagnosed
from snrmjax.report.workflow import (
    Findings,
    Loads,
    headline,
    identify_by_points,
    identify_jointly,
    write_findings,
)

_FEWEST_ALIKE = 3  # states of two files
_ALIKE = 1e-5  # relative difference of frequency and velocity, below what repeated tests reach
_TINY = 1e-300
_MOTIONS = ("velocity", "acceleration", "displacement")
_TAPPED = "A state that is tapped shows its record, where there is one."


class TestRequest(NamedTuple):
    """What the user answers beforehand."""

    drive_point: str | None = None
    go_on: bool = False  # in spite of errors that the check finds
    diagnose: bool = True
    read: FilesRead | None = None  # of which imports that mend are written


class _Modes(NamedTuple):
    model: Structure
    report: Report | None  # None where the folder had a model
    sentence: str


class _Steps(NamedTuple):
    """States of a record of a stepped sine, and the record folded for each."""

    states: SteadyStates
    folded: list[FoldedRecord | None]
    counts: StepCounts
    note: str


def run_whole_test(
    folder: Path,
    files: TestFiles,
    name: str,
    request: TestRequest,
    progress: Callable[[str], None] = lambda _: None,
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Check, find linear modes, identify and diagnose a test, and write all of it into a folder.

    Writes model.toml and modes.csv where the linear modes were found here, measured.csv (all
    steady states), check.json, report.html, and what `identify` and `diagnose` write into folders
    of these names.
    Arguments: `progress` is told each stage when it ends, with its seconds.
    Returns notes, and the results in plain sentences.
    Raises `ValueError`, as a question, where it would have to guess: which sensor is at the force,
    or whether to go on in spite of what the check found; and as its stages do.
    """
    stage = _Stages(progress)
    modes = _linear_model(folder, files, request)
    stage.ends("linear modes")
    sorted_records = [_sorted(one, modes.model) for one in files.records]
    steps = [_steps(named, one) for named, one in _stepped(files, sorted_records)]
    tables = [one.of_model(modes.model) for one in files.states]
    parts = with_levels_apart([*tables, *(one.states for one in steps)])
    if not parts:
        raise ValueError(
            f"{name} holds no steady states and no record of a stepped sine: the linear modes are "
            "all that it tells, as `snrmjax modes` writes them."
        )
    stepped = [named.file for named, one in _stepped(files, sorted_records)]
    names = [*(one.file for one in files.states), *stepped]
    _refuse_doubled(names, parts)
    data = join_steady_states(parts)
    stage.ends(f"{data.n_states} steady states")
    checkup = check_test(parts, modes.model, [one.record for one in files.records])
    checkup = with_imports(checkup, request.read)
    _stop_at_errors(checkup, request)
    write_steady_states(folder / "measured.csv", data)
    write_checkup(folder / "check.json", checkup)
    stage.ends("check")
    findings, why = _identified(data, modes.model)
    (folder / "identify").mkdir()
    found = write_findings(
        folder / "identify",
        findings,
        name,
        {"data": "measured.csv", "model": modes.model.name},
    )
    folded: list[FoldedRecord | None] = [None] * sum(one.n_states for one in tables)
    folded += [shown for one in steps for shown in one.folded]
    live = None
    if has_bokeh():
        live = state_explorer(data, findings.identification, folded if steps else ())
    stage.ends("backbone and damping")
    diagnosis, diagnosed = None, None
    skipped = not_diagnosed(data, modes.model) if request.diagnose else ()
    if request.diagnose and not skipped:
        (folder / "diagnose").mkdir()
        diagnosis, diagnosed = write_diagnosis(
            folder / "diagnose", "measured", modes.model, data, simulate=True
        )
        stage.ends("diagnosis")
    unnamed = _taken_sensors(files, modes.model)
    notes = (*skipped, *files.notes, *unnamed, *(one.note for one in steps), *why)
    sorted_in_words = [
        (named.file, f"{one.kind.value}: {one.why}")
        for named, one in zip(files.records, sorted_records, strict=True)
    ]
    counts = _used_steps(files, [one.counts for one in steps])
    if counts is not None and counts.reasons:
        found = found._replace(summary=[*found.summary, ("steps of the records", counts.words)])
    lines = (
        modes.sentence,
        *(() if counts is None else (f"steady states: {counts.words}",)),
        _check_sentence(checkup),
        *headline(findings),
        *(() if diagnosis is None else (readable_verdict(diagnosis),)),
    )
    _write_whole_report(
        folder,
        name,
        files,
        sorted_in_words,
        checkup,
        live,
        [("Linear modes", modes.report), ("Backbone", found), ("Diagnosis", diagnosed)],
        notes,
        _result(checkup, found, diagnosis, counts)
        + (" The diagnosis was left out: the first note says why." if skipped else ""),
    )
    stage.ends("report")
    return notes, lines


class _Stages:
    """Tells each stage with its seconds."""

    def __init__(self, progress: Callable[[str], None]) -> None:
        self.progress, self.began = progress, time.perf_counter()

    def ends(self, name: str) -> None:
        """One stage ended, and the next one begins."""
        now = time.perf_counter()
        self.progress(f"{name}: {now - self.began:.1f} s")
        self.began = now


def _taken_sensors(files: TestFiles, model: Structure) -> tuple[str, ...]:
    """That files without a name of a sensor were taken for the model's only one."""
    names = [one.file for one in files.states if one.names_no_sensor]
    if not names or model.modes.sensors == UNNAMED_SENSOR:
        return ()
    verb = "names" if len(names) == 1 else "name"
    return (
        f"the file{'s' if len(names) > 1 else ''} {', '.join(names)} {verb} no sensor: taken for "
        f"the model's only one, {model.modes.sensors[0]}. A column `sensor`, or `--sensor` of the "
        "import, states it.",
    )


def _result(
    checkup: Checkup, found: Report, diagnosis: Diagnosis | None, counts: StepCounts | None
) -> str:
    """Check, backbone and diagnosis in a sentence each; their numbers are in the summary."""
    told = [f"{_check_sentence(checkup).capitalize()}.", found.result]
    told += [f"{counts.words}."] if counts is not None and counts.reasons else []
    told += [] if diagnosis is None else [readable_verdict(diagnosis)]
    return " ".join(one for one in told if one)


def _linear_model(folder: Path, files: TestFiles, request: TestRequest) -> _Modes:
    if files.model is not None:
        linear = files.model.modes
        j = linear.mode_of_interest
        hertz, ratio = float(linear.natural_frequency[j]) / HERTZ, float(linear.damping_ratio[j])
        return _Modes(
            files.model,
            None,
            f"linear mode of {files.model_file}: {hertz:.5g} Hz, damping {100 * ratio:.3g} %",
        )
    if files.responses:
        source: object = joined_responses([one.responses for one in files.responses])
    elif files.states:
        source = join_steady_states(with_levels_apart([one.states for one in files.states]))
    else:
        raise ValueError(
            "what are the linear modes? The folder has time records only: put a model.toml or "
            "frequency responses beside them."
        )
    fitted, further = find_modes(source)  # type: ignore[arg-type]
    scaled = _scaled(fitted, DrivePoint(request.drive_point))
    interest = _nearest_mode(scaled, files)
    write_modal_tables(folder, "model.toml", scaled, interest=interest)
    report = modal_report("model", scaled, fitted, interest=interest, further_notes=further)
    return _Modes(read_model(folder / "model.toml"), report, modes_sentence(scaled))


def _scaled(fitted: LinearModalFit | DecayModes, by: DrivePoint) -> ScaledModes:
    try:
        return scale_modes(fitted, by)
    except ValueError as error:
        raise ValueError(
            f"how are the mode shapes scaled? {error} Answer by `--drive-point SENSOR`, or write "
            "the model by `snrmjax modes`, which knows further ways, into this folder."
        ) from error


def _nearest_mode(scaled: ScaledModes, files: TestFiles) -> int:
    """The mode at which the steady states are; the first where there are none."""
    if not files.states:
        return 0
    middle = np.median(np.concatenate([np.asarray(one.states.frequency) for one in files.states]))
    return int(np.argmin(np.abs(np.asarray(scaled.natural_frequency) - middle)))


def _sorted(named: NamedRecord, model: Structure) -> RecordedTest:
    try:
        return recorded_test(named.record, model.modes)
    except ValueError as error:
        moves = any(one.quantity in _MOTIONS for one in named.record.channels)
        mend = (
            ""
            if moves
            else f" `snrmjax import {named.file}` says what the file holds and how to import it; "
            "put the map.toml that the import writes into the folder."
        )
        raise ValueError(f"{named.file}: {str(error).lstrip(' :')}{mend}") from error


def _stepped(
    files: TestFiles, tests: Sequence[RecordedTest]
) -> list[tuple[NamedRecord, RecordedTest]]:
    """Records that are stepped sines."""
    both = zip(files.records, tests, strict=True)
    return [(named, one) for named, one in both if one.kind is RecordKind.STEPPED_SINE]


def _refuse_doubled(names: Sequence[str], parts: Sequence[SteadyStates]) -> None:
    """Raise `ValueError` where two files hold the same states: no repetition is that alike."""
    for (a, one), (b, two) in itertools.combinations(zip(names, parts, strict=True), 2):
        first, second = (
            np.log([part.frequency, np.sum(np.abs(part.velocity), axis=1) + _TINY])
            for part in (one, two)
        )
        apart = np.max(np.abs(first[:, :, None] - second[:, None, :]), axis=0)
        same = int(np.sum(apart.min(axis=0) < _ALIKE))
        if same >= max(_FEWEST_ALIKE, min(one.n_states, two.n_states) / 2):
            raise ValueError(
                f"which of {a} and {b} is the test? Both hold the same {same} steady states, which "
                "would count twice: move one of them out of the folder."
            )


def _steps(named: NamedRecord, test: RecordedTest) -> _Steps:
    """Steady states of a stepped sine, by its channels."""
    channels = test.channels
    force = channels.force or channels.drive
    if force is None:
        raise ValueError(f"{named.file} is a stepped sine, but has no channel of force or drive.")
    found: SteppedSineStates = stepped_sine_states(
        named.record,
        force,
        channels.motions,
        sensors=channels.sensors,
        drive=channels.drive if channels.force else None,
    )
    folded = folded_records(named.record, found, force, channels.reference)
    return _Steps(found.states, folded, found.counts, f"{named.file}: {found.counts.words}")


def _used_steps(files: TestFiles, steps: Sequence[StepCounts]) -> StepCounts | None:
    """The counts of the records, or those of the import of all tables; None where not all are."""
    if steps:
        return None if files.states else joined_counts(steps)
    imported = files.steps_at_import
    used = sum(one.states.n_states for one in files.states)
    return imported if imported is not None and imported.used == used else None


def _stop_at_errors(checkup: Checkup, request: TestRequest) -> None:
    errors = [one for one in checkup.findings if one.severity == "error"]
    if not errors or request.go_on:
        return
    first, *others = errors
    both = [is_certain(first) and is_certain(one) for one in others]
    more = "".join(
        f" {'Besides,' if beside else 'Or'} {one.evidence} {one.mend}"
        for one, beside in zip(others, both, strict=True)
    )
    raise ValueError(
        f"is this meant? {first.name} in {first.where}: {first.evidence} To mend "
        f"it: {first.mend}{more} To go on nevertheless: `--go-on`."
    )


def _check_sentence(checkup: Checkup) -> str:
    grave = [one for one in checkup.findings if one.severity != "info"]
    if not grave:
        return "check: nothing found"
    listed = ", ".join(dict.fromkeys(one.name for one in grave))
    return f"check: {listed}"


def _identified(data: SteadyStates, model: Structure) -> tuple[Findings, tuple[str, ...]]:
    """A joint fit; curves through the points where the states are too few for one."""
    drive_only = not np.isfinite(np.asarray(data.force)).any()
    free = ("instrument_phase",) if drive_only else ()
    try:
        return identify_jointly(data, model, Loads(), free=free), ()
    except ValueError as error:
        if drive_only:
            raise
        reason = f"curves go through single points, as a joint fit was not possible: {error}"
        return identify_by_points(data, model, Loads()), (reason,)


def _write_whole_report(
    folder: Path,
    name: str,
    files: TestFiles,
    sorted_records: Sequence[tuple[str, str]],
    checkup: Checkup,
    live: LiveFigures | None,
    stages: Sequence[tuple[str, Report | None]],
    notes: Sequence[str],
    result: str,
) -> None:
    """One page: files, check, all states to look at, then the stages' own sections."""
    told = [(stage, report) for stage, report in stages if report is not None]
    rows = [(stage, row) for stage, report in told for row in report.summary]
    if told[0][0] == "Linear modes":  # which has the linear mode with its errors already
        rows = [(stage, row) for stage, row in rows if row[0] != "linear mode"]
    summary = list(dict.fromkeys(row for _, row in rows))
    sections = [
        Section(
            "Files",
            [f"{file}: {words}." for file, words in sorted_records],
            tables=[
                ReportTable(("file", "what was found in it"), list(files.rows())),
                *(
                    ReportTable((file,), [(line,) for line in lines], f"{file}, as it lies here.")
                    for file, lines in files.texts
                ),
            ],
        ),
        _check_section(checkup),
        Section("States", [_TAPPED if live is not None else f"{NEEDED}."], live=live),
    ]
    for stage, report in told:
        sections += [
            one._replace(heading=f"{stage}: {one.heading[0].lower()}{one.heading[1:]}")
            for one in report.sections
        ]
    first: dict[str, str] = {}  # each note once, of the stage that said it first
    for stage, report in told:
        for note in report.notes:
            first.setdefault(note, stage)
    every = [f"{stage}: {note}" for note, stage in first.items() if note not in notes]
    write_report(
        folder / "report.html",
        Report(
            title=f"Test: {name}",
            done=[("program", f"snrmjax {version('snrmjax')}")],
            result=result,
            summary=summary,
            notes=[*notes, *every],
            sections=sections,
        ),
    )


def _check_section(checkup: Checkup) -> Section:
    header = ("severity", "what", "where", "evidence", "what mends it")

    def row(one: Finding) -> tuple[str, ...]:
        return (one.severity, one.name, one.where, str(one.evidence), str(one.mend))

    rows = [row(one) for one in checkup.findings]
    text = [_check_sentence(checkup).capitalize() + ".", *map(str, checkup.notes)]
    return Section("Check", text, tables=[ReportTable(header, rows)] if rows else ())
