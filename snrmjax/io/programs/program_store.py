"""Compiled programs on disk, whole: who finds one there neither traces, lowers nor compiles it.

JAX's own cache spares the compilation alone: it is found by the lowered program, and to trace and
lower that takes a command longer than its numbers. A program is found here by all that it is made
of: the sources of this package, the libraries that trace and compile, the processor, the settings
of JAX, the function, and of its arguments every type, shape and setting. One that depends on code
of others (a user's own effect, a closure) is not kept.
"""

import dataclasses
import enum
import hashlib
import importlib.metadata
import math
import os
import pickle
import platform
import re
import shutil
import sys
import tempfile
from collections.abc import Callable
from functools import cache
from pathlib import Path
from types import FunctionType
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jax.experimental.serialize_executable import deserialize_and_load, serialize

from snrmjax.numerics.kept_programs import NotKept, keep_programs_with

try:  # what a trace depends on beside its arguments; from when on JAX keeps a program itself
    from jax._src.config import disable_jit, trace_context
    from jax._src.config import persistent_cache_min_compile_time_secs as worth_keeping
except ImportError:  # JAX moves what is private to it: without these no program is kept
    disable_jit = trace_context = worth_keeping = None  # type: ignore[assignment]

_PACKAGE = __name__.partition(".")[0]
_LIBRARIES = ("jax", "jaxlib", "equinox", "optimistix", "lineax", "interpax", "numpy")
_VERSIONS_KEPT = 3  # of this package and its libraries, each in a folder of its own
_SOURCES = Path(__file__).resolve().parents[2]  # all of whose sources programs are made of
_MOST_BYTES = 512 * 2**20  # of one version
_DIGEST = hashlib.sha256().digest_size
# Settings of JAX that change no program, but differ from user to user.
_OF_NO_PROGRAM = ("jax_compilation_cache", "jax_persistent_cache", "jax_log", "jax_debug_log")


class ProgramStore(NamedTuple):
    """Programs in a folder, of one version of the package and of all that it stands on."""

    folder: Path
    context: object  # settings of JAX under which they were compiled

    def in_use(self) -> bool:
        """See `ProgramKeeper`."""
        return trace_context() == self.context and not disable_jit.value

    def program(
        self,
        function: Callable[..., Any],
        arguments: Any,
        settings: tuple,
        build: Callable[[], tuple[jax.stages.Lowered, Any]],
    ) -> tuple[Callable[..., list[jax.Array]], Any]:
        """See `ProgramKeeper`."""
        file = self.folder / key_of(function, arguments, settings)
        found = _read(file)
        if found is None:
            lowered, like = build()
            # What XLA read from JAX's cache it cannot write again: there it must not be.
            with worth_keeping(math.inf):
                found = lowered.compile(), like
            called = set(re.findall(r"custom_call @(\w+)", lowered.as_text()))
            if all(name.startswith("lapack_") for name in called):
                _write(file, *found, bool(called))
        return found


def keep_programs(folder: Path) -> None:
    """Keep programs in a folder, where JAX computes on one CPU."""
    if trace_context is None or jax.default_backend() != "cpu" or len(jax.devices()) != 1:
        return
    version = folder / version_of(_SOURCES)
    if not version.is_dir():
        _drop_old(folder)
    keep_programs_with(ProgramStore(version, trace_context()))


def key_of(function: Callable[..., Any], arguments: Any, settings: tuple = ()) -> str:
    """The name of a program's file. Raises `NotKept` where code of others has a part in it."""
    parts = _named(function), _described(arguments), settings
    return hashlib.sha256(repr(parts).encode()).hexdigest()


def processor_digest() -> str:
    """The kind of processor, for which programs are compiled."""
    listed = Path("/proc/cpuinfo")
    text = listed.read_text(encoding="utf-8") if listed.exists() else platform.processor()
    kind = sorted({line for line in text.splitlines() if line.startswith(("model name", "flags"))})
    return hashlib.sha256("\n".join(kind or [text]).encode()).hexdigest()[:12]


def version_of(package: Path) -> str:
    """All that is the same for the programs of a process, as the name of their folder."""
    sources = hashlib.sha256()
    for file in sorted(package.rglob("*.py")):
        sources.update(f"{file.relative_to(package)}\0".encode() + file.read_bytes())
    settings = {
        name: str(value)
        for name, value in jax.config.values.items()
        if not name.startswith(_OF_NO_PROGRAM)
    }
    parts = (
        *(sources.hexdigest(), processor_digest(), sys.version, platform.machine()),
        [importlib.metadata.version(name) for name in _LIBRARIES],
        *(sorted(settings.items()), os.environ.get("XLA_FLAGS")),
    )
    return hashlib.sha256(repr(parts).encode()).hexdigest()[:20]


