"""What a laboratory's file holds, in words, and the command that would import it."""

import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from snrmjax.io.exchange.own_tables import is_own_table
from snrmjax.io.laboratory.contents import LaboratoryFile, NumberTable
from snrmjax.io.laboratory.names import role_of
from snrmjax.measure.recordings.channels import Channel
from snrmjax.measure.recordings.frequency_responses import FrequencyResponses
from snrmjax.measure.recordings.velocity_states import counted_levels, number_levels

_HERTZ = 2 * np.pi
_MOST = 40  # lines of one kind
_MOTIONS = ("velocity", "acceleration", "displacement")


def listed_contents(held: LaboratoryFile) -> list[str]:
    """The datasets of a file: channels, rates, lengths, units, places, levels found."""
    lines = [f"{held.name}: {held.kind}"]
    for record in held.recordings:
        lines += [
            f"  record {record.name or 'record'}: {len(record.channels)} channels of "
            f"{record.n_samples} samples at {record.sampling_rate:.6g} Hz "
            f"({record.duration:.4g} s)",
            *_short([f"    {one}" for one in record.channels]),
        ]
    for table in held.tables:
        lines += [f"  table {table.name}: {table.n_rows} rows", *_columns(table)]
    for one, z in zip(held.responses[:_MOST], held.levels, strict=False):
        hertz = one.frequency / _HERTZ
        level = f", z axis {z:g}" if np.isfinite(z) else ""
        lines.append(
            f"  responses {one.name}: {len(one.responses)} over {len(one.references)} at "
            f"{len(hertz)} frequencies, {hertz[0]:.6g} to {hertz[-1]:.6g} Hz{level}"
        )
        lines += _short([f"    response {channel}" for channel in one.responses])
        lines += _short([f"    reference {channel}" for channel in one.references])
    if len(held.responses) > _MOST:
        lines.append(f"  … {len(held.responses) - _MOST} further sets of responses")
    return [*lines, *(f"  note: {note}" for note in held.notes[:_MOST])]


def _short(lines: Sequence[str]) -> list[str]:
    further = len(lines) - _MOST
    return [*lines[:_MOST], *([f"    … {further} further"] if further > 0 else [])]


def _columns(table: NumberTable) -> list[str]:
    lines = []
    for name, values in table.columns.items():
        size = np.abs(values) if np.iscomplexobj(values) else values.astype(float)
        finite = size[np.isfinite(size)]
        span = f"{finite.min():.5g} to {finite.max():.5g}" if finite.size else "empty"
        role = role_of(name)
        count = len(np.unique(finite))
        levels = f", {count} values" if role in ("level", "force", "drive") and count < 50 else ""
        unit = f" in {table.units[name]}" if name in table.units else ""
        kind = ", complex" if np.iscomplexobj(values) else ""
        lines.append(f"    {name}{unit}: {span}{kind}{levels}{f' ({role}?)' if role else ''}")
    frequency = _first(table, "frequency")
    force = _first(table, "force") or _first(table, "drive")
    if frequency and force and not _first(table, "level"):
        size = np.abs(table.columns[force])
        if np.all(size > 0) and np.isfinite(size).all():
            number, rule = number_levels("auto", size, None, np.real(table.columns[frequency]))
            lines.append(f"    found: {counted_levels(number, rule)}")
    lines += [
        f"    {name}: text, {', '.join(list(dict.fromkeys(words))[:4])}"
        for name, words in table.words.items()
    ]
    return _short(lines)


_TO_FILL_IN = ("CHANNEL", "QUANTITY", "UNIT", "NEWTONS")


class _Candidate(NamedTuple):
    """A channel or column that may be force or response: what the file or its name says it is."""

    name: str
    kind: str
    unit: str  # that the file states


def _first(table: NumberTable, role: str) -> str:
    """The first column with a role."""
    return next((name for name in table.columns if role_of(name) == role), "")


def suggested_command(paths: Sequence[Path], held: LaboratoryFile) -> list[str]:
    """A command line that imports the file, with what is guessed, and how to change it."""
    files = " ".join(shlex.quote(str(path)) for path in paths)
    tables = sorted(held.tables, key=lambda one: (not _first(one, "frequency"), -one.n_rows))
    several = len(held.tables) + bool(held.recordings) + bool(held.responses) > 1
    words: list[str] = []
    if held.responses and not held.recordings:
        dataset, words = "responses", _of_responses(held)
        if not held.tables and _is_linear(held):
            return _as_linear_test(files, held, words)
    elif held.recordings and not (tables and _first(tables[0], "frequency")):
        record = held.recordings[0]
        dataset, words = record.name or "record", _guessed(_of_channels(record.channels))
    elif tables:
        table = tables[0]
        dataset = table.name
        if not is_own_table(table):
            columns = [
                _Candidate(name, role_of(name), table.units.get(name, ""))
                for name in table.columns
                if role_of(name) != "frequency"
            ]
            words = _guessed(columns)
    else:
        return []
    words = ["--dataset", dataset, *words] if several else words
    line = _line(words)
    open_words = [one for one in _TO_FILL_IN if one in line.replace(":", " ").split()]
    fill_in = f"fill in {', '.join(open_words)}, and " if open_words else ""
    return [
        f"import it ({fill_in}check the guesses):",
        f"  snrmjax import {files}{line} --out imported",
    ]


