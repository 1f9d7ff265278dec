"""User-defined effects from Python files, for commands and the processes of a study."""

import hashlib
import importlib.util
import inspect
import os
import sys
from pathlib import Path
from types import ModuleType

from snrmjax.io.files import read_text
from snrmjax.model.effect_base import AbstractEffect
from snrmjax.model.effects import known_effects, register_effect
from snrmjax.numerics.rules import InputError

_loaded: dict[Path, str] = {}  # file and digest, in loading order


def load_effects(path: str | os.PathLike[str]) -> None:
    """Run a Python file and register the effects that it defines, as `register_effect` does.

    The file may also register effects itself and import modules from its folder. A file that is
    already loaded is not run again.
    Raises `ValueError` for a file that cannot be read or run, for one that defines no effect, and
    for an effect whose kind exists already or that has no parameter.
    """
    file = Path(path).resolve()
    digest = hashlib.sha256(read_text(path).encode()).hexdigest()
    if _loaded.get(file) == digest:
        return
    before = {*known_effects()}
    module = _run(file)
    try:
        for effect in _defined(module):
            if effect not in known_effects().values():
                register_effect(effect)
    except InputError as error:
        raise InputError(f"{file.name} cannot be loaded: {error}") from error
    if not {*known_effects()} - before:
        raise InputError(
            f"{file.name} defines no effect: a class with a `kind`, a parameter and a `force`, "
            "derived from `snrmjax.model.AbstractMemoryless` or another base of effects."
        )
    _loaded[file] = digest


def loaded_effects() -> dict[Path, str]:
    """The loaded files with the digests of their contents, in loading order."""
    return dict(_loaded)


def _run(file: Path) -> ModuleType:
    # A unique name that is the same in every process, since pickles refer to it.
    name = f"own_effects_{hashlib.sha256(os.fsencode(file)).hexdigest()[:16]}"
    spec = importlib.util.spec_from_file_location(name, file)
    if spec is None or spec.loader is None:
        raise InputError(f"{file.name} is no Python file: its name must end in .py.")
    module = sys.modules[name] = importlib.util.module_from_spec(spec)
    if str(file.parent) not in sys.path:
        sys.path.append(str(file.parent))
    try:
        spec.loader.exec_module(module)
    except (Exception, SystemExit) as error:  # a user's file may raise anything
        del sys.modules[name]
        message = (str(error).splitlines() or [""])[0].rstrip(".")
        raise InputError(
            f"{file.name} cannot be loaded: {type(error).__name__}{message and f': {message}'}."
        ) from error
    return module


def _defined(module: ModuleType) -> list[type[AbstractEffect]]:
    """The effects whose classes are defined in the file, in order."""
    return [
        value
        for value in vars(module).values()
        if isinstance(value, type)
        and issubclass(value, AbstractEffect)
        and value.__module__ == module.__name__
        and not inspect.isabstract(value)
        and hasattr(value, "kind")
    ]
