"""What a laboratory's file holds, in words, and the command that would import it."""

import shlex
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from snrmjax.io.exchange.layouts import is_own_table
from snrmjax.io.laboratory.contents import LaboratoryFile, NumberTable
from snrmjax.io.laboratory.names import role_of
from snrmjax.measure.recordings.channels import Channel
from snrmjax.measure.recordings.frequency_responses import FrequencyResponses
from snrmjax.measure.recordings.time_recording import TimeRecording
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
    for shapes in held.shapes:
        lines.append(
            f"  mode shapes {shapes.name}: {len(shapes.frequency)} modes at "
            f"{len(shapes.points)} places"
        )
    for nodes in held.nodes:
        lines += [f"  {nodes.name}: {nodes.n_rows} points of the structure", *_columns(nodes)]
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
    frequency = _first(table, ("frequency",))
    force = _first(table, ("force", "drive"))
    if frequency and force and not _first(table, ("level",)):
        size = np.abs(table.columns[force])
        if np.all(size > 0) and np.isfinite(size).all():
            number, rule = number_levels("auto", size, None, np.real(table.columns[frequency]))
            lines.append(f"    found: {counted_levels(number, rule)}")
    lines += [
        f"    {name}: text, {', '.join(list(dict.fromkeys(words))[:4])}"
        for name, words in table.words.items()
    ]
    return _short(lines)


_TO_FILL_IN = ("CHANNEL", "COLUMN", "QUANTITY", "UNIT", "NEWTONS")
# Longer endings first: `_mm_s` ends with `_s` only.
_UNITS_IN_NAMES = {
    **{"mm_s2": "mm/s^2", "m_s2": "m/s^2", "mm_s": "mm/s", "m_s": "m/s", "um": "um"},
    **{"mm": "mm", "mN": "mN", "kN": "kN", "N": "N", "n": "N", "mV": "mV", "V": "V", "v": "V"},
    **{"mg": "mg", "g": "g", "m": "m"},
}


def _first(table: NumberTable, roles: Sequence[str]) -> str:
    """The first column with one of these roles, the earlier role first."""
    for role in roles:
        for name in table.columns:
            if role_of(name) == role:
                return name
    return ""


def suggested_command(paths: Sequence[Path], held: LaboratoryFile) -> list[str]:
    """A command line that imports the file, with what is guessed, and how to change it."""
    files = " ".join(shlex.quote(str(path)) for path in paths)
    several = len(held.recordings) + len(held.tables) + bool(held.responses) > 1
    words: list[str] = []
    if held.tables:
        table = max(held.tables, key=lambda one: (bool(_first(one, ("frequency",))), one.n_rows))
        words = _of_table(table)
        mixed = bool(held.recordings or held.responses) or len(held.tables) > 1
        words = (["--dataset", table.name] if mixed else []) + words
    if held.recordings and not any(_first(one, ("frequency",)) for one in held.tables):
        words = _of_record(held.recordings[0])
        mixed = bool(held.tables or held.responses)
        words = (["--dataset", held.recordings[0].name or "record"] if mixed else []) + words
    if held.responses and not held.recordings:
        words = _of_responses(held.responses[0], held.levels)
        words = (["--dataset", "responses"] if several else []) + words
    if not words and not (held.tables and is_own_table(held.tables[0])):
        return []
    if held.responses and not held.recordings and not held.tables and _is_linear(held):
        return _as_linear_test(files, held, words)
    line = " ".join(word if word.isupper() else shlex.quote(word) for word in words)
    open_words = [one for one in _TO_FILL_IN if one in line.replace(":", " ").split()]
    fill_in = f"fill in {', '.join(open_words)}, and " if open_words else ""
    return [
        f"import it ({fill_in}check the guesses):",
        " ".join(f"  snrmjax import {files} {line} --out imported".split("  ")).strip(),
    ]


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
    line = " ".join(one if one.isupper() else shlex.quote(one) for one in [*words, *sensors])
    return [
        "linear modes of it, as of an impact test (the sensor at the force scales the shapes; "
        f"{why}):",
        f"  snrmjax modes {files} --drive-point {named} --out model.toml",
        "or, if it is one level of a stepped sine, import it under the sensor's name in the model "
        "(fill in NEWTONS):",
        f"  snrmjax import {files} {line} --out imported",
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


def _of_record(record: TimeRecording) -> list[str]:
    force = _guess(record.channels, ("force", "voltage"), ("force", "drive"))
    others = [one for one in record.channels if one.name != (force.name if force else "")]
    response = _guess(others, _MOTIONS, (*_MOTIONS, "amplitude"))
    response = response or (others[0] if len(others) == 1 else None)
    words = ["--force", force.name] if force else ["--force", "CHANNEL"]
    if force is None or force.quantity == "unknown":
        words += ["--force-unit", unit_in_name(force.name if force else "")]
    return words + _response_words(response or Channel("CHANNEL"))


def _of_responses(one: FrequencyResponses, z: Sequence[float]) -> list[str]:
    amplitude = "z" if z and np.isfinite(z[0]) and z[0] > 0 else "NEWTONS"
    response = _guess(one.responses, _MOTIONS, (*_MOTIONS, "amplitude")) or one.responses[0]
    force = next((c.name for c in one.responses if c.quantity == "force"), "")
    if force:  # spectra, or responses over a generator
        return ["--force", force, *_response_words(response)]
    words = ["--force", one.references[0].name] if len(one.references) > 1 else []
    return [*words, "--force-amplitude", amplitude, *_response_words(response)]


def _of_table(table: NumberTable) -> list[str]:
    if is_own_table(table):
        return []
    force = _first(table, ("force", "drive"))
    response = _first(table, (*_MOTIONS, "amplitude", "real"))
    unit = table.units.get(response, unit_in_name(response))
    role = role_of(response)
    kind = role if role in _MOTIONS else "QUANTITY"
    words = ["--force", force or "COLUMN"]
    if force not in table.units:
        words += ["--force-unit", unit_in_name(force)]
    stated = response in table.units and kind == "QUANTITY"
    words += ["--response", (response or "COLUMN") + ("" if stated else f":{kind}")]
    words += [] if response in table.units else ["--unit", unit]
    phase = _first(table, ("phase",))
    if phase and role != "real":
        words += ["--phase", phase]
        if phase not in table.units and not phase.lower().endswith(("deg", "rad")):
            words += ["--phase-unit", "deg"]
    return words


def _response_words(one: Channel) -> list[str]:
    if one.quantity in _MOTIONS:
        return ["--response", f"{one.name}:{one.quantity}"]
    role = role_of(one.name)
    quantity = role if role in _MOTIONS else "QUANTITY"
    return ["--response", f"{one.name}:{quantity}", "--unit", unit_in_name(one.name)]


def unit_in_name(name: str) -> str:
    """The unit with which a name ends, as in acc_g or velocity_mm_s; UNIT where there is none.

    >>> unit_in_name("force_N"), unit_in_name("acc_m_s2"), unit_in_name("CH2")
    ('N', 'm/s^2', 'UNIT')
    """
    for ending, unit in _UNITS_IN_NAMES.items():
        if name.endswith(f"_{ending}"):
            return unit
    return "UNIT"


def _guess(
    channels: Sequence[Channel], quantities: Sequence[str], roles: Sequence[str]
) -> Channel | None:
    """The channel of one of these quantities or, by its name, of one of these roles."""
    for quantity in quantities:
        for one in channels:
            if one.quantity == quantity:
                return one
    for role in roles:
        for one in channels:
            if one.quantity == "unknown" and role_of(one.name) == role:
                return one
    return None
