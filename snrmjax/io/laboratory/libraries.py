"""Borders to the libraries of file formats: one sentence where one lacks or a file is damaged."""

import importlib
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any


def library(module: str, purpose: str) -> Any:
    """A library of the extra `lab`, imported where it is first needed.

    Raises `ValueError` with the command that installs it; `purpose` says what needs it.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise ValueError(
            f"{purpose} needs the package {module.split('.')[0]}, which is not installed: "
            "pip install 'snrmjax[lab]'"
        ) from error


@contextmanager
def damaged_if_it_fails(file: str, what: str) -> Iterator[None]:
    """Whatever a library raises about a file becomes a `ValueError` that names the file.

    Only calls of libraries stand inside: each has errors of its own (struct, zlib, HDF5, …).
    """
    try:
        yield
    except Exception as error:
        said = " ".join(str(error).split())
        why = f" ({said[:160]})" if said else f" ({type(error).__name__})"
        raise ValueError(f"{file} is damaged or is not {what}{why}.") from error
