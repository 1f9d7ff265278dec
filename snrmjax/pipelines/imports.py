"""Import: laboratory files to our tables, or a list of their contents."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from snrmjax.io.exchange.import_map import map_of_options
from snrmjax.io.exchange.import_options import refuse_unused_axis
from snrmjax.io.exchange.importing import Imported, import_files
from snrmjax.io.exchange.listing import listed_contents
from snrmjax.io.exchange.proposals import proposed_commands
from snrmjax.io.files import FilePath
from snrmjax.io.laboratory.reading import read_laboratory_file


def import_test(
    files: Sequence[FilePath], map_file: FilePath | None = None, **options: Any
) -> Imported:
    """Steady states, or unprocessed records, from the files of one test.

    Arguments: `map_file` of an earlier import; `options` of the command by name, which override it
    (`force="CH1"`, `response=["CH2:acceleration:g"]`).
    Raises `ValueError` as `import_files` does: a question where the content is ambiguous.
    """
    stated = map_of_options(None if map_file is None else Path(map_file), options)
    given = [key for key, value in options.items() if value]
    return import_files([Path(file) for file in files], stated, given)


def list_contents(files: Sequence[FilePath], **options: Any) -> list[str]:
    """Lines on the contents of files, and the command that would import them as one test."""
    stated = map_of_options(None, options)
    paths = [Path(file) for file in files]
    contents = [read_laboratory_file(path, stated.text_format, stated.even_axis) for path in paths]
    refuse_unused_axis([key for key, value in options.items() if value], contents)
    lines = [line for one in contents for line in listed_contents(one)]
    return [*lines, *proposed_commands(paths, contents, stated)]
