"""Modules of benchmarks, which stand beside each other and in no package."""

import importlib
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"


@pytest.fixture(scope="module")
def of_benchmark() -> Callable[[str], ModuleType]:
    """A module by its path among the benchmarks; what it imports is forgotten afterwards."""
    known, folders = {*sys.modules}, []

    def module(path: str) -> ModuleType:
        folder, _, name = path.rpartition("/")
        if folder not in folders:
            folders.append(folder)
            sys.path.insert(0, str(BENCHMARKS / folder))
        return importlib.import_module(name)

    yield module
    for folder in folders:
        sys.path.remove(str(BENCHMARKS / folder))
    for name, one in [*sys.modules.items()]:
        file = getattr(one, "__file__", None)
        if name not in known and file and BENCHMARKS in Path(file).parents:
            del sys.modules[name]
