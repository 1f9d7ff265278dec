"""Octave's text format, the default of its `save`.

Each variable is a line `# name:`, a line `# type:`, lines of dimensions, and the numbers.
"""

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np

from snrmjax.io.files import shown
from snrmjax.io.laboratory.arrays.even_axis import EvenAxis
from snrmjax.io.laboratory.arrays.structs import file_of_tree
from snrmjax.io.laboratory.arrays.value_tree import Node, in_memory
from snrmjax.io.laboratory.contents import LaboratoryFile
from snrmjax.io.laboratory.text.fields import text_of
from snrmjax.numerics.facts import Fact
from snrmjax.numerics.rules import InputError

_DEEPEST = 24
_LONGEST_RANGE = 2**24
_MISSING = {"NA": "nan", "na": "nan"}
_TEXTS = ("string", "sq_string", "null_string", "null_sq_string")
_NUMBERS = r"((complex|bool|u?int(8|16|32|64)) )?"
_NAME = "# name: "


def is_octave_text(head: bytes) -> bool:
    """Whether a file begins like an Octave text file."""
    first, _, rest = head.lstrip(b"\xef\xbb\xbf\r\n ").partition(b"\n")
    return first.startswith(b"# Created by Octave") or (
        first.startswith(b"# name: ") and rest.startswith(b"# type: ")
    )


def read_octave(path: Path, axis: EvenAxis | None = None) -> LaboratoryFile:
    """A file of Octave's text format. Raises `ValueError` as `read_laboratory_file` does."""
    lines = _Lines(text_of(path).splitlines(), path.name)
    tree: dict[str, Node] = {}
    while lines.find_name():
        name = lines.stated("name")
        node = _value(lines, name, 0)
        if node is not None:
            tree[name] = node
    return file_of_tree(path.name, tree, lines.notes, axis)


class _Lines:
    """The lines of a file with a reading position."""

    def __init__(self, lines: list[str], file: str) -> None:
        self._lines, self.file, self._at = lines, file, 0
        self.notes: list[Fact] = []

    @property
    def left(self) -> int:
        """Number of remaining lines."""
        return len(self._lines) - self._at

    def find_name(self) -> bool:
        """Go to the next variable, if there is one."""
        while self.left and not self._lines[self._at].startswith(_NAME):
            self._at += 1
        return self.left > 0

    def next(self) -> str:
        """The next line."""
        if not self.left:
            raise InputError(f"{self.file} is truncated: it ends within a variable.")
        self._at += 1
        return self._lines[self._at - 1]

    def peek(self, key: str) -> bool:
        """Whether the next line states a key."""
        return self.left > 0 and self._lines[self._at].startswith(f"# {key}")

    def stated(self, key: str) -> str:
        """The value of a key on the next line that is not empty."""
        line = self.next()
        while not line.strip() and self.left:
            line = self.next()
        if not line.startswith(f"# {key}: "):
            raise self.damaged(f"# {key}: …", line)
        return line.partition(": ")[2].strip()

    def count(self, key: str) -> int:
        """The value of a key as a whole number, not larger than the file can hold."""
        word = self.stated(key)
        if not word.isdigit() or int(word) > max(self.left, len(self._lines)) * 2**16:
            raise self.damaged("a number of rows", word)
        return int(word)

    def damaged(self, wanted: str, line: str) -> InputError:
        """The error for an invalid line."""
        return InputError(
            f"{self.file} is damaged: line {self._at} must be {wanted}, but is {shown(line)}."
        )

    def dimensions(self) -> tuple[int, ...]:
        """Numbers of rows and columns, or more dimensions."""
        if not self.peek("ndims"):
            return self.count("rows"), self.count("columns")
        self.count("ndims")
        line = self.next()
        words = line.split()
        if not words or not all(word.isdigit() for word in words):
            raise self.damaged("the dimensions of an array", line)
        return tuple(int(word) for word in words)

    def numbers(self, n_lines: int, count: int, *, is_complex: bool) -> np.ndarray:
        """The `count` numbers on the next `n_lines` lines."""
        if n_lines > self.left:
            raise InputError(f"{self.file} is truncated: it ends within a variable.")
        first, texts = self._at + 1, [self.next() for _ in range(n_lines)]
        text = " ".join(texts)
        if is_complex:
            text = text.replace("(", " ").replace(")", " ").replace(",", " ")
        words = [_MISSING.get(word, word) for word in text.split()]
        each = 2 if is_complex else 1
        try:
            values = np.array(words, dtype=float)
        except ValueError as error:
            raise InputError(
                f"{self.file} is damaged: lines {first} to {self._at} must be numbers."
            ) from error
        if len(values) != each * count:
            raise InputError(
                f"{self.file} is damaged: lines {first} to {self._at} have "
                f"{len(values) / each:g} numbers, but {count} are stated."
            )
        return values[::2] + 1j * values[1::2] if is_complex else values


