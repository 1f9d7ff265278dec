"""Findings of the import check as JSON, and the records it examines."""

import json

from snrmjax.doctor.findings import Checkup
from snrmjax.io.files import FilePath, file_name, write_atomically
from snrmjax.io.laboratory.reading import read_laboratory_file
from snrmjax.measure.recordings.time_recording import TimeRecording
from snrmjax.numerics.rules import InputError


def write_checkup(path: FilePath, checkup: Checkup) -> None:
    """Write findings as a JSON list of kind, severity, where, evidence and mend.

    The list is empty where nothing was found. Raises `ValueError` when the file cannot be written.
    """
    findings = [finding.as_dict() for finding in checkup.findings]
    write_atomically(path, json.dumps(findings, indent=1, ensure_ascii=False) + "\n")


def read_recordings(path: FilePath) -> tuple[TimeRecording, ...]:
    """The time records of a laboratory's file. Raises `ValueError` where there are none."""
    recordings = read_laboratory_file(path).recordings
    if not recordings:
        raise InputError(f"{file_name(path)} holds no time record.")
    return tuple(recordings)
