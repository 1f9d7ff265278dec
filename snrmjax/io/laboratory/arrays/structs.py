"""What a struct of named arrays is: time records, frequency responses, tables of states."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from snrmjax.io.laboratory.arrays.records import FewRecordings, recording_of
from snrmjax.io.laboratory.arrays.value_tree import Node, Numbers, held
from snrmjax.io.laboratory.contents import NumberTable, number_table
from snrmjax.io.laboratory.names import role_of
from snrmjax.measure.recordings.channels import Channel
from snrmjax.measure.recordings.frequency_responses import FrequencyResponses, frequency_responses
from snrmjax.measure.recordings.time_recording import TimeRecording

_HERTZ = 2 * np.pi
_MOST_ENTRIES = 10_000
_WIDEST = 64  # columns of a matrix that become columns of a table


class Columns(NamedTuple):
    """A table to be: columns of one length with their units."""

    values: dict[str, np.ndarray]
    units: dict[str, str]
    words: dict[str, tuple[str, ...]]


class Struct(NamedTuple):
    """What a struct holds; tables by their place below it."""

    recordings: list[TimeRecording]
    responses: list[FrequencyResponses]
    tables: dict[str, Columns]
    notes: list[str]

    def numbered(self) -> tuple[NumberTable, ...]:
        """The tables, checked."""
        return tuple(
            number_table(name or "table", columns.values, columns.units, (), columns.words)
            for name, columns in self.tables.items()
        )


def read_struct(name: str, fields: Mapping[str, Node], *, entry: bool = False) -> Struct:
    """Everything in a struct and below it.

    Arguments: `name` as results are called; `entry` says that the struct is one of a list, whose
    single numbers hold for each of its rows.
    """
    found = Struct([], [], {}, [])
    numbers = {key: node for key, node in fields.items() if isinstance(node, Numbers)}
    words = {
        key: [node] if isinstance(node, str) else [one for one in node if isinstance(one, str)]
        for key, node in fields.items()
        if isinstance(node, str)
        or (isinstance(node, list) and node and all(isinstance(one, str) for one in node))
    }
    _read_numbers(name, numbers, words, found, entry=entry)
    cells: dict[int, dict[str, list[Node]]] = {}
    for key, node in fields.items():
        path = f"{name}.{key}" if name else key
        if isinstance(node, dict):
            _add(found, key, read_struct(path, node, entry=entry))
        elif isinstance(node, list) and node:
            if all(isinstance(one, dict) for one in node):
                structs = [one for one in node if isinstance(one, dict)]
                _add(found, key, _entries(path, structs))
            elif all(isinstance(one, list) for one in node):
                rows = [one for one in node if isinstance(one, list)]
                named = [{str(k + 1): cell for k, cell in enumerate(row)} for row in rows]
                _add(found, key, _entries(path, named))
            elif any(isinstance(one, Numbers | dict) for one in node):
                cells.setdefault(len(node), {})[key] = node
    for count, group in cells.items():
        structs = [{key: nodes[k] for key, nodes in group.items()} for k in range(count)]
        key = next(iter(group)) if len(group) == 1 else "entries"
        path = f"{name}.{key}" if name else key
        _add(found, key, _entries(path, structs))
    return found


def _add(found: Struct, key: str, below: Struct) -> None:
    """Take in what a field holds."""
    found.recordings.extend(below.recordings)
    found.responses.extend(below.responses)
    found.notes.extend(below.notes)
    for place, columns in below.tables.items():
        found.tables[f"{key}.{place}" if place else key] = columns


def _entries(name: str, structs: Sequence[Mapping[str, Node]]) -> Struct:
    """A list with one struct a level: its tables under one another, with the entry's number."""
    if len(structs) > _MOST_ENTRIES:
        raise ValueError(f"{name} is a list of {len(structs)} entries, more than {_MOST_ENTRIES}.")
    found = Struct([], [], {}, [])
    several = len(structs) > 1
    parts: dict[str, list[tuple[int, Columns]]] = {}
    for k, fields in enumerate(structs):
        below = read_struct(f"{name}({k + 1})" if several else name, fields, entry=several)
        found.recordings.extend(below.recordings)
        found.responses.extend(below.responses)
        found.notes.extend(note for note in below.notes if note not in found.notes)
        for place, columns in below.tables.items():
            parts.setdefault(place, []).append((k + 1, columns))
    for place, rows in parts.items():
        found.tables[place] = _joined(rows) if several else rows[0][1]
    return found


