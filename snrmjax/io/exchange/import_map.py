"""The map of an import: meaning of channels and columns, as options and as `map.toml`."""

import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import tomli_w

from snrmjax.io.files import FilePath, file_name, read_text, shown
from snrmjax.io.laboratory.names import listed_name
from snrmjax.io.toml_table import TomlTable, parsed_toml
from snrmjax.measure.recordings.step_counts import StepCounts
from snrmjax.numerics.facts import Fact
from snrmjax.numerics.names import suggestion
from snrmjax.numerics.rules import NOT_NEGATIVE, InputError

if TYPE_CHECKING:
    from snrmjax.io.laboratory.arrays.even_axis import EvenAxis
    from snrmjax.io.laboratory.contents import TextFormat

_MOTIONS = ("displacement", "velocity", "acceleration")
_COLUMNS = ("frequency", "force", "force_phase", "level", "drive")
_OF_RESPONSE = ("channel", "phase", "imaginary", "amplitude_std", "phase_std")
_CHANNELS, _NUMBERS, _TEXTS = "Channels and columns", "What the numbers are", "Text files"


BY_NAME = "name"
"""Keyword for amplitudes stated by file names."""


class MapKey(NamedTuple):
    """A key of a map and option of an import: its meaning and choices."""

    meaning: str
    metavar: str = "NAME"
    group: str | None = _CHANNELS  # None: options that most imports need
    choices: tuple[str, ...] = ()


# Kinds of time records: the last two are written as records, not as steady states.
_RECORDS = ("steps", "sweep", "decay", "broadband")

KEYS = {
    "dataset": MapKey("which of the file's datasets"),
    "record": MapKey(f"what a time record is: {', '.join(_RECORDS)}", "KIND", _NUMBERS, _RECORDS),
    "rate": MapKey(
        "sampling rate in Hz of records whose file has few digits; 0: the file's",
        *("HZ", _NUMBERS),
    ),
    "frequency": MapKey("column of the forcing frequency"),
    "frequency_unit": MapKey("unit of the frequency: Hz or rad/s", "UNIT", _NUMBERS),
    "frequency_start": MapKey(
        "first frequency in Hz of responses without frequencies", "HZ", _NUMBERS
    ),
    "frequency_step": MapKey("step of their frequencies in Hz; 0: the file's", "HZ", _NUMBERS),
    "force": MapKey("channel or column of the force (or of the drive voltage)", group=None),
    "force_unit": MapKey(
        "unit of the force: N, lbf, …; V: known as a drive voltage only", "UNIT", None
    ),
    "base": MapKey(
        "motion of a base in place of a force: as CH1:acceleration:g, 0.5:acceleration:g",
        *("NAME:KIND[:UNIT]", None),
    ),
    "unit": MapKey("unit of the responses, or of our own table's velocity columns", "UNIT", None),
    "force_phase": MapKey("column of the force's own phase; empty: phases are relative to it"),
    "force_amplitude": MapKey(
        "force in N: one for all, one a set or file, z: the z axis, name: file names",
        *("N", _NUMBERS),
    ),
    "over_force": MapKey("whether responses of a table are divided by the force", "", _NUMBERS),
    "phase_unit": MapKey("unit of the phases: deg or rad", "UNIT", _NUMBERS, ("deg", "rad")),
    "phase_sign": MapKey(
        "sign of the phases: lead ahead of the force, lag behind it",
        *("SIGN", _NUMBERS, ("lead", "lag")),
    ),
    "amplitude": MapKey(
        "kind of the amplitudes: peak, rms or peak_to_peak",
        *("SIZE", _NUMBERS, ("peak", "rms", "peak_to_peak")),
    ),
    "level": MapKey(
        "rule that numbers the levels: a column, or file, force, drive, runs, z, order", "RULE"
    ),
    "drive": MapKey("channel of the generator voltage, used to detect steps"),
    "separator": MapKey(
        "separator of columns: comma, semicolon, tab or space; empty: found",
        *("NAME", _TEXTS, ("comma", "semicolon", "tab", "space")),
    ),
    "decimal": MapKey(
        "decimal mark: point or comma; empty: found", "NAME", _TEXTS, ("point", "comma")
    ),
    "header_row": MapKey("row of a text's names, from 1; 0: found", "ROW", _TEXTS),
}
"""Keys of the whole test, in the order of the map."""

