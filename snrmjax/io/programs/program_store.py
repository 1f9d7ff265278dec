"""Store of compiled programs on disk, which saves tracing, lowering and compilation.

JAX's own cache saves only the compilation: its key is the lowered program, and tracing and lowering
take a command longer than its computation. The key here covers all inputs of a program: the sources
of this package, the libraries that trace and compile, the processor, the settings of JAX, the
function, and every type, shape and setting of its arguments. Programs that depend on other code (a
user-defined effect, a closure) are not stored.
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

from snrmjax.numerics.compiled import NotKept, keep_programs_with

try:  # trace state besides arguments; compile time from which JAX caches a program itself
    from jax._src.config import disable_jit, trace_context
    from jax._src.config import persistent_cache_min_compile_time_secs as worth_keeping
except ImportError:  # private JAX names may move: then no program is stored
    disable_jit = trace_context = worth_keeping = None  # type: ignore[assignment]

_PACKAGE = __name__.partition(".")[0]
_LIBRARIES = ("jax", "jaxlib", "equinox", "optimistix", "lineax", "interpax", "numpy")
_VERSIONS_KEPT = 3  # of this package and its libraries, each in its own folder
_SOURCES = Path(__file__).resolve().parents[2]  # package folder with the sources
_MOST_BYTES = 512 * 2**20  # of one version
_DIGEST = hashlib.sha256().digest_size
# Settings of JAX that do not affect programs.
_IRRELEVANT_SETTINGS = ("jax_compilation_cache", "jax_persistent_cache", "jax_log", "jax_debug_log")


class ProgramStore(NamedTuple):
    """Programs in a folder, of one version of the package and its dependencies."""

    folder: Path
    context: object  # JAX trace context when they were compiled

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
        stored = _read(file)
        if stored is None:
            lowered, like = build()
            # Bypass JAX's cache: XLA cannot serialise a program that it loaded from there.
            with worth_keeping(math.inf):
                stored = lowered.compile(), like
            calls = set(re.findall(r"custom_call @(\w+)", lowered.as_text()))
            if all(name.startswith("lapack_") for name in calls):
                _write(file, *stored, bool(calls))
        return stored


def keep_programs(folder: Path) -> None:
    """Store programs in a folder, if JAX computes on a single CPU."""
    if trace_context is None or jax.default_backend() != "cpu" or len(jax.devices()) != 1:
        return
    version = folder / version_of(_SOURCES)
    if not version.is_dir():
        _drop_old(folder)
    keep_programs_with(ProgramStore(version, trace_context()))


def key_of(function: Callable[..., Any], arguments: Any, settings: tuple = ()) -> str:
    """The file name of a program. Raises `NotKept` where it depends on code outside the package."""
    parts = _qualified_name(function), _argument_key(arguments), settings
    return hashlib.sha256(repr(parts).encode()).hexdigest()


def processor_digest() -> str:
    """Digest of the processor kind for which programs are compiled."""
    listed = Path("/proc/cpuinfo")
    text = listed.read_text(encoding="utf-8") if listed.exists() else platform.processor()
    kind = sorted({line for line in text.splitlines() if line.startswith(("model name", "flags"))})
    return hashlib.sha256("\n".join(kind or [text]).encode()).hexdigest()[:12]


def version_of(package: Path) -> str:
    """Digest of the inputs common to all programs of a process, the name of their folder."""
    sources = hashlib.sha256()
    for file in sorted(package.rglob("*.py")):
        sources.update(f"{file.relative_to(package)}\0".encode() + file.read_bytes())
    settings = {
        name: str(value)
        for name, value in jax.config.values.items()
        if not name.startswith(_IRRELEVANT_SETTINGS)
    }
    parts = (
        *(sources.hexdigest(), processor_digest(), sys.version, platform.machine()),
        [importlib.metadata.version(name) for name in _LIBRARIES],
        *(sorted(settings.items()), os.environ.get("XLA_FLAGS")),
    )
    return hashlib.sha256(repr(parts).encode()).hexdigest()[:20]


def _argument_key(value: Any, fixed: bool = False) -> Any:
    """Key of an argument: types, shapes and settings; with `fixed` also its numbers."""
    kind = type(value)
    if kind in (bool, int, str, bytes, type(None)) or (fixed and kind in (float, complex)):
        return kind.__name__, repr(value)
    if isinstance(value, float | complex | np.ndarray | np.generic | jax.Array) and not fixed:
        weak = bool(getattr(value, "weak_type", False))
        return "array", np.shape(value), str(getattr(value, "dtype", kind.__name__)), weak
    if kind in (tuple, list):
        return kind.__name__, [_argument_key(one, fixed) for one in value]
    if kind is dict:
        return "dict", [(_argument_key(k, True), _argument_key(v, fixed)) for k, v in value.items()]
    if isinstance(value, type | FunctionType):
        return "named", _qualified_name(value)
    if isinstance(value, enum.Enum):
        return _qualified_name(kind), value.name
    if isinstance(value, tuple) and hasattr(kind, "_fields"):
        return _qualified_name(kind), [_argument_key(one, fixed) for one in value]
    if isinstance(value, eqx.Module):
        return _qualified_name(kind), [
            (
                f.name,
                _argument_key(getattr(value, f.name), fixed or f.metadata.get("static", False)),
            )
            for f in dataclasses.fields(value)
        ]
    raise NotKept


def _qualified_name(definition: Any) -> str:
    """Qualified name of a class or function of this package; raises `NotKept` for others."""
    module, name = definition.__module__, definition.__qualname__
    ours = module == _PACKAGE or module.startswith(f"{_PACKAGE}.")
    if not ours or "<" in name or getattr(definition, "__closure__", None):
        raise NotKept
    current: Any = sys.modules[module]
    for part in name.split("."):
        current = getattr(current, part, None)
    if current is not definition and getattr(current, "__wrapped__", None) is not definition:
        raise NotKept
    return f"{module}:{name}"


def _read(file: Path) -> tuple[Callable[..., list[jax.Array]], Any] | None:
    """A stored program; None where the file is missing or damaged."""
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
    except jax.errors.JaxRuntimeError:  # XLA refuses it on this machine
        return None


@cache
def _find_lapack() -> None:
    """Make JAX register LAPACK's routines, which it does when lowering the first call of one."""
    jax.jit(jax.lax.linalg.cholesky).lower(np.ones((1, 1)))


def _write(file: Path, program: jax.stages.Compiled, like: Any, calls_lapack: bool) -> None:
    """Store a program atomically; failures are ignored, since the store is only a cache."""
    try:
        executable, arguments, _ = serialize(program)
        content = pickle.dumps((arguments.num_leaves, executable, like, calls_lapack))
    except (ValueError, NotImplementedError, TypeError, AttributeError, pickle.PicklingError):
        return  # Python callbacks, or results that cannot be pickled
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        if sum(one.stat().st_size for one in os.scandir(file.parent)) > _MOST_BYTES:
            return
        with tempfile.NamedTemporaryFile(dir=file.parent, delete=False) as written:
            written.write(hashlib.sha256(content).digest() + content)
        os.replace(written.name, file)
    except OSError:  # the disk is full, or the folder is read-only
        return


def _drop_old(folder: Path) -> None:
    """Delete the oldest versions to make room for a new one."""
    try:
        versions = sorted(os.scandir(folder), key=lambda one: one.stat().st_mtime)
    except OSError:  # missing, not readable, or changed by another process
        return
    for version in versions[: max(len(versions) + 1 - _VERSIONS_KEPT, 0)]:
        shutil.rmtree(version, ignore_errors=True)
