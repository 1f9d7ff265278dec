"""The map of an import: which channel or column is what, as options and as `map.toml`."""

import shlex
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import tomli_w

from snrmjax.io.files import FilePath, file_name, read_text, shown
from snrmjax.io.laboratory.contents import TextFormat
from snrmjax.io.toml_table import TomlTable, parsed_toml
from snrmjax.measure.recordings.step_counts import StepCounts

_MOTIONS = ("displacement", "velocity", "acceleration")
_CHANNELS, _NUMBERS, _TEXTS = "Channels and columns", "What the numbers are", "Text files"


class MapKey(NamedTuple):
    """A key of a map and an option of an import: what it means, and the words it may have."""

    meaning: str
    metavar: str = "NAME"
    group: str = _CHANNELS
    choices: tuple[str, ...] = ()


RECORD_KINDS = ("steps", "sweep", "decay", "broadband")
"""What a time record may be: the last two are written as records, not as steady states."""

KEYS = {
    "dataset": MapKey("which of the file's datasets"),
    "record": MapKey(
        f"what a time record is: {', '.join(RECORD_KINDS)}", "KIND", _NUMBERS, RECORD_KINDS
    ),
    "frequency": MapKey("column of the forcing frequency"),
    "frequency_unit": MapKey("unit of the frequency: Hz or rad/s", "UNIT", _NUMBERS),
    "force": MapKey("channel or column of the force (or of the voltage that drives it)"),
    "force_unit": MapKey(
        "unit of the force: N, lbf, …; V: known as a drive voltage only", "UNIT", _NUMBERS
    ),
    "unit": MapKey(
        "unit of the responses; of our own table, what its velocity columns are", "UNIT", _NUMBERS
    ),
    "force_phase": MapKey("column of the force's own phase; empty: phases are relative to it"),
    "force_amplitude": MapKey(
        "force in N behind responses: one for all, one a set, or z: the z axis", "N", _NUMBERS
    ),
    "over_force": MapKey("whether responses of a table are divided by the force", "", _NUMBERS),
    "phase_unit": MapKey("unit of the phases: deg or rad", "UNIT", _NUMBERS, ("deg", "rad")),
    "phase_sign": MapKey(
        "sign of the phases: lead ahead of the force, lag behind it",
        *("SIGN", _NUMBERS, ("lead", "lag")),
    ),
    "amplitude": MapKey(
        "size of the amplitudes: peak, rms or peak_to_peak",
        *("SIZE", _NUMBERS, ("peak", "rms", "peak_to_peak")),
    ),
    "level": MapKey("what numbers levels: a column, or file, force, drive, runs, z, order", "RULE"),
    "drive": MapKey("channel of the generator's voltage, by which steps are recognised"),
    "separator": MapKey(
        "separator of columns: comma, semicolon, tab or space; empty: found",
        *("NAME", _TEXTS, ("comma", "semicolon", "tab", "space")),
    ),
    "decimal": MapKey(
        "decimal mark: point or comma; empty: found", "NAME", _TEXTS, ("point", "comma")
    ),
    "header_row": MapKey("row of a text's names, from 1; 0: found", "ROW", _TEXTS),
}
"""Of the whole test, in the order of the map."""

RESPONSE_KEYS = {
    "sensor": MapKey("name of the sensor as the model has it"),
    "phase": MapKey("column of the phase"),
    "imaginary": MapKey("column of the imaginary part (lock-in Y)"),
    "amplitude_std": MapKey("column of the amplitude's 1σ (default: by name, as R_std beside R)"),
    "phase_std": MapKey("column of the phase's 1σ, in its unit (default: by name)"),
}
"""Of each response; options have them in the order of the responses."""


class Assumption(NamedTuple):
    """Why something was taken that nobody stated, and its value where the map has none yet."""

    why: str
    value: str = ""

    def __str__(self) -> str:
        return f"{self.value}: {self.why}" if self.value else self.why


class Assumptions(dict[str, Assumption]):
    """What was taken for each key of the map that nobody stated, and why."""

    def unit(self, key: str, told: str, file_unit: str) -> None:
        """Record where a unit comes from: the map wins over the file."""
        if not told and file_unit:
            self[key] = Assumption("the file says so", file_unit)
        elif told and file_unit and told != file_unit:
            self[key] = Assumption(f"stated, though the file says {file_unit}", told)


class ResponseMap(NamedTuple):
    """One response: its channel or column, what it is, where its phase and its errors stand."""

    channel: str
    quantity: str = ""
    unit: str = ""
    sensor: str = ""
    phase: str = ""
    imaginary: str = ""
    amplitude_std: str = ""
    phase_std: str = ""


class ImportMap(NamedTuple):
    """All that an import is told; what is empty is found or assumed; see `map_text`."""

    responses: tuple[ResponseMap, ...] = ()
    dataset: str = ""
    record: str = ""
    frequency: str = ""
    frequency_unit: str = ""
    force: str = ""
    force_unit: str = ""
    unit: str = ""
    force_phase: str = ""
    force_amplitude: tuple[str, ...] = ()
    over_force: bool = False
    phase_unit: str = ""
    phase_sign: str = ""
    amplitude: str = ""
    level: str = ""
    drive: str = ""
    separator: str = ""
    decimal: str = ""
    header_row: int = 0

    @property
    def is_empty(self) -> bool:
        """Whether nothing is said of channels."""
        return self._replace(separator="", decimal="", header_row=0, dataset="") == ImportMap()

    @property
    def text_format(self) -> TextFormat:
        """How texts are written."""
        return TextFormat(self.separator or None, self.decimal or None, self.header_row or None)