def _described(value: Any, fixed: bool = False) -> Any:
    """All of an argument that a program depends on; of a `fixed` one its numbers too."""
    kind = type(value)
    if kind in (bool, int, str, bytes, type(None)) or (fixed and kind in (float, complex)):
        return kind.__name__, repr(value)
    if isinstance(value, float | complex | np.ndarray | np.generic | jax.Array) and not fixed:
        weak = bool(getattr(value, "weak_type", False))
        return "array", np.shape(value), str(getattr(value, "dtype", kind.__name__)), weak
    if kind in (tuple, list):
        return kind.__name__, [_described(one, fixed) for one in value]
    if kind is dict:
        return "dict", [(_described(k, True), _described(v, fixed)) for k, v in value.items()]
    if isinstance(value, type | FunctionType):
        return "named", _named(value)
    if isinstance(value, enum.Enum):
        return _named(kind), value.name
    if isinstance(value, tuple) and hasattr(kind, "_fields"):
        return _named(kind), [_described(one, fixed) for one in value]
    if isinstance(value, eqx.Module):
        return _named(kind), [
            (f.name, _described(getattr(value, f.name), fixed or f.metadata.get("static", False)))
            for f in dataclasses.fields(value)
        ]
    raise NotKept


def _named(thing: Any) -> str:
    """The name of a class or function of this package, which its sources define."""
    module, name = thing.__module__, thing.__qualname__
    ours = module == _PACKAGE or module.startswith(f"{_PACKAGE}.")
    if not ours or "<" in name or getattr(thing, "__closure__", None):
        raise NotKept
    found: Any = sys.modules[module]
    for part in name.split("."):
        found = getattr(found, part, None)
    if found is not thing and getattr(found, "__wrapped__", None) is not thing:
        raise NotKept
    return f"{module}:{name}"


def _read(file: Path) -> tuple[Callable[..., list[jax.Array]], Any] | None:
    """A program that is kept in a file; None where there is none, or not as it was written."""
    try:
        content = file.read_bytes()
    except OSError:
        return None
    digest, content = content[:_DIGEST], content[_DIGEST:]
    if hashlib.sha256(content).digest() != digest:
        return None
    n_arguments, executable, like, calls_lapack = pickle.loads(content)
    if calls_lapack:
        _find_lapack()
    trees = jax.tree.structure(((0,) * n_arguments, {})), jax.tree.structure(jax.tree.leaves(like))
    try:
        return deserialize_and_load(executable, *trees), like
    except jax.errors.JaxRuntimeError:  # XLA finds that this machine cannot run it
        return None


@cache
def _find_lapack() -> None:
    """Have JAX look up LAPACK's routines, which it does as it lowers the first call of one."""
    jax.jit(jax.lax.linalg.cholesky).lower(np.ones((1, 1)))


def _write(file: Path, program: jax.stages.Compiled, like: Any, calls_lapack: bool) -> None:
    """Keep a program in a file, whole or not at all; where it cannot be, nothing is lost."""
    try:
        executable, arguments, _ = serialize(program)
        content = pickle.dumps((arguments.num_leaves, executable, like, calls_lapack))
    except (ValueError, NotImplementedError, TypeError, AttributeError, pickle.PicklingError):
        return  # it calls back into Python, or its results hold what has no name
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        if sum(one.stat().st_size for one in os.scandir(file.parent)) > _MOST_BYTES:
            return
        with tempfile.NamedTemporaryFile(dir=file.parent, delete=False) as written:
            written.write(hashlib.sha256(content).digest() + content)
        os.replace(written.name, file)
    except OSError:  # the disk is full, or the folder is not ours to write
        return


def _drop_old(folder: Path) -> None:
    """Leave room for one more version beside the newest."""
    try:
        versions = sorted(os.scandir(folder), key=lambda one: one.stat().st_mtime)
    except OSError:  # there is none, it is not ours, or another process has just dropped one
        return
    for version in versions[: max(len(versions) + 1 - _VERSIONS_KEPT, 0)]:
        shutil.rmtree(version, ignore_errors=True)