RESPONSE_KEYS = {
    "sensor": MapKey("name of the sensor as the model has it"),
    "phase": MapKey("column of the phase", group=None),
    "imaginary": MapKey("column of the imaginary part (lock-in Y)"),
    "amplitude_std": MapKey("column of the amplitude's 1σ (default: by name, as R_std next to R)"),
    "phase_std": MapKey("column of the phase's 1σ, in its unit (default: by name)"),
}
"""Keys of each response; options take them in the order of the responses."""


class Assumption(NamedTuple):
    """Reason of an assumption, and its value where the map has none yet."""

    why: Fact
    value: str = ""

    def __str__(self) -> str:
        return f"{self.value}: {self.why}" if self.value else str(self.why)


class Assumptions(dict[str, Assumption]):
    """Assumptions for keys of the map that were not stated."""

    def add(self, key: str, why: Fact, value: str = "") -> None:
        """Record an assumption."""
        self[key] = Assumption(why, value)

    def unit(self, key: str, stated: str, file_unit: str) -> None:
        """Record the source of a unit: the map takes precedence over the file."""
        if not stated and file_unit:
            self.add(key, Fact("unit_of_file"), file_unit)
        elif stated and file_unit and stated != file_unit:
            self.add(key, Fact("unit_stated_over_file", unit=file_unit), stated)


class ResponseMap(NamedTuple):
    """One response: its channel or column, quantity and unit, with columns of phase and errors."""

    channel: str
    quantity: str = ""
    unit: str = ""
    sensor: str = ""
    phase: str = ""
    imaginary: str = ""
    amplitude_std: str = ""
    phase_std: str = ""


class ImportMap(NamedTuple):
    """All options of an import; empty ones are detected or assumed; see `map_text`."""

    responses: tuple[ResponseMap, ...] = ()
    dataset: str = ""
    record: str = ""
    rate: float = 0.0
    frequency: str = ""
    frequency_unit: str = ""
    frequency_start: float = 0.0
    frequency_step: float = 0.0
    force: str = ""
    force_unit: str = ""
    base: str = ""
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
        """Whether no channel or column is stated."""
        plain = self._replace(separator="", decimal="", header_row=0, dataset="", rate=0.0)
        return plain._replace(frequency_start=0.0, frequency_step=0.0) == ImportMap()

    @property
    def base_motion(self) -> ResponseMap:
        """The base's channel or column with its quantity and unit; its name may be a number."""
        return response_word(self.base)

    @property
    def base_channel(self) -> str:
        """The channel or column of a base's motion, unless numbers or file names state it."""
        name = self.base_motion.channel if self.base else ""
        return "" if self.base_amplitudes or name == BY_NAME else name

    @property
    def base_amplitudes(self) -> tuple[float, ...]:
        """Amplitudes of the base motion stated as numbers, in the stated unit."""
        try:
            return tuple(float(word) for word in self.base_motion.channel.split(","))
        except ValueError:
            return ()

    @property
    def load(self) -> str:
        """The channel or column of the excitation: the force or the base motion."""
        return self.base_channel or self.force

    def with_names(self, units: Mapping[str, str]) -> "ImportMap":
        """With channels and columns named as in the listing, where the map has the file's names.

        Arguments: `units` of the listed names, "" where unknown.
        Raises `ValueError` for a response's word that is neither a name nor a name with a motion.
        """
        responses = []
        for response in self.responses:
            whole = ":".join(filter(None, (response.channel, response.quantity)))
            if whole in units and response.channel not in units:  # the name contains a colon
                response = response._replace(channel=whole, quantity="")
            resolved = {key: listed_name(getattr(response, key), units) for key in _OF_RESPONSE}
            responses.append(response._replace(**resolved))
            name = resolved["channel"]
            if name not in units and ":" in name and name.rsplit(":", 1)[1].isalpha():
                raise InputError(
                    f"--response must be a channel and one of {', '.join(_MOTIONS)}, as "
                    f"CH2:acceleration, but is {shown(name)}."
                )
        named: dict[str, Any] = {key: listed_name(getattr(self, key), units) for key in _COLUMNS}
        base = listed_name(self.base_channel, units) + self.base[len(self.base_channel) :]
        return self._replace(responses=tuple(responses), base=base, **named)

    @property
    def even_axis(self) -> "EvenAxis | None":
        """Stated frequencies of responses without a frequency axis, or None."""
        from snrmjax.io.laboratory.arrays.even_axis import axis_of_options

        return axis_of_options(self.frequency_start, self.frequency_step)

    @property
    def text_format(self) -> "TextFormat":
        """Format of text files."""
        from snrmjax.io.laboratory.contents import TextFormat

        return TextFormat(self.separator or None, self.decimal or None, self.header_row or None)