def _joined(parts: Sequence[tuple[int, Columns]]) -> Columns:
    """Tables of several entries under one another; NaN where an entry lacks a column."""
    names = list(dict.fromkeys(key for _, one in parts for key in one.values))
    entry_key = "entry" if "entry" not in names else "entry number"
    lengths = [len(next(iter(one.values.values()))) for _, one in parts]
    values = {
        entry_key: np.concatenate(
            [np.full(n, k) for n, (k, _) in zip(lengths, parts, strict=True)]
        ).astype(float)
    }
    units: dict[str, str] = {}
    for key in names:
        values[key] = np.concatenate(
            [
                one.values.get(key, np.full(n, np.nan))
                for n, (_, one) in zip(lengths, parts, strict=True)
            ]
        )
        stated = [one.units[key] for _, one in parts if key in one.units]
        units |= {key: stated[0]} if stated else {}
    texts = {
        key: tuple(
            word
            for n, (_, one) in zip(lengths, parts, strict=True)
            for word in one.words.get(key, ("",) * n)
        )
        for key in dict.fromkeys(key for _, one in parts for key in one.words)
    }
    return Columns(values, units, {k: one for k, one in texts.items() if k not in values})


def _read_numbers(
    name: str,
    numbers: Mapping[str, Numbers],
    words: Mapping[str, Sequence[str]],
    found: Struct,
    *,
    entry: bool,
) -> None:
    """The arrays of one struct: first time records, then responses, then tables."""
    records: FewRecordings = recording_of(name, numbers, words)
    found.recordings.extend(records.recordings)
    found.notes.extend(records.notes)
    rest = {key: one for key, one in numbers.items() if key not in records.used}
    rest = _responses(name, rest, found)
    levels = _by_level(rest)
    if levels is not None:
        _add(found, "", _entries(name, levels))
        return
    single = {key: one for key, one in rest.items() if one.size == 1}
    groups: dict[int, dict[str, Numbers]] = {}
    for key, one in rest.items():
        if one.size > 1 and one.length is not None:
            groups.setdefault(one.length, {})[key] = one
    for key, one in rest.items():
        if one.length is None and one.size:
            _spread(key, one, groups, words, found.notes)
    if not groups and single and (entry or any(role_of(key) == "frequency" for key in single)):
        groups[1] = {}
    for n, group in groups.items():
        columns = {key: one.vector(key) for key, one in group.items()}
        units = {key: one.unit for key, one in group.items() if one.unit}
        if entry or n == 1:
            for key, one in single.items():
                columns.setdefault(key, np.repeat(one.vector(key), n))
                units |= {key: one.unit} if one.unit else {}
        place = "" if len(groups) == 1 else f"rows{n}"
        texts = {
            key: tuple(word) if len(word) == n else tuple(word) * n
            for key, word in words.items()
            if (len(word) == n or (entry and len(word) == 1)) and key not in columns
        }
        found.tables[place] = Columns(columns, units, texts)


