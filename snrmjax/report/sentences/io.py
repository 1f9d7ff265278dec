"""What files, and their import, have to tell."""

from collections.abc import Sequence

from snrmjax.report.sentences import Wording, number_of

_LEVELS_BY = {
    "drive": "by amplitude of the drive",
    "force": "by amplitude of the force",
    "runs": "by runs of the frequency",
}


def _steps_used(used: int, left_out: Sequence[tuple[str, int]]) -> str:
    reasons = ", ".join(f"{count} {reason}" for reason, count in left_out if count)
    total = used + sum(count for _, count in left_out)
    return f"{used} of {total} steps used{f'; left out: {reasons}' if reasons else ''}."


def _our_own_table(unit: str, force_unit: str, amplitude: str, conjugated: bool) -> str:
    said = (
        (unit, f"velocity columns in {unit}"),
        (force_unit, f"forces in {force_unit}"),
        (amplitude, f"amplitudes {amplitude}"),
        (conjugated, "phasors conjugated"),
    )
    how = ", ".join(words for is_so, words in said if is_so) or "taken as they are"
    return f"the columns are those of our table: {how}."


SENTENCES: dict[str, Wording] = {
    # Why an import took what nobody stated.
    "unit_of_file": "the file says so",
    "unit_stated_over_file": "stated, though the file says {unit}",
    "units_say_so": "the units say so",
    "nothing_is_said": "nothing is said",
    "column_by_name": "the column's name says so",
    "by_names_of_columns": "by the names of the columns",
    "column_says_so": "{column} says so",
    "phase_beyond_two_turns": "{column} reaches beyond two turns in radians",
    "phase_ahead_of_the_force": "a positive phase is ahead of the force, e^(+iwt)",
    "imaginary_ahead_of_the_force": "a positive imaginary part is ahead of the force",
    "phasors_turn_forward": "phasors are e^(+iwt)",
    "quantity_by_unit": "the unit {unit} says so",
    "sensor_not_stated": "not stated; --sensor names it",
    "deviation_of_one_row": ("1σ of the row, by its name (if of each of N readings: divide by √N)"),
    "level_a_file": "one level a file, in the order in which they were named",
    "level_a_record": "one level a record, in the order in which they were named",
    "level_a_set": "one level a set of responses, in the file's order",
    "levels_found": "{n} found",
    "levels_counted": lambda n, by: f"{number_of(n, 'level')} {_LEVELS_BY[by]}",
    "record_recognised": "recognised in the record",
    "spectra_of_one_reference": "spectra or responses over one reference, of amplitude 1",
    "reference_without_unit": "the file states none of the reference",
    # Notes on our own tables.
    "column_without_name": "column {number} of {file} has no name and is not used.",
    "column_not_used": lambda name, file, near: (
        f"the column `{name}` of {file} is not used{f' (did you mean `{near}`?)' if near else ''}."
    ),
    "column_partly_stated": (
        "`{name}` is not stated in {n} of {of} rows of {file} (first in row {first_row})."
    ),
    "error_of_no_harmonics": (
        "`harmonic_std_m_s` of {file} is not used: the table has no harmonics."
    ),
    "error_of_no_phases": "`phase_std_deg` of {file} is not used: the table has no phases.",
    "amplitudes_without_phases": (
        "{file} has the amplitude of the velocity alone: its phase is unknown, and that of "
        "harmonics is not used."
    ),
    # Notes on an import.
    "note_of_file": "{file}: {note}",
    "rows_incomplete": "{n} of {of} rows of {file} are incomplete, left out.",
    "steps_used": _steps_used,
    "our_own_table": _our_own_table,
}
