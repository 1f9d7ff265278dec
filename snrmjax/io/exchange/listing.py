"""What a laboratory's file holds, in words, and the command that would import it."""

import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from snrmjax.io.columns import is_ours
from snrmjax.io.laboratory.contents import LaboratoryFile, NumberTable
from snrmjax.io.laboratory.names import role_of
from snrmjax.measure.recordings.channels import Channel
from snrmjax.measure.recordings.frequency_responses import FrequencyResponses
from snrmjax.measure.recordings.velocity_states import number_levels
from snrmjax.numerics.facts import Fact

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
            *_short([f"    {channel}" for channel in record.channels]),
        ]
    for table in held.tables:
        lines += [f"  table {table.name}: {table.n_rows} rows", *_columns(table)]
    for sets, z in zip(held.responses[:_MOST], held.levels, strict=False):
        hertz = sets.frequency / _HERTZ
        level = f", z axis {z:g}" if np.isfinite(z) else ""
        lines.append(
            f"  responses {sets.name}: {len(sets.responses)} over {len(sets.references)} at "
            f"{len(hertz)} frequencies, {hertz[0]:.6g} to {hertz[-1]:.6g} Hz{level}"
        )
        lines += _short([f"    response {channel}" for channel in sets.responses])
        lines += _short([f"    reference {channel}" for channel in sets.references])
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
            fact = Fact("levels_counted", n=len(np.unique(number)), by=rule)
            lines.append(f"    found: {fact}")
    lines += [
        f"    {name}: text, {', '.join(list(dict.fromkeys(words))[:4])}"
        for name, words in table.words.items()
    ]
    return _short(lines)


def _first(table: NumberTable, role: str) -> str:
    """The first column with a role."""
    return next((name for name in table.columns if role_of(name) == role), "")


class _Candidate(NamedTuple):
    """A channel or column that may be force or response: what the file or its name says it is."""

    name: str
    kind: str
    unit: str  # that the file states


def suggested_command(paths: Sequence[Path], held: LaboratoryFile) -> list[str]:
    """A command line that imports the file, with what names and units say; capitals are open."""
    files = " ".join(shlex.quote(str(path)) for path in paths)
    tables = sorted(held.tables, key=lambda table: (not _first(table, "frequency"), -table.n_rows))
    ratios = False
    if held.responses and not held.recordings:
        dataset, candidates = "responses", _of_channels(held.responses[0].responses)
        ratios = not any(candidate.kind == "force" and candidate.unit for candidate in candidates)
    elif held.recordings and not (tables and _first(tables[0], "frequency")):
        record = held.recordings[0]
        dataset, candidates = record.name or "record", _of_channels(record.channels)
    elif tables:
        dataset, table = tables[0].name, tables[0]
        candidates = [
            _Candidate(name, role_of(name), table.units.get(name, ""))
            for name in table.columns
            if role_of(name) != "frequency"
        ]
    else:
        return []
    several = len(held.tables) + bool(held.recordings) + bool(held.responses) > 1
    words = ["--dataset", dataset] if several else []
    if dataset == "responses" or not tables or not is_ours(tables[0].columns):
        words += _channels_of_import(candidates, held.levels, ratios=ratios)
    quoted = " ".join(word if word.isupper() else shlex.quote(word) for word in words)
    lines = [
        "import it (fill in words in capitals, and check the guesses):",
        f"  snrmjax import {files} {quoted} --out imported".replace("  --out", " --out"),
    ]
    if ratios:
        sensor = _at_the_force(held.responses) or "SENSOR"
        modes = f"  snrmjax modes {files} --drive-point {shlex.quote(sensor)} --out model.toml"
        lines += [
            "or, of an impact or broadband test, linear modes (the sensor at the force):",
            modes,
        ]
    return lines


def _channels_of_import(
    candidates: Sequence[_Candidate], levels: Sequence[float], *, ratios: bool
) -> list[str]:
    """Options for force and response, each the likeliest of the candidates."""
    known = sorted(candidates, key=lambda candidate: not candidate.unit)

    def likeliest(*kinds: str) -> _Candidate:
        matching = (candidate for kind in kinds for candidate in known if candidate.kind == kind)
        return next(matching, _Candidate("CHANNEL", "", ""))

    if ratios:
        known_level = levels and np.isfinite(levels[0]) and levels[0] > 0
        words = ["--force-amplitude", "z" if known_level else "NEWTONS"]
    else:
        force = likeliest("force", "voltage", "drive")
        words = ["--force", force.name, *([] if force.unit else ["--force-unit", "UNIT"])]
    candidate = likeliest(*_MOTIONS, "amplitude", "real")
    if candidate.name == "CHANNEL" and len(candidates) == 1:
        candidate = candidates[0]
    kind = candidate.kind if candidate.kind in _MOTIONS else "" if candidate.unit else "QUANTITY"
    words += ["--response", f"{candidate.name}:{kind}" if kind else candidate.name]
    return words if candidate.unit else [*words, "--unit", "UNIT"]


def _at_the_force(sets: Sequence[FrequencyResponses]) -> str:
    """The response at the place and along the axis of a reference; nothing where nobody said."""
    for responses in sets:
        for reference in responses.references:
            for response in responses.responses:
                same = response.direction.lstrip("+-") == reference.direction.lstrip("+-")
                if reference.point and response.point == reference.point and same:
                    return response.name
    return ""


def _of_channels(channels: Sequence[Channel]) -> list[_Candidate]:
    return [
        _Candidate(channel.name, role_of(channel.name), "")
        if channel.quantity == "unknown"
        else _Candidate(channel.name, channel.quantity, channel.unit or channel.si_unit)
        for channel in channels
    ]
