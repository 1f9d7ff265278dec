"""Sentences of files and their import."""

from snrmjax.report.sentences import Wording, number_of


def _our_own_table(unit: str, force_unit: str, amplitude: str, conjugated: bool) -> str:
    stated = (
        (unit, f"velocity columns in {unit}"),
        (force_unit, f"forces in {force_unit}"),
        (amplitude, f"amplitudes {amplitude}"),
        (conjugated, "phasors conjugated"),
    )
    how = ", ".join(words for is_stated, words in stated if is_stated) or "used as they are"
    return f"the columns are those of a steady-state table: {how}."


_NOT_READ = {
    "empty": "is empty",
    "type": "is of an unsupported type",
    "marks": "labels the lines of responses",
    "times_of_day": "contains times of day",
    "sparse": "is a sparse matrix: save numbers, text, structs and cells",
    "circle": "has circular links or is nested too deeply",
    "other_file": "is a link to another file",
    "elsewhere": "is stored in other files",
    "never_written": "was declared but never written",
    "larger_than_file": "states more numbers than the file can hold",
    "large_pieces": "is stored in chunks that are too large",
    "too_many_texts": "has too many texts",
}


SENTENCES: dict[str, Wording] = {
    # Reasons for what an import assumed.
    "unit_of_file": "as stated in the file",
    "unit_stated_over_file": "as stated, although the file has {unit}",
    "units_say_so": "from the units",
    "nothing_is_said": "not stated",
    "column_by_name": "from the name of the column",
    "by_names_of_columns": "from the names of the columns",
    "phase_beyond_two_turns": "in radians {column} would exceed two revolutions",
    "phase_ahead_of_the_force": "a positive phase leads the force, e^(+iwt)",
    "imaginary_ahead_of_the_force": "a positive imaginary part leads the force",
    "phasors_turn_forward": "phasors are e^(+iwt)",
    "quantity_by_unit": "from the unit {unit}",
    "sensor_not_stated": "not stated; set it with --sensor",
    "deviation_of_one_row": (
        "1σ of the row, from its name (if of each of N readings: divide by √N)"
    ),
    "level_a_file": "one level per file, in the order given",
    "level_a_record": "one level per record, in the order given",
    "level_a_set": "one level per set of responses, in the order of the file",
    "levels_found": "{n} found",
    "record_recognised": "detected in the record",
    "spectra_of_one_reference": "spectra or responses relative to one reference, of amplitude 1",
    "reference_without_unit": "the file states no unit of the reference",
    # Notes on tables of steady states.
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
        "{file} has the velocity amplitude only: its phase is unknown, and the phases of "
        "harmonics are not used."
    ),
    # Notes on laboratory files.
    "not_read": lambda name, why: f"{name} {_NOT_READ[why]}; not read.",
    "object_not_read": lambda name, kind: (
        f"{name} is of the class {kind.replace('_', ' ')}; not read: save numbers, text, structs "
        "and cells" + (f" (table2struct({name}, 'ToScalar', true))." if kind == "table" else ".")
    ),
    "nothing_measured": lambda names: (
        "it contains only text, single numbers and empty arrays"
        + (f" ({', '.join(names)})." if names else ".")
    ),
    "not_a_table": lambda name, sides: (
        f"{name} has {' by '.join(map(str, sides))} numbers and is not read as a table."
    ),
    "uneven_time": (
        "{name} is not evenly sampled and is read as a column: it has {n:#odd step} ({step:.6g} s "
        "to sample {sample}, at {at:.9g} s; usually {usual:.6g} s). Cut or resample the record "
        "there."
    ),
    "time_resampled": (
        "{name} has {n:#odd step} ({step:.6g} s to sample {sample}, at {at:.9g} s; usually "
        "{usual:.6g} s): resampled at {rate:.10g} Hz by cubic splines."
    ),
    "time_seen_in_places": "{name} was checked at three positions: even steps.",
    "responses_along_first_side": "responses along the first axis that is not frequency.",
    "columns_numbered": "no header row above the numbers: the columns are numbered.",
    "comments_not_read": "{n:#comment line} among the numbers not read.",
    "even_axis": (
        "the frequencies of {name} are from {start:g} to {stop:g} Hz in steps of {step:g} Hz, as "
        "stated."
    ),
    "responses_without_axis": (
        "{name} has {n} lines without frequencies: state their step in Hz by --frequency-step and "
        "the first one by --frequency-start (0 by default)."
    ),
    "level_as_amplitude": "{name} is a level in {unit}: converted to amplitudes.",
    "thousands": "column {name} has thousands separators: {text} is {number:.10g}.",
    "other_decimal": "column {name} has a decimal {decimal}, unlike other columns.",
    "empty_fields": "column {name} has {n:#empty field}.",
    "text_says": lambda separator, decimal, n: (
        f"separator {separator}, decimal {decimal}, {number_of(n, 'segment')}, as stated in its "
        "header."
    ),
    "samples_missing": "channel {name}: the file states {of} samples and holds {n}.",
    "whole_rate_of_digits": (
        "the step {step} s has few digits: {rate} Hz, the only integer rate that rounds to it."
    ),
    "rate_left_open": (
        "the step {step} s has few digits: frequencies may be off by {off:.1g} %, unless the "
        "sampling rate is stated (`--rate`, or `rate` in map.toml); it may be {rate:g} Hz."
    ),
    "channels_shifted": lambda names, seconds: (
        "by the start times stated in the file, "
        + ", ".join(
            f"{name} began {1e3 * each:.6g} ms" for name, each in zip(names, seconds, strict=True)
        )
        + " earlier: only the time common to all channels is read."
    ),
    "clocks_apart": lambda names, of, seconds, samples, rates: (
        f"{', '.join(names)} and {', '.join(of)} are separate records, between which phases are "
        + (
            f"not known: they are sampled at {rates[1]:.10g} and {rates[0]:.10g} Hz."
            if rates[0] != rates[1]
            else f"not read: by the file's start times they begin {1e3 * seconds:.6g} ms apart, "
            + (
                f"{samples:.4g} samples. Only whole samples are shifted."
                if abs(samples - round(samples)) > 0.01
                else "and overlap for less than half of their time."
            )
        )
    ),
    "channels_cut": lambda names, n: (
        f"{', '.join(names)} {'has' if len(names) == 1 else 'have'} more samples than the {n} "
        "common to all channels: those beyond are left out."
    ),
    "channels_of_files": lambda files: f"one record of the channels of {', '.join(files)}.",
    "runs_side_by_side": lambda labels, n: (
        f"{n} runs side by side: one table with the column `run`"
        + (f" ({', '.join(labels)})." if any(labels) else ".")
    ),
    "rate_stated_above": "the sampling rate is stated above the numbers: {text}.",
    "text_read": "separator {separator}, decimal {decimal}, numbers from row {first_row}.",
    "coherence_alone": "a coherence without its frequency response is not read.",
    "abscissa_converted": "the abscissa is in {stated}: converted to {unit}.",
    "responses_over": (
        "the abscissa of the responses is {what}, no frequency: they are read as a table."
    ),
    "frequencies_do_not_rise": (
        "frequency responses whose frequencies do not increase are read as a table."
    ),
    "channel_described": "channel {name}: {text}.",
    "model_named": "model {name}.",
    "whole_rate": "rate {rate} per unit, from a step of six digits, {step:.5e}.",
    "six_digits": "the abscissa has six digits: its end may be off by {off:.1g}.",
    "no_unit_system": "no units (data set 164): SI where an axis states none.",
    "unit_system": lambda name, length, force: (
        f"units{name and ' '}{name}: 1 m is {length:.6g} in the file, 1 N is {force:.6g}."
    ),
    "unit_unknown": "the unit {unit!r} is not recognised; a factor of 1 is assumed.",
    "unit_of_other_quantity": "an axis of {stated} has the unit {unit!r}: read as {taken}.",
    "data_sets_not_read": lambda n, type, meaning: (
        f"{number_of(n, 'data set')} of type {type}{f' ({meaning})' if meaning else ''} not read."
    ),
    # Assumptions of a reduced model.
    "damping_assumed": "no damping is stated: {ratio:g} is assumed for every mode",
    "sensor_assumed": "no sensor is stated: {name}, where mode 1 is largest, is used",
    "point_force_assumed": "no participation is stated: a point force at {sensor} is assumed",
    "driven_at_largest": (
        "the model is driven and observed at node {node} in {direction}, where its first mode is "
        "largest"
    ),
    "large_displacements_taken": (
        "no step of the deck has NLGEOM: the load cases ran with large displacements, as `{step}` "
        "instead of the deck's steps"
    ),
    "loads_left_out": lambda keywords: (
        f"loads of the deck are ignored ({', '.join(f'*{word}' for word in keywords)}): the model "
        "is that of the unloaded structure"
    ),
    # Notes on an import.
    "note_of_file": "{file}: {note}",
    "rows_incomplete": "{n} of {of} rows of {file} are incomplete and left out.",
    "our_own_table": _our_own_table,
}
