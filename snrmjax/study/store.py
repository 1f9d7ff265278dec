"""A study on disk: its plan, the chunks of its members, and the data set that is made of them.

Next to the data set `study.zarr` is `study.zarr.parts` with `plan.json`, the description of the
study, and one file per chunk. Every file is renamed to its final name when complete. The
description identifies the study, and differences from another one are listed.
"""

import dataclasses
import hashlib
import importlib.metadata
import inspect
import json
import os
import shutil
import uuid
import zipfile
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np

from snrmjax import __version__
from snrmjax.condense.beam_models import BeamModels
from snrmjax.io.files import write_atomically
from snrmjax.io.programs.effect_files import loaded_effects
from snrmjax.numerics.rules import InputError
from snrmjax.study.computations.base import MEMBER, TEXT, Output, joined
from snrmjax.study.study import FORCE, Ensemble, Study

_LONGEST = (
    64  # entries of an array that are written out; longer arrays are identified by their hash
)
_PACKAGES = ("jax", "jaxlib", "numpy")
_BLOCK = 1 << 16  # rows of a ragged variable per file
_TARGET = 1 << 20  # most numbers of a member's variable per file
_TOGETHER = 1 << 25  # bytes of chunks written at once
_DIGEST = "collected.txt"
_UNITS = {"natural_frequency": "rad/s", "frequency_hz": "Hz", FORCE: "N"}


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


class StudyFolder(NamedTuple):
    """Folder of a study: the data set `out`, and next to it its chunks."""

    out: Path

    @property
    def work(self) -> Path:
        """The folder of the plan and the chunks."""
        return self.out.with_name(f"{self.out.name}.parts")

    @property
    def plan(self) -> Path:
        """The file with the description of the study."""
        return self.work / "plan.json"

    @property
    def chunks(self) -> Path:
        """The folder of the chunks."""
        return self.work / "chunks"

    def chunk(self, number: int) -> Path:
        """The file of a chunk."""
        return self.chunks / f"{number:08d}.npz"


def write_study_plan(folder: StudyFolder, described: Mapping[str, object]) -> None:
    """Write the description of the study next to its chunks."""
    folder.chunks.mkdir(parents=True, exist_ok=True)
    write_atomically(folder.plan, json.dumps(described, indent=1, sort_keys=True) + "\n")


def read_study_plan(folder: StudyFolder) -> dict[str, Any] | None:
    """The description of the study in a folder; None where there is none.

    Raises `ValueError` where the plan cannot be read.
    """
    if not folder.plan.exists():
        return None
    try:
        return dict(json.loads(folder.plan.read_text(encoding="utf-8")))
    except (ValueError, TypeError) as error:
        raise InputError(
            f"{folder.plan} is damaged: remove {folder.work} to compute the study anew."
        ) from error


def write_chunk(folder: StudyFolder, number: int, rows: Mapping[str, np.ndarray]) -> None:
    """Write the rows of a chunk.

    Raises `OSError` where it cannot be written, without leaving a file.
    """
    temporary = folder.chunks / f".{uuid.uuid4().hex}.tmp"
    try:
        with temporary.open("wb") as file:
            np.savez_compressed(file, allow_pickle=False, **rows)
        os.replace(temporary, folder.chunk(number))
    finally:
        temporary.unlink(missing_ok=True)


def whole_chunks(folder: StudyFolder, n_chunks: int) -> tuple[list[int], list[Path]]:
    """Numbers of the complete chunks, and damaged files."""
    numbers = [k for k in range(n_chunks) if folder.chunk(k).exists()]
    damaged = [k for k in numbers if not _is_whole(folder.chunk(k))]
    return sorted({*numbers} - {*damaged}), [folder.chunk(k) for k in damaged]


def _is_whole(chunk: Path) -> bool:
    try:
        with zipfile.ZipFile(chunk) as parts:
            return parts.testzip() is None
    except (OSError, EOFError, NotImplementedError, zipfile.BadZipFile, zlib.error):
        return False


def _read_chunk(path: Path) -> dict[str, np.ndarray]:
    with np.load(path, allow_pickle=False) as file:
        return dict(file)


def stored_description(folder: StudyFolder) -> dict[str, Any] | None:
    """The description of a data set's study, or None. Raises `ValueError` for other data."""
    if not folder.out.exists():
        return None
    try:
        attributes = json.loads((folder.out / ".zattrs").read_text(encoding="utf-8"))
        return dict(json.loads(attributes["study"]))
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(
            f"{folder.out} is no data set of a study: choose another --out."
        ) from error


def is_collected(folder: StudyFolder, described: Mapping[str, Any]) -> bool:
    """Whether the data set exists, belongs to this study and is unchanged."""
    stored = stored_description(folder)
    if stored is None or differences(described, stored):
        return False
    known = folder.work / _DIGEST
    if not known.exists():  # the parts were removed: only the data set is left
        return not folder.chunks.exists()
    return known.read_text(encoding="utf-8") == _digest(folder.out)


def collect_chunks(ensemble: Ensemble, folder: StudyFolder, described: Mapping[str, Any]) -> None:
    """Write the data set of all chunks, atomically.

    Memory is bounded by a few chunks. Raises `OSError` on a full disk.
    """
    from filelock import FileLock

    building = folder.work / "collecting.zarr"
    with FileLock(folder.work / ".collecting"):  # of simultaneous shards only one collects
        if is_collected(folder, described):
            return
        shutil.rmtree(building, ignore_errors=True)
        try:
            _write_store(ensemble, described, building, folder)
            digest = _digest(building)
            if folder.out.exists():
                shutil.rmtree(folder.out)
            os.replace(building, folder.out)
        finally:
            shutil.rmtree(building, ignore_errors=True)
        write_atomically(folder.work / _DIGEST, digest)
    for leftover in folder.chunks.glob(".*.tmp"):  # of stopped writers
        leftover.unlink(missing_ok=True)


