"""Interpretation of structs of named arrays: time records, frequency responses, tables."""

import re
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from snrmjax.io.laboratory.arrays.even_axis import (
    EvenAxis,
    axis_keys,
    frequency_dimension,
    in_hertz,
    is_mark,
    stated_axis,
)
from snrmjax.io.laboratory.arrays.records import recording_of
from snrmjax.io.laboratory.arrays.value_tree import Node, Numbers, in_memory
from snrmjax.io.laboratory.contents import LaboratoryFile, NumberTable
from snrmjax.io.laboratory.names import label_of, role_of
from snrmjax.io.laboratory.physical_units import channel_meaning, is_per_force
from snrmjax.io.laboratory.shared_clock import joined_structs
from snrmjax.measure.recordings.channels import Channel
from snrmjax.measure.recordings.frequency_responses import FrequencyResponses, frequency_responses
from snrmjax.measure.recordings.time_recording import TimeRecording
from snrmjax.numerics.facts import Fact
from snrmjax.numerics.rules import InputError
from snrmjax.numerics.units import HERTZ

_MOST_ENTRIES = 10_000
_MOST_NAMED = 6
_NUMBER = re.compile(r"[0-9]+([.,p_][0-9]+)*")
_WIDEST = 64  # most columns of a matrix that become table columns
_OF_ALL_ROWS = ("force", "drive")  # single numbers that hold for all rows of a table


class Struct(NamedTuple):
    """Contents of a struct; tables by their path below it."""

    recordings: list[TimeRecording]
    responses: list[FrequencyResponses]
    tables: dict[str, NumberTable]  # without names
    notes: list[Fact]

    def numbered(self) -> tuple[NumberTable, ...]:
        """The tables by name."""
        return tuple(table._replace(name=name or "table") for name, table in self.tables.items())

    def add(self, key: str, nested: "Struct") -> None:
        """Add the contents of a field."""
        self.recordings.extend(nested.recordings)
        self.responses.extend(nested.responses)
        self.notes.extend(note for note in nested.notes if note not in self.notes)
        for path, table in nested.tables.items():
            self.tables[f"{key}.{path}" if path else key] = table


def file_of_tree(
    name: str,
    tree: Mapping[str, Node],
    notes: Sequence[Fact],
    axis: EvenAxis | None = None,
) -> LaboratoryFile:
    """The contents of a tree.

    Arguments: `notes` on parts of the file outside the tree; `axis` is that of responses without a
    frequency vector.
    """
    contents = read_struct("", tree, axis=axis)
    known = [*notes, *contents.notes]
    if not (known or contents.recordings or contents.responses or contents.tables):
        known = [Fact("nothing_measured", names=tuple(tree)[:_MOST_NAMED])]
    contents = contents._replace(tables=_joined_siblings(contents.tables))
    records = joined_structs(contents.recordings)
    return LaboratoryFile(
        name,
        tuple(records),
        tuple(contents.responses),
        contents.numbered(),
        tuple(dict.fromkeys(known)),
        tuple(np.nan for _ in contents.responses),
    )


def read_struct(
    name: str,
    fields: Mapping[str, Node],
    *,
    entry: bool = False,
    axis: EvenAxis | None = None,
) -> Struct:
    """The contents of a struct and of those below it.

    Arguments: `name` of the results; `entry` for a struct of a list, whose scalars apply to each of
    its rows; `axis` is that of responses without a frequency vector, unless the struct states one.
    """
    contents = Struct([], [], {}, [])
    numbers = {key: node for key, node in fields.items() if isinstance(node, Numbers)}
    axis = axis or stated_axis(numbers)
    words: dict[str, list[str]] = {}
    for key, node in fields.items():
        several = node if isinstance(node, list) else [node]
        texts = [text for text in several if isinstance(text, str)]
        if 0 < len(texts) == len(several):
            words[key] = texts
    _read_numbers(name, numbers, words, contents, entry=entry, axis=axis)
    cells: dict[int, dict[str, list[Node]]] = {}
    for key, node in fields.items():
        path = f"{name}.{key}" if name else key
        if isinstance(node, dict):
            contents.add(key, read_struct(path, node, entry=entry, axis=axis))
        elif isinstance(node, list) and node and key not in words:
            structs = [item for item in node if isinstance(item, dict)]
            rows = [item for item in node if isinstance(item, list)]
            if len(structs) == len(node):
                contents.add(key, _entries(path, structs, axis))
            elif len(rows) == len(node):
                named = [{str(k + 1): cell for k, cell in enumerate(row)} for row in rows]
                contents.add(key, _entries(path, named, axis))
            elif any(isinstance(item, Numbers | dict) for item in node):
                cells.setdefault(len(node), {})[key] = node
    for count, group in cells.items():
        each = [{key: nodes[k] for key, nodes in group.items()} for k in range(count)]
        key = next(iter(group)) if len(group) == 1 else "entries"
        contents.add(key, _entries(f"{name}.{key}" if name else key, each, axis))
    return contents


