"""Reading and atomic writing of files, and how messages show names and values."""

import json
import math
import os
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from snrmjax.numerics.facts import Fact
from snrmjax.numerics.rules import InputError

FilePath = str | os.PathLike[str]


def read_bytes(path: FilePath, most: int = -1) -> bytes:
    """The content of a file, or its first bytes.

    Raises `ValueError` when the file is missing, a folder or unreadable.
    """
    try:
        with open(path, "rb") as file:
            return file.read(most)
    except FileNotFoundError as error:
        raise InputError(f"{os.fspath(path)} does not exist.") from error
    except IsADirectoryError as error:
        raise InputError(f"{os.fspath(path)} is a folder, but a file is expected.") from error
    except OSError as error:
        raise InputError(f"{os.fspath(path)} cannot be read: {error.strerror}.") from error


def read_text(path: FilePath) -> str:
    """The text of a UTF-8 file, without a byte-order mark and with line ends unchanged.

    Raises `ValueError` as `read_bytes` does, and for a file that is not text.
    """
    content = read_bytes(path)
    if b"\0" in content:
        raise InputError(f"{file_name(path)} is not a UTF-8 text file (it has NUL bytes).")
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(
            f"{file_name(path)} is not a UTF-8 text file (byte {error.start + 1} breaks it)."
        ) from error


@contextmanager
def written_whole(path: FilePath) -> Iterator[Path]:
    """A temporary file next to `path`, which replaces it on success and is removed on failure.

    Raises `ValueError` when the folder does not exist or cannot be written.
    """
    target = Path(os.path.realpath(path))  # a link stays a link
    temporary = target.with_name(f".{uuid.uuid4().hex}.tmp")
    if not target.parent.is_dir():
        raise InputError(f"{os.fspath(path)} cannot be written: its folder does not exist.")
    try:
        yield temporary
        os.replace(temporary, target)
    except OSError as error:
        raise InputError(f"{os.fspath(path)} cannot be written: {error.strerror}.") from error
    finally:
        temporary.unlink(missing_ok=True)


def write_atomically(path: FilePath, content: str | bytes) -> None:
    """Write a file atomically; a text in UTF-8 with line ends unchanged.

    Raises `ValueError` as `written_whole` does.
    """
    with written_whole(path) as temporary:
        temporary.write_bytes(content.encode("utf-8") if isinstance(content, str) else content)


def write_summary(path: Path, summary: dict) -> None:
    """Write a summary as JSON; numbers that are not finite become null."""
    write_atomically(path, json.dumps(_plain(summary), indent=2, allow_nan=False) + "\n")


def file_name(path: FilePath) -> str:
    """The last part of a path, as messages name the file.

    >>> file_name("measured/beam.csv")
    'beam.csv'
    """
    name = Path(path).name
    return name if name.isprintable() else ascii(name)


def shown(value: object) -> str:
    """A value as messages show it: on one line and not too long.

    >>> shown("1,5"), shown("x" * 60)
    ("'1,5'", "'xxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxx...")
    """
    try:
        text = repr(value)
    except ValueError:  # an integer of more digits than Python prints
        return "a number too long to show"
    return text if len(text) <= 40 else f"{text[:37]}..."


def _plain(value: object) -> object:
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, Fact):
        return str(value)
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