def response_word(word: str, unit: str = "") -> ResponseMap:
    """A response of an option: "CH2:acceleration", "CH2:acceleration:g", or "CH2".

    Raises `ValueError` for a quantity that is no motion.

    >>> response_word("CH2:acceleration", "g")[:3]
    ('CH2', 'acceleration', 'g')
    """
    parts = word.split(":")
    if len(parts) > 1 and parts[-1] in _MOTIONS:
        return ResponseMap(":".join(parts[:-1]), parts[-1], unit)
    if len(parts) > 2 and parts[-2] in _MOTIONS:
        return ResponseMap(":".join(parts[:-2]), parts[-2], parts[-1])
    if len(parts) > 1 and parts[-1].isalpha():
        raise ValueError(
            f"--response must be a channel and one of {', '.join(_MOTIONS)}, as "
            f"CH2:acceleration, but is {shown(word)}."
        )
    return ResponseMap(word, "", unit)


def read_import_map(path: FilePath) -> ImportMap:
    """A map from its TOML. Raises `ValueError` that names file, key and what was expected."""
    file = file_name(path)
    table = parsed_toml(read_text(path), file)
    table.check_keys((), (*KEYS, "response", "steps"))
    found: dict[str, Any] = {}
    for key in (one for one in KEYS if one in table.entries):
        if key == "over_force":
            if not isinstance(table.entries[key], bool):
                raise table.refusal(key, "true or false", table.entries[key])
            found[key] = table.entries[key]
        elif key == "header_row":
            found[key] = table.whole(key, 0)
        elif key == "force_amplitude":
            found[key] = _amplitudes(table)
        elif KEYS[key].choices:
            found[key] = table.choice(key, ("", *KEYS[key].choices))
        else:
            found[key] = table.text(key)
    responses = []
    for one in table.tables("response", file):
        one.check_keys(("channel",), ResponseMap._fields[1:])
        if "quantity" in one.entries:
            one.choice("quantity", ("", *_MOTIONS))
        responses.append(
            ResponseMap(**{key: one.text(key) for key in ResponseMap._fields if key in one.entries})
        )
    return ImportMap(tuple(responses), **found)


def _amplitudes(table: TomlTable) -> tuple[str, ...]:
    value = table.entries["force_amplitude"]
    if value == "z":
        return ("z",)
    if isinstance(value, list) and not value:
        return ()
    return tuple(map(repr, table.numbers("force_amplitude", each="entry")))


def steps_of_map(path: FilePath) -> StepCounts | None:
    """How many steps of the records an import used; None where there were none."""
    file = file_name(path)
    table = parsed_toml(read_text(path), file)
    if "steps" not in table.entries:
        return None
    steps = table.table("steps", f"[steps] of {file}")
    left_out = steps.table("left_out", f"[steps.left_out] of {file}")
    return StepCounts(
        steps.whole("used", 0), {key: left_out.whole(key, 0) for key in left_out.entries}
    )


def map_text(
    used: ImportMap,
    assumed: Mapping[str, Assumption],
    notes: tuple[str, ...] = (),
    files: Sequence[str] = (),
    steps: StepCounts | None = None,
) -> str:
    """`map.toml`: every key with its meaning, and what was assumed with the reason.

    Arguments: `assumed` has the reason of each key that nobody stated; keys of the k-th response
    (from 1) as "response 1.unit"; `files` that were read, as seen from the map's folder;
    `steps` of the records that were used and left out.
    """
    lines = [
        "# How the laboratory's files were read. Take it for the next test: snrmjax import "
        "FILE --map map.toml --out DIR",
        *(["# files: " + shlex.join(files)] if files else []),
        *(f"# note: {' '.join(note.split())}" for note in notes),
    ]
    for key, one in KEYS.items():
        value = getattr(used, key)
        if key == "force_amplitude":
            value = "z" if value == ("z",) else [float(one) for one in value]
        lines.append(f"{_line(key, value)}  # {_comment(key, value, assumed) or one.meaning}")
    for k, response in enumerate(used.responses):
        lines += ["", "[[response]]"]
        for key, value in response._asdict().items():
            why = _comment(f"response {k + 1}.{key}", value, assumed)
            lines.append(_line(key, value) + (f"  # {why}" if why else ""))
    if steps is not None:
        lines += ["", tomli_w.dumps({"steps": steps._asdict()}).rstrip()]
    return "\n".join(lines) + "\n"


def _comment(key: str, value: object, assumed: Mapping[str, Assumption]) -> str:
    """Why a value was assumed, and what else it could be; empty for one that was stated."""
    if key not in assumed:
        return ""
    one = assumed[key]
    why = " ".join((one.why if one.value == value else str(one)).split())
    choices = KEYS[key].choices if key in KEYS else ()
    others = ", ".join(word for word in choices if word != value)
    return f"assumed: {why}" + (f" (else {others})" if others else "")


def _line(key: str, value: object) -> str:
    """One key on one line."""
    return " ".join(tomli_w.dumps({key: value}).split("\n")).strip().replace(",  ]", "]")