def response_word(word: str, unit: str = "") -> ResponseMap:
    """A response of an option: "CH2:acceleration", "CH2:acceleration:g", or "CH2".

    >>> response_word("CH2:acceleration", "g")[:3]
    ('CH2', 'acceleration', 'g')
    """
    parts = word.split(":")
    if len(parts) > 1 and parts[-1] in _MOTIONS:
        return ResponseMap(":".join(parts[:-1]), parts[-1], unit)
    if len(parts) > 2 and parts[-2] in _MOTIONS:
        return ResponseMap(":".join(parts[:-2]), parts[-2], parts[-1])
    return ResponseMap(word, "", unit)


def map_of_options(map_file: Path | None, given: Mapping[str, Any]) -> ImportMap:
    """The map from options and a file; options take precedence.

    Arguments: `given` has the options by the keys of a map, `response` as for `response_word`;
    empty ones were not given.
    Raises `ValueError` that names the option for an invalid choice, and where the number of sensors
    or phases differs from that of the responses.
    """
    words = {key: given[key] for key in KEYS if given.get(key)}
    for key, word in words.items():
        choices = KEYS[key].choices
        if choices and word not in choices:
            raise InputError(
                f"{_option(key)} must be one of {', '.join(choices)}, but is {shown(word)}"
                f"{suggestion(word, choices)}."
            )
    if "force_amplitude" in words:
        words["force_amplitude"] = _stated_amplitudes(words["force_amplitude"])
    if "base" in words:
        _require_base(words["base"])
    if "rate" in words and not 0 < words["rate"] < float("inf"):
        raise InputError(f"--rate must be above zero, but is {words['rate']:g} Hz.")
    base_map = ImportMap() if map_file is None else read_import_map(map_file)
    unit, response = words.pop("unit", ""), given.get("response") or ()
    responses = tuple(response_word(word, unit) for word in response) or base_map.responses
    stated = [word for word in response if response_word(word).unit]
    if unit and stated:
        raise InputError(
            f"--unit {unit} is for responses without a stated unit, but --response {stated[0]} "
            "states one: leave one of the two out."
        )
    if unit and not response:
        responses = tuple(response._replace(unit=unit) for response in responses)
    for key in RESPONSE_KEYS:
        each = given.get(key) or ()
        if each and len(each) != len(responses):
            raise InputError(
                f"{_option(key)} must be given once for each of the {len(responses)} responses, "
                f"but is given {len(each)} times."
            )
        if each:
            pairs = zip(responses, each, strict=True)
            responses = tuple(response._replace(**{key: word}) for response, word in pairs)
    names = [response.sensor for response in responses if response.sensor]
    for what, listed in (
        ("--sensor", names),
        ("--response", [response.channel for response in responses]),
    ):
        doubled = [name for name in listed if listed.count(name) > 1]
        if doubled:
            raise InputError(f"{what} names {doubled[0]!r} twice.")
    if unit and not responses:  # our own table has no responses to name
        words["unit"] = unit
    # Another excitation replaces the one of the map file.
    driven = {"force", "base"}.intersection(words)
    dropped = {"force": ("base",), "base": ("force", "force_unit", "force_amplitude")}
    cleared = {key: ImportMap._field_defaults[key] for one in driven for key in dropped[one]}
    return base_map._replace(**{**cleared, **words}, responses=responses)


def _require_base(word: str) -> None:
    """Raise `ValueError` for a base motion without quantity or with an invalid amplitude."""
    stated = response_word(word)
    numbers = ImportMap(base=word).base_amplitudes
    if not stated.quantity or (numbers and not stated.unit):
        raise InputError(
            f"--base must state its quantity, as CH1:acceleration:g or 0.5:acceleration:g, but "
            f"is {shown(word)}."
        )
    if not all(0 < number < float("inf") for number in numbers):
        raise InputError(f"--base must be above zero where it is a number, but is {shown(word)}.")