def _joined_siblings(tables: Mapping[str, NumberTable]) -> dict[str, NumberTable]:
    """Stack tables of structs whose names differ only by a number, one a level."""
    alike: dict[tuple[str, tuple[str, ...]], list[str]] = {}
    for path, table in tables.items():
        plain = _NUMBER.sub("", path).strip("_ ")
        alike.setdefault((plain, tuple(table.columns)), []).append(path)
    joined: dict[str, NumberTable] = {}
    for (plain, columns), paths in alike.items():
        if len(paths) == 1 or not any(role_of(name) == "frequency" for name in columns):
            joined |= {path: tables[path] for path in paths}
            continue
        one = _joined([(k, tables[path]) for k, path in enumerate(paths, 1)])
        named = tuple(path for path in paths for _ in range(tables[path].n_rows))
        joined[plain] = one._replace(words={**one.words, "entry name": named})
    return joined


def _entries(
    name: str, structs: Sequence[Mapping[str, Node]], axis: EvenAxis | None = None
) -> Struct:
    """A list with one struct a level: tables stacked, with the entry's number."""
    if len(structs) > _MOST_ENTRIES:
        raise InputError(f"{name} is a list of {len(structs)} entries, more than {_MOST_ENTRIES}.")
    several = len(structs) > 1
    contents = Struct([], [], {}, [])
    parts: dict[str, list[tuple[int, NumberTable]]] = {}
    for k, fields in enumerate(structs, 1):
        path = f"{name}({k})" if several else name
        nested = read_struct(path, fields, entry=several, axis=axis)
        contents.add("", nested._replace(tables={}))
        for path, table in nested.tables.items():
            parts.setdefault(path, []).append((k, table))
    for path, numbered in parts.items():
        contents.tables[path] = _joined(numbered) if several else numbered[0][1]
    return contents


def _joined(parts: Sequence[tuple[int, NumberTable]]) -> NumberTable:
    """Stacked tables of several entries; NaN where an entry lacks a column."""
    tables = [table for _, table in parts]
    names = list(dict.fromkeys(key for table in tables for key in table.columns))
    entry = np.repeat([float(k) for k, _ in parts], [table.n_rows for table in tables])
    columns = {"entry" if "entry" not in names else "entry number": entry}
    units: dict[str, str] = {}
    for key in names:
        columns[key] = np.concatenate(
            [table.columns.get(key, np.full(table.n_rows, np.nan)) for table in tables]
        )
        stated = [table.units[key] for table in tables if key in table.units]
        units |= {key: stated[0]} if stated else {}
    words = {
        key: tuple(word for table in tables for word in table.words.get(key, ("",) * table.n_rows))
        for key in dict.fromkeys(key for table in tables for key in table.words)
        if key not in columns
    }
    return NumberTable("", columns, units, words)


