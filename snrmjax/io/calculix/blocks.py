"""An input deck as keyword blocks, with included files inserted and comments dropped."""

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from snrmjax.io.files import FilePath, file_name, read_text, shown
from snrmjax.numerics.rules import InputError

_DEEPEST_INCLUDE = 20


class Line(NamedTuple):
    """A line of a deck with its file and line number."""

    text: str
    file: str
    number: int  # in its file, from one

    @property
    def location(self) -> str:
        """File and line number, for messages."""
        return f"{self.file}, line {self.number}"

    @property
    def entries(self) -> list[str]:
        """The comma-separated entries; a trailing comma adds none."""
        parts = [part.strip() for part in self.text.split(",")]
        return parts[:-1] if len(parts) > 1 and not parts[-1] else parts


class Block(NamedTuple):
    """A keyword with its parameters and the data lines below it."""

    keyword: str  # in capitals, without the star
    parameters: dict[str, str]  # names in capitals; a flag has an empty value
    head: Line
    data: tuple[Line, ...]

    def named(self, parameter: str) -> str:
        """The value of a parameter in capitals, as CalculiX compares names, or an empty text."""
        return self.parameters.get(parameter, "").upper()

    @property
    def text(self) -> str:
        """The block as text of a deck."""
        values = [f"{name}={value}" if value else name for name, value in self.parameters.items()]
        rows = [line.text for line in self.data]
        return "\n".join(["*" + ", ".join([self.keyword, *values]), *rows])

    def with_parameters(self, **changed: str | None) -> "Block":
        """With changed parameter values; None removes a parameter."""
        kept = {**self.parameters, **{name: value or "" for name, value in changed.items()}}
        gone = [name for name, value in changed.items() if value is None]
        return self._replace(parameters={n: v for n, v in kept.items() if n not in gone})


def read_blocks(path: FilePath) -> list[Block]:
    """The keyword blocks of a deck, *INCLUDE files inserted.

    Returns the blocks in the order of the deck. Raises `ValueError` where a file is missing or
    includes itself, and for data before the first keyword.
    """
    lines = list(_lines(Path(path), ()))
    blocks: list[Block] = []
    position = 0
    while position < len(lines):
        head = lines[position]
        if not head.text.startswith("*"):
            raise InputError(
                f"{head.location}: {shown(head.text)} comes before the first keyword (*NODE, ...)."
            )
        text = head.text
        while text.endswith(",") and position + 1 < len(lines):  # a keyword on several lines
            position += 1
            text += lines[position].text
        begin = position = position + 1
        while position < len(lines) and not lines[position].text.startswith("*"):
            position += 1
        keyword, *parameters = [part.strip() for part in text[1:].split(",")]
        named = [part.partition("=") for part in parameters if part]
        values = {name.strip().upper(): value.strip() for name, _, value in named}
        keyword = " ".join(keyword.upper().split())
        blocks.append(Block(keyword, values, head, tuple(lines[begin:position])))
    return blocks


def _lines(path: Path, above: tuple[Path, ...]) -> Iterator[Line]:
    """Lines other than blanks and comments, with included files inserted."""
    name = file_name(path)
    for number, raw in enumerate(read_text(path).splitlines(), start=1):
        text = raw.strip()
        if not text or text.startswith("**"):
            continue
        line = Line(text, name, number)
        if text[1:].replace(" ", "").upper().startswith("INCLUDE") and text[0] == "*":
            yield from _included(line, path, (*above, path))
        else:
            yield line


def _included(line: Line, path: Path, above: tuple[Path, ...]) -> Iterator[Line]:
    values = dict(part.split("=", 1) for part in line.text.split(",") if "=" in part)
    given = [
        value.strip().strip('"') for key, value in values.items() if key.strip().upper() == "INPUT"
    ]
    if not given:
        raise InputError(f"{line.location}: *INCLUDE needs INPUT=file.")
    target = path.parent / given[0]
    if target in above or len(above) > _DEEPEST_INCLUDE:
        raise InputError(f"{line.location}: {given[0]} includes itself.")
    if not target.is_file():
        raise InputError(f"{line.location}: the included file {given[0]} does not exist.")
    yield from _lines(target, above)
