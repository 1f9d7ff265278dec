"""The page of a whole test: files, check, all states, and the results of each stage."""

from pathlib import Path
from typing import NamedTuple

from snrmjax.doctor.findings import Checkup
from snrmjax.io.laboratory.checkups import write_checkup
from snrmjax.io.tables import write_steady_states
from snrmjax.numerics.units import HERTZ
from snrmjax.pipelines.whole_test import WholeTest
from snrmjax.report.figures.live import NEEDED, has_bokeh
from snrmjax.report.figures.state_explorer import state_explorer
from snrmjax.report.html import PROGRAM, Report, ReportTable, Section, write_report
from snrmjax.report.pages import diagnosis, identified_test, modes
from snrmjax.report.pages.identification import linear_mode_row

_TAPPED = "Tap a state to see its record, where there is one."


class _Stage(NamedTuple):
    name: str
    report: Report


def write(folder: Path, found: WholeTest) -> Report:
    """Write report.html, measured.csv, check.json, model.toml and modes.csv where the linear modes
    were identified here, and the files of `identify` and `diagnose` in folders of these names.
    """
    write_steady_states(folder / "measured.csv", found.data)
    write_checkup(folder / "check.json", found.checkup)
    stages = []
    if found.modes is not None:
        modes.write_tables(folder, found.modes)
        stages.append(_Stage("Linear modes", modes.modal_report(found.modes)))
    (folder / "identify").mkdir()
    identified = identified_test.write(
        folder / "identify", found.identified, title=found.name, data="measured.csv"
    )
    if found.counts is not None and found.counts.reasons:
        row = ("steps of the records", str(found.counts.fact))
        identified = identified._replace(summary=[*identified.summary, row])
    stages.append(_Stage("Backbone", identified))
    diagnosed = None
    if found.diagnosed is not None:
        (folder / "diagnose").mkdir()
        diagnosed = diagnosis.write(
            folder / "diagnose", found.diagnosed, title="measured", data="measured.csv"
        )
        stages.append(_Stage("Diagnosis", diagnosed))
    report = _report(found, stages, _result(found, identified, diagnosed))
    write_report(folder / "report.html", report)
    return report


def headline(found: WholeTest) -> list[str]:
    """Linear mode, states, check, backbone and diagnosis in a line or two each."""
    return [
        _linear_mode(found),
        *([] if found.counts is None else [f"steady states: {found.counts.fact}"]),
        _check(found.checkup),
        *identified_test.headline(found.identified),
        *([] if found.diagnosed is None else diagnosis.headline(found.diagnosed)[:1]),
    ]


def _linear_mode(found: WholeTest) -> str:
    if found.modes is not None:
        return modes.modes_sentence(found.modes.scaled)
    linear = found.model.modes
    j = linear.mode_of_interest
    hertz, ratio = linear.natural_frequency.item(j) / HERTZ, linear.damping_ratio.item(j)
    file = found.files.model_file
    return f"linear mode of {file}: {hertz:.5g} Hz, damping {100 * ratio:.3g} %"


def _check(checkup: Checkup) -> str:
    grave = [finding.name for finding in checkup.findings if finding.severity != "info"]
    return f"check: {', '.join(dict.fromkeys(grave)) or 'nothing found'}"


def _report(found: WholeTest, stages: list[_Stage], result: str) -> Report:
    rows = [row for stage in stages for row in stage.report.summary]
    if found.modes is not None:  # which has the linear mode with its errors already
        rows.remove(linear_mode_row(found.identified.model.modes))
    live = None
    if has_bokeh():
        records = found.folded if found.stepped else ()
        live = state_explorer(found.data, found.identified.identification, records)
    sections = [
        _files(found),
        _check_section(found.checkup),
        Section("States", [_TAPPED if live is not None else f"{NEEDED}."], live=live),
    ]
    for name, report in stages:
        sections += [
            section._replace(heading=f"{name}: {section.heading[0].lower()}{section.heading[1:]}")
            for section in report.sections
        ]
    notes = {str(note): "" for note in found.notes}
    for name, report in stages:  # each note once, from the first stage that has it
        for note in report.notes:
            notes.setdefault(note, f"{name}: ")
    return Report(
        title=f"Test: {found.name}",
        done=[PROGRAM],
        result=result,
        summary=list(dict.fromkeys(rows)),
        notes=[f"{stage}{note}" for note, stage in notes.items()],
        sections=sections,
    )


def _result(found: WholeTest, identified: Report, diagnosed: Report | None) -> str:
    """Check, backbone and diagnosis in a sentence each; their numbers are in the summary."""
    sentences = [f"{_check(found.checkup).capitalize()}."]
    sentences.append(identified.result)
    if found.counts is not None and found.counts.reasons:
        sentences.append(f"{found.counts.fact}.")
    sentences += [] if diagnosed is None else [diagnosed.result]
    if found.left_out:
        sentences.append("The diagnosis was skipped: the first note gives the reason.")
    return " ".join(text for text in sentences if text)


def _files(found: WholeTest) -> Section:
    tables = [
        ReportTable(("file", "content"), list(found.files.rows())),
        *(
            ReportTable((file,), [(line,) for line in lines], f"{file}, as in the folder.")
            for file, lines in found.files.texts
        ),
    ]
    sorted_records = [f"{file}: {test.kind.value}: {test.why}." for file, test in found.records]
    return Section("Files", sorted_records, tables=tables)


def _check_section(checkup: Checkup) -> Section:
    header = ("severity", "finding", "where", "evidence", "remedy")
    rows = [
        (finding.severity, finding.name, finding.where, str(finding.evidence), str(finding.advice))
        for finding in checkup.findings
    ]
    text = [f"{_check(checkup).capitalize()}.", *map(str, checkup.notes)]
    return Section("Check", text, tables=[ReportTable(header, rows)] if rows else ())