def _line(words: Sequence[str]) -> str:
    """Words of a command, quoted but for those to fill in."""
    return "".join(f" {word if word.isupper() else shlex.quote(word)}" for word in words)


def _is_linear(held: LaboratoryFile) -> bool:
    """Whether responses look like those of an impact or a broadband test: of one level, or none."""
    levels = {z for z in held.levels if np.isfinite(z) and z > 0}
    spectra = any(one.quantity == "force" for each in held.responses for one in each.responses)
    return len(levels) < 2 and not spectra


def _as_linear_test(files: str, held: LaboratoryFile, words: list[str]) -> list[str]:
    """Commands for frequency responses: linear modes of them, or one level of a stepped sine."""
    driven = _at_the_force(held.responses)
    names = list(dict.fromkeys(c.name for one in held.responses for c in one.responses))
    named = shlex.quote(driven or (names[0] if len(names) == 1 else "SENSOR"))
    why = "it has the force's place and axis" if driven else f"which is it, of {', '.join(names)}?"
    sensors = [] if len(names) != 1 else ["--sensor", names[0]]
    return [
        "linear modes of it, as of an impact test (the sensor at the force scales the shapes; "
        f"{why}):",
        f"  snrmjax modes {files} --drive-point {named} --out model.toml",
        "or, if it is one level of a stepped sine, import it under the sensor's name in the model "
        "(fill in NEWTONS):",
        f"  snrmjax import {files}{_line([*words, *sensors])} --out imported",
    ]


def _at_the_force(sets: Sequence[FrequencyResponses]) -> str:
    """The response at the place and along the axis of a reference; nothing where nobody said."""
    for one in sets:
        for reference in one.references:
            for response in one.responses:
                same = response.direction.lstrip("+-") == reference.direction.lstrip("+-")
                if reference.point and response.point == reference.point and same:
                    return response.name
    return ""


def _of_channels(channels: Sequence[Channel]) -> list[_Candidate]:
    return [
        _Candidate(one.name, role_of(one.name), "")
        if one.quantity == "unknown"
        else _Candidate(one.name, one.quantity, one.unit or one.si_unit)
        for one in channels
    ]


def _of_responses(held: LaboratoryFile) -> list[str]:
    """Options of frequency responses: spectra with a force among them, or responses over it."""
    one, z = held.responses[0], held.levels
    candidates = _of_channels(one.responses)
    if any(each.kind == "force" and each.unit for each in candidates):
        return _guessed(candidates)
    words = ["--force", one.references[0].name] if len(one.references) > 1 else []
    amplitude = "z" if z and np.isfinite(z[0]) and z[0] > 0 else "NEWTONS"
    return [*words, "--force-amplitude", amplitude, *_response_words(candidates)]


def _guessed(candidates: Sequence[_Candidate]) -> list[str]:
    """Options for force and response, each the likeliest of the candidates."""
    force = _likeliest(candidates, ("force", "voltage", "drive"))
    words = ["--force", force.name if force else "CHANNEL"]
    if force is None or not force.unit:
        words += ["--force-unit", "UNIT"]
    return words + _response_words([one for one in candidates if one is not force])


def _response_words(candidates: Sequence[_Candidate]) -> list[str]:
    one = _likeliest(candidates, (*_MOTIONS, "amplitude", "real"))
    one = one or (candidates[0] if len(candidates) == 1 else _Candidate("CHANNEL", "", ""))
    if one.kind in _MOTIONS or not one.unit:
        words = ["--response", f"{one.name}:{one.kind if one.kind in _MOTIONS else 'QUANTITY'}"]
    else:
        words = ["--response", one.name]
    return words if one.unit else [*words, "--unit", "UNIT"]


def _likeliest(candidates: Sequence[_Candidate], kinds: Sequence[str]) -> _Candidate | None:
    """The first candidate of the earliest of these kinds, those that the file states first."""
    known = sorted(candidates, key=lambda one: not one.unit)
    return next((one for kind in kinds for one in known if one.kind == kind), None)