def _option(key: str) -> str:
    return f"--{key.replace('_', '-')}"


def _stated_amplitudes(words: Sequence[str]) -> tuple[str, ...]:
    if list(words) in (["z"], [BY_NAME]):
        return tuple(words)
    amplitudes = []
    for word in words:
        try:
            number = float(word)
        except ValueError:
            number = 0.0
        if not 0 < number < float("inf"):
            raise InputError(
                "--force-amplitude must be a positive number (in --force-unit, N by default), or z "
                f"or name alone, but is {shown(word)}."
            )
        amplitudes.append(repr(number))
    return tuple(amplitudes)


def read_import_map(path: FilePath) -> ImportMap:
    """A map from its TOML. Raises `ValueError` that names file, key and what was expected."""
    file = file_name(path)
    table = parsed_toml(read_text(path), file)
    table.check_keys((), (*KEYS, "response", "steps"))
    values = {key: _value(table, key) for key in KEYS if key in table.entries}
    if values.get("base"):
        _require_base(values["base"])
    responses = []
    for response in table.tables("response", file):
        response.check_keys(("channel",), ResponseMap._fields[1:])
        if "quantity" in response.entries:
            response.choice("quantity", ("", *_MOTIONS))
        responses.append(ResponseMap(**{key: response.text(key) for key in response.entries}))
    return ImportMap(tuple(responses), **values)


def _value(table: TomlTable, key: str) -> Any:
    """A key's value in the map."""
    value = table.entries[key]
    if key == "over_force":
        if not isinstance(value, bool):
            raise table.refusal(key, "true or false", value)
        return value
    if key == "header_row":
        return table.whole(key, 0)
    if key in ("rate", "frequency_start", "frequency_step"):
        return table.number(key, NOT_NEGATIVE)
    if key == "force_amplitude":
        return (
            (value,)
            if value in ("z", BY_NAME)
            else tuple(map(repr, table.numbers(key, each="entry")))
        )
    choices = KEYS[key].choices
    return table.choice(key, ("", *choices)) if choices else table.text(key)


def steps_of_map(path: FilePath) -> StepCounts | None:
    """Numbers of record steps that an import used and left out; None where there were none."""
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
    notes: Sequence[Fact | str] = (),
    files: Sequence[str] = (),
    steps: StepCounts | None = None,
) -> str:
    """Text of `map.toml`: every key with its meaning, and the reason of each assumption.

    Arguments: `assumed` has the reason of each key not stated; keys of the k-th response
    (from 1) as "response 1.unit"; `files` read, relative to the map's folder;
    `steps` of the records that were used and left out.
    """
    lines = [
        "# How the laboratory's files were read. Use it for the next test: snrmjax import "
        "FILE --map map.toml --out DIR",
        *(["# files: " + shlex.join(files)] if files else []),
        *(f"# note: {' '.join(str(note).split())}" for note in notes),
    ]
    for key, spec in KEYS.items():
        value = getattr(used, key)
        if key == "force_amplitude":
            is_word = value in (("z",), (BY_NAME,))
            value = value[0] if is_word else [float(number) for number in value]
        lines.append(f"{_line(key, value)}  # {_comment(key, value, assumed) or spec.meaning}")
    for k, response in enumerate(used.responses):
        lines += ["", "[[response]]"]
        for key, value in response._asdict().items():
            why = _comment(f"response {k + 1}.{key}", value, assumed)
            lines.append(_line(key, value) + (f"  # {why}" if why else ""))
    if steps is not None:
        lines += ["", tomli_w.dumps({"steps": steps._asdict()}).rstrip()]
    return "\n".join(lines) + "\n"


def _comment(key: str, value: object, assumed: Mapping[str, Assumption]) -> str:
    """Why a value was assumed, and the alternatives; empty for a stated value."""
    if key not in assumed:
        return ""
    assumption = assumed[key]
    why = " ".join(str(assumption.why if assumption.value == value else assumption).split())
    choices = KEYS[key].choices if key in KEYS else ()
    others = ", ".join(word for word in choices if word != value)
    return f"assumed: {why}" + (f" (else {others})" if others else "")


def _line(key: str, value: object) -> str:
    """One key on one line."""
    return " ".join(tomli_w.dumps({key: value}).split("\n")).strip().replace(",  ]", "]")
