"""Listing of the contents of a laboratory file."""

from collections.abc import Sequence

import numpy as np

from snrmjax.io.laboratory.contents import LaboratoryFile, NumberTable
from snrmjax.measure.recordings.velocity_states import number_levels
from snrmjax.numerics.facts import Fact
from snrmjax.numerics.units import HERTZ

_MOST = 40  # lines of one kind at most


def listed_contents(contents: LaboratoryFile) -> list[str]:
    """The datasets of a file: channels, sampling rates, lengths, units, points, detected levels."""
    lines = [f"{contents.name}: {contents.kind}"]
    for record in contents.recordings:
        lines += [
            f"  record {record.name or 'record'}: {len(record.channels)} channels of "
            f"{record.n_samples} samples at {record.sampling_rate:.6g} Hz "
            f"({record.duration:.4g} s)",
            *_short([f"    {channel}" for channel in record.channels]),
        ]
    for table in contents.tables:
        lines += [f"  table {table.name}: {table.n_rows} rows", *_columns(table)]
    for sets, z in zip(contents.responses[:_MOST], contents.levels, strict=False):
        hertz = sets.frequency / HERTZ
        level = f", z axis {z:g}" if np.isfinite(z) else ""
        lines.append(
            f"  responses {sets.name}: {len(sets.responses)} over {len(sets.references)} at "
            f"{len(hertz)} frequencies, {hertz[0]:.6g} to {hertz[-1]:.6g} Hz{level}"
        )
        lines += _short([f"    response {channel}" for channel in sets.responses])
        lines += _short([f"    reference {channel}" for channel in sets.references])
    if len(contents.responses) > _MOST:
        lines.append(f"  … {len(contents.responses) - _MOST} further sets of responses")
    return [*lines, *(f"  note: {note}" for note in contents.notes[:_MOST])]


def _short(lines: Sequence[str]) -> list[str]:
    further = len(lines) - _MOST
    return [*lines[:_MOST], *([f"    … {further} further"] if further > 0 else [])]


def _columns(table: NumberTable) -> list[str]:
    lines = []
    for name, values in table.columns.items():
        magnitude = np.abs(values) if np.iscomplexobj(values) else values.astype(float)
        finite = magnitude[np.isfinite(magnitude)]
        span = f"{finite.min():.5g} to {finite.max():.5g}" if finite.size else "empty"
        role = table.role(name)
        count = len(np.unique(finite))
        levels = f", {count} values" if role in ("level", "force", "drive") and count < 50 else ""
        unit = f" in {table.units[name]}" if name in table.units else ""
        kind = ", complex" if np.iscomplexobj(values) else ""
        lines.append(f"    {name}{unit}: {span}{kind}{levels}{f' ({role}?)' if role else ''}")
    frequency = _first(table, "frequency")
    force = _first(table, "force") or _first(table, "drive")
    if frequency and force and not _first(table, "level"):
        magnitude = np.abs(table.columns[force])
        if np.all(magnitude > 0) and np.isfinite(magnitude).all():
            number, rule = number_levels("auto", magnitude, None, np.real(table.columns[frequency]))
            fact = Fact("levels_counted", n=len(np.unique(number)), by=rule)
            lines.append(f"    found: {fact}")
    lines += [
        f"    {name}: text, {', '.join(list(dict.fromkeys(words))[:4])}"
        for name, words in table.words.items()
    ]
    return _short(lines)


def _first(table: NumberTable, role: str) -> str:
    """The first column with a role."""
    return next((name for name in table.columns if table.role(name) == role), "")