def _read_numbers(
    name: str,
    numbers: Mapping[str, Numbers],
    words: Mapping[str, Sequence[str]],
    contents: Struct,
    *,
    entry: bool,
    axis: EvenAxis | None,
) -> None:
    """The arrays of one struct: first time records, then responses, then tables."""
    record, used, notes = recording_of(name, numbers, words)
    contents.recordings.extend([] if record is None else [record])
    contents.notes.extend(notes)
    rest = {key: array for key, array in numbers.items() if key not in used}
    levels = _by_level(rest)
    if levels is not None:
        contents.add("", _entries(name, levels))
        return
    rest = _responses(name, rest, contents, axis)
    single = {key: array for key, array in rest.items() if array.size == 1}
    groups: dict[int, dict[str, Numbers]] = {}
    for key, array in rest.items():
        if array.size > 1 and array.length is not None:
            groups.setdefault(array.length, {})[key] = array
    for key, array in rest.items():
        if array.length is None and array.size:
            _matrix_columns(key, array, groups, words, contents.notes)
    if not groups and single and (entry or any(role_of(key) == "frequency" for key in single)):
        groups[1] = {}
    for n, group in groups.items():
        is_table = any(role_of(key) == "frequency" for key in group)
        repeated = {
            key: array
            for key, array in single.items()
            if entry or n == 1 or (is_table and role_of(key) in _OF_ALL_ROWS)
        }
        columns = {key: np.repeat(array.vector(key), n) for key, array in repeated.items()}
        columns |= {key: array.vector(key) for key, array in group.items()}
        units = _listed_units(group, words)
        units |= {key: array.unit for key, array in (repeated | group).items() if array.unit}
        texts = {
            key: tuple(word) if len(word) == n else tuple(word) * n
            for key, word in words.items()
            if (len(word) == n or (entry and len(word) == 1)) and key not in columns
        }
        in_order = {key: columns[key] for key in (*group, *repeated)}
        path = "" if len(groups) == 1 else f"rows{n}"
        contents.tables[path] = NumberTable("", in_order, units, texts)


def _listed_units(
    group: Mapping[str, Numbers], words: Mapping[str, Sequence[str]]
) -> dict[str, str]:
    """Units from a list with one entry per column, in order."""
    for key, listed in words.items():
        if key.lower() in ("unit", "units") and len(listed) == len(group):
            return {name: unit for name, unit in zip(group, listed, strict=True) if unit}
    return {}


def _matrix_columns(
    key: str,
    array: Numbers,
    groups: dict[int, dict[str, Numbers]],
    words: Mapping[str, Sequence[str]],
    notes: list[Fact],
) -> None:
    """A matrix as columns, along a dimension shared with vectors, else along the longer one."""
    dimensions = array.dimensions
    axis = (
        0
        if dimensions[0] in groups
        or (dimensions[1] not in groups and dimensions[0] >= dimensions[1])
        else 1
    )
    if len(dimensions) != 2 or dimensions[1 - axis] > _WIDEST:
        notes.append(Fact("not_a_table", name=key, sides=tuple(dimensions)))
        return
    n, width = dimensions[axis], dimensions[1 - axis]
    values = array.all(key).reshape(dimensions)
    values = values if axis == 0 else values.T
    labels = next((word for word in words.values() if len(word) == width), None)
    for k in range(width):
        label = f"{key}.{labels[k]}" if labels else f"{key}_{k + 1}"
        groups.setdefault(n, {})[label] = in_memory(values[:, k], array.attributes)


def _by_level(numbers: Mapping[str, Numbers]) -> list[Mapping[str, Node]] | None:
    """Matrices of states by levels as one struct a level; None for other arrays.

    Condition: two matrices have one shape, and the frequency or a force is one of them or has one
    value per column; or a matrix has one row per frequency and one column per force.
    """
    shapes: list[tuple[int, ...]] = [
        array.shape for array in numbers.values() if len(array.shape) == 2 and min(array.shape) > 1
    ]
    names = {key: role_of(key) for key in numbers}
    by_role = {
        role: {array.length for key, array in numbers.items() if names[key] in roles}
        for role, roles in (("frequency", ("frequency",)), ("load", ("force", "drive")))
    }

    def has_levels(shape: tuple[int, ...]) -> bool:
        sides = shape, shape[::-1]
        alone = any(a in by_role["frequency"] and b in by_role["load"] for a, b in sides)
        return shapes.count(shape) > 1 or (alone and shape[0] != shape[1])

    shape = next(filter(has_levels, shapes), None)
    frequency = [key for key in numbers if names[key] == "frequency"]
    if shape is None or max(shape) > _MOST_ENTRIES or not frequency:
        return None
    matrices = {key: array for key, array in numbers.items() if array.shape == shape}
    base = numbers[frequency[0]]
    axis = 0 if base.shape == shape or base.length == shape[0] else 1
    if base.shape != shape and base.length != shape[axis]:
        return None
    count = shape[1 - axis]
    a_column = {key for key, array in numbers.items() if array.length == count != shape[axis]}
    driven = {key for key in numbers if names[key] in ("force", "drive", "level")}
    if base.shape != shape and driven.isdisjoint(a_column) and driven.isdisjoint(matrices):
        return None
    arrays = {key: array.all(key) for key, array in numbers.items() if array.size <= 2**22}
    structs: list[Mapping[str, Node]] = []
    for k in range(count):
        fields: dict[str, Node] = {}
        for key, values in arrays.items():
            words = numbers[key].attributes
            if key in matrices:
                fields[key] = in_memory(np.take(values, k, axis=1 - axis), words)
            elif key in a_column:
                fields[key] = in_memory(values.reshape(-1)[k : k + 1], words)
            elif numbers[key].length in (shape[axis], 1):
                fields[key] = in_memory(values.reshape(-1), words)
        structs.append(fields)
    return structs


