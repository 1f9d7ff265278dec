"""Description of a study as text and numbers, to identify it and to list differences."""

import dataclasses
import hashlib
import importlib.metadata
import inspect
from collections.abc import Iterator, Mapping
from typing import Any

import equinox as eqx
import jax
import numpy as np

from snrmjax import __version__
from snrmjax.condense.beam_models import BeamModels
from snrmjax.io.programs.effect_files import loaded_effects
from snrmjax.study.study import Study

_LONGEST = (
    64  # entries of an array that are written out; longer arrays are identified by their hash
)
_PACKAGES = ("jax", "jaxlib", "numpy")


def description(study: Study) -> dict[str, Any]:
    """The study, its model and the package versions as plain text and numbers."""
    # A model condensed from a beam has other last digits on other machines: its file identifies it.
    omitted = ("members_a_chunk", *(("model",) if isinstance(study.model_of, BeamModels) else ()))
    if study.sensor in (None, study.model.modes.sensors[0]):
        omitted = (*omitted, "sensor")  # for stores older than this field
    parts = {
        field.name: _plain(getattr(study, field.name))
        for field in dataclasses.fields(study)
        if field.name not in omitted
    }
    return {
        "study": {**parts, "members_a_chunk": study.chunk_size, **_own_effects()},
        "versions": {
            "snrmjax": __version__,
            **{name: importlib.metadata.version(name) for name in _PACKAGES},
        },
    }


def _own_effects() -> dict[str, Any]:
    """Files of user-defined effects with their hashes; empty without any."""
    files = loaded_effects()
    return {"effects": {file.name: digest[:16] for file, digest in files.items()}} if files else {}


def differences(here: Any, there: Any) -> dict[str, tuple[object, object]]:
    """Values of two descriptions by key where they differ, in the order of the first."""
    one, other = dict(_leaves(here)), dict(_leaves(there))
    both = {
        key_path: (one.get(key_path, "absent"), other.get(key_path, "absent"))
        for key_path in dict.fromkeys([*one, *other])
    }
    return {
        key_path.removeprefix("study."): (a, b)
        for key_path, (a, b) in both.items()
        if not (a == b or (a != a and b != b))
    }


def _leaves(described: Any, key_path: str = "") -> Iterator[tuple[str, Any]]:
    """Every number and text of a description, and its key path."""
    if isinstance(described, dict):
        for key, value in described.items():
            yield from _leaves(value, f"{key_path}.{key}" if key_path else str(key))
    elif isinstance(described, list):
        for k, value in enumerate(described):
            yield from _leaves(value, f"{key_path}[{k}]")
    else:
        yield key_path, described


def _plain(value: Any) -> Any:
    if isinstance(value, BeamModels):
        stated = value.stated
        return {"kind": "beam", **_plain({**stated._asdict(), "numbers": dict(stated.numbers)})}
    if isinstance(value, eqx.Module):
        fields = {f.name: _plain(getattr(value, f.name)) for f in dataclasses.fields(value)}
        return {"kind": getattr(value, "kind", type(value).__name__), **fields}
    if isinstance(value, tuple) and hasattr(value, "_asdict"):
        return {name: _plain(part) for name, part in value._asdict().items()}
    if isinstance(value, Mapping):
        return {str(key): _plain(part) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(part) for part in value]
    if isinstance(value, jax.Array | np.ndarray | np.generic):
        return _plain_array(np.asarray(value))
    if callable(value):
        return f"{value.__module__}.{value.__qualname__} {_source_hash(value)}"
    return value


def _plain_array(array: np.ndarray) -> Any:
    if array.size <= _LONGEST:
        return array.tolist() if array.dtype.kind != "c" else [str(z) for z in array.ravel()]
    digest = hashlib.sha256(np.ascontiguousarray(array).tobytes()).hexdigest()
    return f"{array.dtype} array of shape {array.shape}, {digest[:16]}"


def _source_hash(function: Any) -> str:
    return hashlib.sha256(inspect.getsource(function).encode()).hexdigest()[:16]