def _spread(
    key: str,
    one: Numbers,
    groups: dict[int, dict[str, Numbers]],
    words: Mapping[str, Sequence[str]],
    notes: list[str],
) -> None:
    """A matrix as columns: beside vectors of one of its sides, else along its longer side."""
    sides = [n for n in one.shape if n != 1]
    if len(sides) != 2:
        notes.append(f"{key} has {len(sides)} dimensions and is not read as a table.")
        return
    axis = 0 if sides[0] in groups or (sides[1] not in groups and sides[0] >= sides[1]) else 1
    n, width = sides[axis], sides[1 - axis]
    if width > _WIDEST:
        notes.append(f"{key} is a matrix of {sides[0]} by {sides[1]} and is not read as a table.")
        return
    values = one.all(key).reshape(sides)
    values = values if axis == 0 else values.T
    labels = next((word for word in words.values() if len(word) == width), None)
    for k in range(width):
        label = f"{key}.{labels[k]}" if labels else f"{key}_{k + 1}"
        groups.setdefault(n, {})[label] = held(values[:, k], one.attributes)


def _by_level(numbers: Mapping[str, Numbers]) -> list[Mapping[str, Node]] | None:
    """Matrices of states by levels as one struct a level, or None where they are none.

    They are where two matrices have one shape, and the frequency or a force is one of them or
    stands once a column.
    """
    shapes = [one.shape for one in numbers.values() if len(one.shape) == 2 and min(one.shape) > 1]
    shape = next((one for one in shapes if shapes.count(one) > 1), None)
    if shape is None or max(shape) > _MOST_ENTRIES:
        return None
    matrices = {key: one for key, one in numbers.items() if one.shape == shape}
    names = {key: role_of(key) for key in numbers}
    frequency = [key for key in numbers if names[key] == "frequency"]
    if not frequency:
        return None
    base = numbers[frequency[0]]
    axis = 0 if base.shape == shape or base.length == shape[0] else 1
    if base.shape != shape and base.length != shape[axis]:
        return None
    count = shape[1 - axis]
    driven = [key for key in numbers if names[key] in ("force", "drive", "level")]
    a_column = [key for key in driven if numbers[key].length == count != shape[axis]]
    if base.shape != shape and not a_column and not any(key in matrices for key in driven):
        return None
    arrays = {key: one.all(key) for key, one in numbers.items() if one.size <= 2**22}
    structs: list[Mapping[str, Node]] = []
    for k in range(count):
        fields: dict[str, Node] = {}
        for key, values in arrays.items():
            words = numbers[key].attributes
            if key in matrices:
                fields[key] = held(np.take(values, k, axis=1 - axis), words)
            elif numbers[key].length == count != shape[axis]:
                fields[key] = held(values.reshape(-1)[k : k + 1], words)
            elif numbers[key].length in (shape[axis], 1):
                fields[key] = held(values.reshape(-1), words)
        structs.append(fields)
    return structs


def _responses(name: str, numbers: Mapping[str, Numbers], found: Struct) -> dict[str, Numbers]:
    """Complex matrices along a frequency axis as frequency responses; returns what is left."""
    left = dict(numbers)
    axes = [key for key, one in numbers.items() if role_of(key) == "frequency" and one.length]
    for key, one in numbers.items():
        sides = [n for n in one.shape if n != 1]
        if not one.is_complex or len(sides) not in (2, 3):
            continue
        axis = next((other for other in axes if (numbers[other].length or 0) in sides), None)
        if axis is None:
            continue
        unit = numbers[axis].unit.lower()
        hertz = numbers[axis].vector(axis).astype(float)
        rising = np.isfinite(hertz).all() and hertz[0] >= 0 and np.all(np.diff(hertz) > 0)
        if not rising:
            continue
        values = np.moveaxis(one.all(key).reshape(sides), sides.index(hertz.size), -1)
        values = values.reshape(values.shape[0], -1, hertz.size)
        if not np.isfinite(values).any() or np.isinf(values).any():
            continue
        found.responses.append(
            frequency_responses(
                hertz * (1.0 if unit.startswith("rad") else _HERTZ),
                values,
                [Channel(f"{key}.{k + 1}") for k in range(values.shape[0])],
                [Channel(f"reference {k + 1}") for k in range(values.shape[1])],
                name=f"{name}.{key}" if name else key,
                notes=["responses along the first side that is not the frequency's."],
            )
        )
        left.pop(key)
    return left
