"""Access to file-format libraries: clear errors for missing packages and damaged files."""

import importlib
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from snrmjax.numerics.rules import InputError


def library(module: str, purpose: str) -> Any:
    """A library of the extra `lab`, imported when first needed.

    Raises `ValueError` with the command that installs it; `purpose` is named in the message.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise InputError(
            f"{purpose} needs the package {module.split('.')[0]}, which is not installed: "
            "pip install 'snrmjax[lab]'"
        ) from error


@contextmanager
def damaged_if_it_fails(file: str, what: str) -> Iterator[None]:
    """Turn any exception of a library into a `ValueError` that names the file.

    Enclose only library calls: each raises its own errors (struct, zlib, HDF5, …).
    """
    try:
        yield
    except Exception as error:
        message = " ".join(str(error).split())
        why = f" ({message[:160]})" if message else f" ({type(error).__name__})"
        raise InputError(f"{file} is damaged or is not {what}{why}.") from error