def _digest(store: Path) -> str:
    """Hash of the files of a data set."""
    digest = hashlib.sha256()
    for path in sorted(path for path in store.rglob("*") if path.is_file()):
        digest.update(path.relative_to(store).as_posix().encode() + path.read_bytes())
    return digest.hexdigest()


def _write_store(
    ensemble: Ensemble, described: Mapping[str, Any], path: Path, folder: StudyFolder
) -> None:
    import zarr

    study = ensemble.study
    group = zarr.create_group(path, zarr_format=2)
    _write_labels(group, ensemble)
    axes = study.computation.axes()
    sizes = {MEMBER: len(ensemble.table), **{name: len(axis.values) for name, axis in axes.items()}}
    sensor = study.reported_sensor
    outputs = {
        name: one._replace(meaning=f"{one.meaning}, at {sensor}") if one.at_sensor else one
        for name, one in study.computation.outputs().items()
    }
    ragged = {output.dimensions[0] for output in outputs.values()} - {MEMBER}
    for dimension in ragged:
        text = f"first row of the member along `{dimension}`; n_{dimension}s is how many"
        counted = outputs[f"n_{dimension}s"].dimensions
        outputs[f"first_{dimension}"] = Output(counted, "i8", "1", text)
    chunks = [folder.chunk(k) for k in range(study.n_chunks)]
    widest, totals = _widths_and_totals(chunks, outputs, ragged)
    arrays = {}
    for name, one in outputs.items():
        shape = tuple({**sizes, **totals}[d] for d in one.dimensions)
        dtype = f"<U{widest[name]}" if one.kind == TEXT else one.kind
        block = _BLOCK if one.dimensions[0] in ragged else _member_block(study.chunk_size, shape)
        arrays[name] = _array(group, name, one, shape, dtype, block)
    start = dict.fromkeys((MEMBER, *ragged), 0)
    for rows in _together(chunks):
        for dimension in ragged:
            count = rows[f"n_{dimension}s"]
            ends = start[dimension] + np.cumsum(count.ravel(), dtype=np.int64)
            rows[f"first_{dimension}"] = ends.reshape(count.shape) - count
        written = {}
        for name, array in arrays.items():
            dimension = outputs[name].dimensions[0]
            written[dimension] = start[dimension] + len(rows[name])
            array[start[dimension] : written[dimension]] = rows[name].astype(array.dtype)
        start = written
    group.attrs.update(
        {
            "coordinates": " ".join(study.names),
            "title": study.name,
            "computed": study.computation.kind,
            **({} if sensor is None else {"sensor": sensor}),
            "study": json.dumps(described, sort_keys=True),
            **{f"{name}_version": v for name, v in described["versions"].items()},
        }
    )
    zarr.consolidate_metadata(path, zarr_format=2)


def _widths_and_totals(
    chunks: Iterable[Path], outputs: Mapping[str, Output], ragged: Iterable[str]
) -> tuple[dict[str, int], dict[str, int]]:
    """Longest text of every text variable, and number of rows of each ragged dimension."""
    widest = {name: 1 for name, one in outputs.items() if one.kind == TEXT}
    totals = dict.fromkeys(ragged, 0)
    for chunk in chunks:
        with np.load(chunk, allow_pickle=False) as rows:
            for name in widest:
                widest[name] = max(widest[name], rows[name].dtype.itemsize // 4)
            for dimension in totals:
                totals[dimension] += int(np.sum(rows[f"n_{dimension}s"]))
    return widest, totals


def _together(chunks: Iterable[Path]) -> Iterator[dict[str, np.ndarray]]:
    """The rows of the chunks in order, several small chunks at once."""
    waiting: list[dict[str, np.ndarray]] = []
    for chunk in chunks:
        waiting.append(_read_chunk(chunk))
        if sum(part.nbytes for rows in waiting for part in rows.values()) > _TOGETHER:
            yield joined(waiting)
            waiting = []
    if waiting:
        yield joined(waiting)


def _write_labels(group: Any, ensemble: Ensemble) -> None:
    """Coordinates: the varied quantities, and the axes common to all members."""
    labels = {}
    for name, column in zip(ensemble.study.names, ensemble.table.T, strict=True):
        unit = next((u for end, u in _UNITS.items() if name.endswith(end)), "")
        labels[name] = (column, Output((MEMBER,), "f8", unit, "varied"))
    for name, axis in ensemble.study.computation.axes().items():
        labels[name] = (axis.values, Output((name,), "f8", axis.unit, axis.meaning))
    for name, (values, one) in labels.items():
        _array(group, name, one, values.shape, "f8", _BLOCK)[:] = values


def _member_block(chunk: int, shape: Sequence[int]) -> int:
    """Members per file of the data set: a multiple of the study's chunk."""
    return chunk * max(_TARGET // (chunk * int(np.prod(shape[1:], dtype=int)) or 1), 1)


def _array(
    group: Any, name: str, one: Output, shape: tuple[int, ...], dtype: str, block: int
) -> Any:
    from numcodecs import Zstd

    return group.create_array(
        name,
        shape=shape,
        chunks=(max(min(block, shape[0]), 1), *(max(n, 1) for n in shape[1:])),
        dtype=np.dtype(dtype),
        # The checksum detects damaged files.
        compressors=Zstd(level=3, checksum=True),
        fill_value=np.nan if one.kind == "f8" else None,
        attributes={
            "_ARRAY_DIMENSIONS": list(one.dimensions),
            "long_name": one.meaning,
            **({"units": one.unit} if one.unit else {}),
        },
    )