def _value(lines: _Lines, name: str, depth: int) -> Node | None:
    """The value of a variable, of a field or of a cell; None with a note if it is not read."""
    if depth > _DEEPEST:
        raise InputError(f"{name} of {lines.file} nests too deeply.")
    kind = lines.stated("type").removeprefix("global ").removeprefix("float ")
    if kind in _TEXTS:
        return _text(lines)
    if kind in _NESTED:
        return _NESTED[kind](lines, name, depth)
    if kind.endswith("range"):
        return _range(lines, name)
    if kind == "bool" or re.fullmatch(rf"{_NUMBERS}scalar", kind):
        values = lines.numbers(1, 1, is_complex=kind.startswith("complex"))
        return in_memory(values.astype(bool) if kind == "bool" else values)
    if kind == "null_matrix" or re.fullmatch(rf"{_NUMBERS}matrix", kind):
        return _matrix(lines, kind)
    is_sparse = kind.startswith("sparse")
    lines.notes.append(
        Fact("not_read", name=name, why="sparse")
        if is_sparse
        else Fact("object_not_read", name=name, kind=kind)
    )
    lines.find_name()
    return None


def _matrix(lines: _Lines, kind: str) -> Node | None:
    is_by_rows = not lines.peek("ndims")
    dimensions = lines.dimensions()
    count = int(np.prod(dimensions, dtype=object))
    if not count:
        return None
    is_complex = kind.startswith("complex")
    values = lines.numbers(dimensions[0] if is_by_rows else count, count, is_complex=is_complex)
    values = values.astype(bool) if kind.startswith("bool") else values
    return in_memory(values.reshape(dimensions, order="C" if is_by_rows else "F"))


def _text(lines: _Lines) -> Node:
    if lines.peek("ndims"):
        lines.dimensions()
        return lines.next()
    texts = []
    for _ in range(lines.count("elements")):
        length = lines.count("length")
        texts.append(lines.next().rstrip() if length else "")
    return texts[0] if len(texts) == 1 else list(texts)


def _range(lines: _Lines, name: str) -> Node:
    """A range: `# base, limit, increment`."""
    keys = [word.strip() for word in lines.next().lstrip("# ").split(",")]
    line = lines.next()
    words = line.split()
    try:
        values = {key: float(word) for key, word in zip(keys, words, strict=False)}
        base, step = values["base"], values["increment"]
        steps = values["length"] - 1 if "length" in values else (values["limit"] - base) / step
    except (ValueError, KeyError, ZeroDivisionError) as error:
        raise lines.damaged(f"base, limit and increment of {name}", line) from error
    if not 0 <= steps < _LONGEST_RANGE:
        raise lines.damaged(f"a range of less than {_LONGEST_RANGE} numbers", line)
    return in_memory(base + step * np.arange(int(steps * (1 + 1e-12) + 1e-9) + 1))


def _cell(lines: _Lines, name: str, depth: int) -> Node:
    """A cell array: a list, or a list of rows if two-dimensional."""
    dimensions = lines.dimensions()
    count = int(np.prod(dimensions, dtype=object))
    if count > lines.left:
        raise InputError(f"{lines.file} is truncated: it ends within {name}.")
    cells: list[Node] = []
    for k in range(count):
        lines.stated("name")
        node = _value(lines, f"{name}{{{k + 1}}}", depth + 1)
        cells.append([] if node is None else node)
    if len(dimensions) == 2 and min(dimensions) > 1:
        return [cells[row :: dimensions[0]] for row in range(dimensions[0])]
    return cells


def _struct(lines: _Lines, name: str, depth: int) -> dict[str, Node]:
    """The fields of a struct; of a struct array, each field is a list."""
    if lines.peek("ndims"):
        lines.dimensions()
    fields: dict[str, Node] = {}
    for _ in range(lines.count("length")):
        key = lines.stated("name")
        node = _value(lines, f"{name}.{key}", depth + 1)
        if node is not None:
            fields[key] = node
    return fields


def _structs(lines: _Lines, name: str, depth: int) -> Node:
    fields = _struct(lines, name, depth)
    columns = {key: node for key, node in fields.items() if isinstance(node, list)}
    counts = {len(node) for node in columns.values()}
    if len(counts) != 1 or len(columns) < len(fields):
        return fields
    each = [{key: nodes[k] for key, nodes in columns.items()} for k in range(min(counts))]
    return each[0] if len(each) == 1 else list(each)


_NESTED: dict[str, Callable[[_Lines, str, int], Node]] = {
    "cell": _cell,
    "struct": _structs,
    "scalar struct": _struct,
}