def _responses(
    name: str, numbers: Mapping[str, Numbers], contents: Struct, even: EvenAxis | None
) -> dict[str, Numbers]:
    """Complex matrices along a frequency axis as frequency responses; returns the other arrays.

    Without a frequency vector, `even` is the axis, also for a complex vector.
    """
    remaining = dict(numbers)
    axes = [
        key
        for key, array in numbers.items()
        if role_of(key) == "frequency" and array.length and array.length > 1
    ]
    line_counts: set[int] = set()
    single = axis_keys(numbers)
    for key, array in numbers.items():
        dimensions = array.dimensions
        if not array.is_complex or len(dimensions) not in (1, 2, 3):
            continue
        axis = next((other for other in axes if numbers[other].length in dimensions), None)
        lines = frequency_dimension(dimensions) if axis is None else None
        if axis is not None and len(dimensions) > 1:
            unit = numbers[axis].unit or label_of(axis).unit
            hertz = numbers[axis].vector(axis).astype(float) * in_hertz(unit)
        elif lines is not None and even is not None:
            hertz = even.hertz(lines)
        else:
            if lines is not None and (len(dimensions) > 1 or not axes):
                contents.notes.append(Fact("responses_without_axis", name=key, n=lines))
            continue
        if not (np.isfinite(hertz).all() and hertz[0] >= 0 and np.all(np.diff(hertz) > 0)):
            continue
        values = np.moveaxis(array.all(key).reshape(dimensions), dimensions.index(hertz.size), -1)
        values = values.reshape(values.shape[0] if values.ndim > 1 else 1, -1, hertz.size)
        if not np.isfinite(values).any() or np.isinf(values).any():
            continue
        quantity, calibration = channel_meaning(array.unit)
        numerator = Channel("", quantity, array.unit, calibration)
        denominator = Channel("", "force", "N") if is_per_force(array.unit) else Channel("")
        contents.responses.append(
            frequency_responses(
                hertz * HERTZ,
                values,
                [numerator._replace(name=f"{key}.{k + 1}") for k in range(values.shape[0])],
                [denominator._replace(name=f"reference {k + 1}") for k in range(values.shape[1])],
                name=f"{name}.{key}" if name else key,
                notes=[Fact("responses_along_first_side")],
            )
        )
        if axis is None and even is not None:
            settings = {"start": even.start, "step": even.step, "stop": float(hertz[-1])}
            contents.notes.append(Fact("even_axis", name=key, **settings))
            remaining = {other: array for other, array in remaining.items() if other not in single}
        remaining.pop(key)
        line_counts.add(hertz.size)
    # Flags of the lines of responses, and frequencies alone, are no table.
    marks = {key: array for key, array in remaining.items() if array.length in line_counts}
    if all(key in axes or is_mark(key, array) for key, array in marks.items()):
        others = [key for key in marks if key not in axes]
        contents.notes.extend(Fact("not_read", name=key, why="marks") for key in others)
        remaining = {key: array for key, array in remaining.items() if key not in marks}
    return remaining
