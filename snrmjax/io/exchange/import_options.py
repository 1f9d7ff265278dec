"""Refusal of import options without effect, so that no option is silently ignored."""

from collections.abc import Collection, Sequence
from typing import Literal

from snrmjax.io.exchange.import_map import ImportMap
from snrmjax.io.laboratory.contents import LaboratoryFile
from snrmjax.numerics.rules import InputError

Content = Literal["own table", "table", "responses", "records"]

_TEXT = {"separator", "decimal", "header_row"}
_ANY = {"dataset", "response", "unit", "force_unit", *_TEXT}
_PHASORS = {*_ANY, "force", "base", "force_amplitude", "phase_sign", "amplitude", "level", "sensor"}
_EFFECTIVE: dict[Content, set[str]] = {
    "own table": {"dataset", "unit", "force_unit", "amplitude", "phase_sign", *_TEXT},
    "responses": {*_PHASORS, "frequency_start", "frequency_step"},
    "table": {
        *_PHASORS,
        *("frequency", "frequency_unit", "force_phase", "over_force", "phase_unit"),
        *("phase", "imaginary", "amplitude_std", "phase_std"),
    },
    "records": {*_ANY, "force", "base", "record", "rate", "level", "drive", "sensor", "phase_sign"},
}
_WHAT: dict[Content, str] = {
    "own table": "a table with our own columns",
    "table": "a table",
    "responses": "frequency responses",
    "records": "time records",
}
STAYS_RECORD = ("decay", "broadband")
"""Kinds of time records that an import keeps as records."""


def refuse_unused(
    stated: Collection[str], content: Content, mapping: ImportMap, file: str, kinds: Collection[str]
) -> None:
    """Raise `ValueError` that names an option without effect on the contents of the files.

    Arguments: `stated` are the keys of command-line options (a map file may come from another
    test); `kinds` of the files.
    """

    def refuse(key: str, why: str) -> None:
        raise InputError(f"--{key.replace('_', '-')} has no effect {why}: leave it out.")

    for key in stated:
        if key not in _EFFECTIVE[content]:
            refuse(key, f"on {_WHAT[content]}, as {file} holds")
        if key in _TEXT and not {"csv"}.intersection(kinds):
            refuse(key, f"on {file}, whose format is fixed")
    for first, second in (
        ("base", "force"),
        ("base", "force_unit"),
        ("base", "force_amplitude"),
        *((("force", "force_amplitude"),) if content == "table" else ()),
    ):
        if first in stated and second in stated:
            refuse(second, f"together with --{first}")
    if "force_phase" in stated and not mapping.load:
        refuse("force_phase", "without the column of a force or a base")
    if "force_phase" in stated and mapping.over_force:
        refuse("force_phase", "together with --over-force: phases are then relative to the force")
    has_force = content == "own table" or mapping.force or mapping.force_amplitude
    if "force_unit" in stated and not has_force:
        refuse("force_unit", "without --force or --force-amplitude")
    if content == "records" and mapping.record in STAYS_RECORD:
        for key in ("level", "drive"):
            if key in stated:
                refuse(key, f"on records that stay records (--record {mapping.record})")


def refuse_unused_axis(stated: Collection[str], files: Sequence[LaboratoryFile]) -> None:
    """Raise `ValueError` where frequencies are stated but no response lacks them."""
    for source in files:
        is_used = any(note.kind == "even_axis" for note in source.notes)
        if "frequency_step" in stated and not is_used:
            raise InputError(
                f"--frequency-step has no effect on {source.name}, which has no responses without "
                "frequencies: leave it out."
            )


def refuse_unused_phase_unit(stated: Collection[str], used: ImportMap) -> None:
    """Raise `ValueError` where a phase unit is stated, but no phase was read."""
    read = bool(used.force_phase) or any(response.phase for response in used.responses)
    if "phase_unit" in stated and not read:
        raise InputError(
            "--phase-unit has no effect: no phase column is read (--phase names one): leave it out."
        )
