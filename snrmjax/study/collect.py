"""All chunks of a study as one labelled data set: a Zarr store that xarray opens."""

import hashlib
import json
import os
import shutil
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from snrmjax.io.files import write_atomically
from snrmjax.study.chunks import StudyFolder, read_chunk
from snrmjax.study.computations.base import MEMBER, TEXT, Output
from snrmjax.study.identity import fingerprint, model_hash
from snrmjax.study.study import FORCE, PlannedStudy

_BLOCK = 1 << 16  # rows of a ragged variable that are one file
_TARGET = 1 << 20  # numbers that one file of a member's variable holds at most
_COLLECTED = "collected.json"
_UNITS = {"natural_frequency": "rad/s", "frequency_hz": "Hz", FORCE: "N"}


def collect_chunks(
    planned: PlannedStudy,
    folder: StudyFolder,
    described: Mapping[str, Any],
    chunks: Mapping[int, Path],
) -> None:
    """Write the data set of all chunks; it appears whole or not at all.

    Memory is bounded by a few chunks. Raises `ValueError` for a chunk that is damaged and
    `OSError` on a full disk.
    """
    building = folder.work / "collecting.zarr"
    shutil.rmtree(building, ignore_errors=True)
    try:
        _write_store(planned, described, building, [chunks[k] for k in sorted(chunks)])
        checksums = _checksums(building)
        if folder.out.exists():
            shutil.rmtree(folder.out)
        os.replace(building, folder.out)
    finally:
        shutil.rmtree(building, ignore_errors=True)
    write_atomically(folder.work / _COLLECTED, json.dumps(checksums, indent=0, sort_keys=True))


def is_collected(folder: StudyFolder, described: Mapping[str, Any]) -> bool:
    """Whether the data set is there, of this study, and as it was written."""
    stored = stored_description(folder)
    if stored is None or fingerprint(stored) != fingerprint(described):
        return False
    known = folder.work / _COLLECTED
    if not known.exists():  # the chunks were cleared away: the data set stands alone
        return not folder.chunks.exists()
    try:
        return json.loads(known.read_text(encoding="utf-8")) == _checksums(folder.out)
    except ValueError:  # damaged: collecting again mends it
        return False


def stored_description(folder: StudyFolder) -> dict[str, Any] | None:
    """What the study of a data set is; None where there is none. Raises `ValueError` if foreign."""
    attributes = folder.out / ".zattrs"
    if not attributes.exists():
        return None
    try:
        found = json.loads(attributes.read_text(encoding="utf-8"))
        return json.loads(found["study"])
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(
            f"{folder.out} is no data set of a study: choose another --out."
        ) from error


def _checksums(store: Path) -> dict[str, str]:
    files = (path for path in sorted(store.rglob("*")) if path.is_file())
    return {
        path.relative_to(store).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in files
    }


def _write_store(
    planned: PlannedStudy, described: Mapping[str, Any], path: Path, chunks: list[Path]
) -> None:
    import zarr

    study = planned.study
    group = zarr.create_group(path, zarr_format=2)
    labels = _write_labels(group, planned)
    outputs = study.computation.outputs()
    sizes = {MEMBER: len(planned.table)}
    sizes |= {name: len(axis.values) for name, axis in study.computation.axes().items()}
    by_member = {name: one for name, one in outputs.items() if one.dimensions[0] == MEMBER}
    ragged = {name: one for name, one in outputs.items() if name not in by_member}
    widest, totals = _first_look(chunks, by_member, ragged)
    arrays = {}
    for name, one in by_member.items():
        shape = tuple(sizes[d] for d in one.dimensions)
        block = _member_block(study.chunk_size, shape[1:])
        arrays[name] = _Filled(group, name, one, shape, block, widest.get(name))
    for name, one in ragged.items():
        shape = (totals[one.dimensions[0]],)
        arrays[name] = _Filled(group, name, one, shape, _BLOCK, None)
    starts = {d: _first_rows(group, d, outputs[f"n_{d}s"], sizes, study.chunk_size) for d in totals}
    passed = dict.fromkeys(totals, 0)
    for chunk in chunks:
        rows = read_chunk(chunk)
        for name, array in arrays.items():
            array.append(rows[name])
        for dimension, start in starts.items():
            count = rows[f"n_{dimension}s"]
            ends = passed[dimension] + np.cumsum(count.ravel(), dtype=np.int64)
            start.append((ends - count.ravel()).reshape(count.shape))
            passed[dimension] = int(ends[-1]) if ends.size else passed[dimension]
    for array in (*arrays.values(), *starts.values()):
        array.finish()
    group.attrs.update(
        {
            "coordinates": " ".join(labels),
            "title": study.name,
            "computed": study.computation.kind,
            "study": json.dumps(described, sort_keys=True),
            "model_hash": model_hash(study),
            **{f"{name}_version": v for name, v in described["versions"].items()},
        }
    )
    zarr.consolidate_metadata(path, zarr_format=2)


def _first_look(
    chunks: Iterable[Path], by_member: Mapping[str, Output], ragged: Mapping[str, Output]
) -> tuple[dict[str, int], dict[str, int]]:
    """The longest text of every variable of text, and how many rows each ragged dimension has."""
    widest = {name: 1 for name, one in by_member.items() if one.kind == TEXT}
    totals = {one.dimensions[0]: 0 for one in ragged.values()}
    for chunk in chunks:
        rows = read_chunk(chunk)
        for name in widest:
            widest[name] = max(widest[name], rows[name].dtype.itemsize // 4)
        for dimension in totals:
            totals[dimension] += int(np.sum(rows[f"n_{dimension}s"]))
    return widest, totals


def _write_labels(group: Any, planned: PlannedStudy) -> list[str]:
    """Coordinates: the varied quantities, and the axes that all members share."""
    names = planned.study.names
    for k, name in enumerate(names):
        unit = next((u for end, u in _UNITS.items() if name.endswith(end)), "")
        _whole(group, name, planned.table[:, k], MEMBER, unit, "varied")
    for name, axis in planned.study.computation.axes().items():
        _whole(group, name, axis.values, name, axis.unit, axis.meaning)
    return list(names)


def _whole(
    group: Any, name: str, values: np.ndarray, dimension: str, unit: str, meaning: str
) -> None:
    one = Output((dimension,), "f8", unit, meaning)
    array = _Filled(group, name, one, values.shape, _BLOCK, None)
    array.append(values)
    array.finish()


def _first_rows(
    group: Any, dimension: str, count: Output, sizes: Mapping[str, int], chunk: int
) -> "_Filled":
    text = f"first row of the member along `{dimension}`; n_{dimension}s is how many"
    one = Output(count.dimensions, "i8", "1", text)
    shape = tuple(sizes[d] for d in count.dimensions)
    block = _member_block(chunk, shape[1:])
    return _Filled(group, f"first_{dimension}", one, shape, block, None)


def _member_block(chunk: int, further: tuple[int, ...]) -> int:
    """Members that one file of the data set holds: whole chunks of the study."""
    return chunk * max(_TARGET // (chunk * int(np.prod(further, dtype=int)) or 1), 1)


class _Filled:
    """An array of the store that is written from its beginning in whole blocks."""

    def __init__(
        self,
        group: Any,
        name: str,
        of: Output,
        shape: tuple[int, ...],
        block: int,
        text: int | None,
    ) -> None:
        from numcodecs import Zstd

        self.dtype = np.dtype(f"<U{text}" if text else of.kind)
        blocks = (max(min(block, shape[0]), 1), *(max(n, 1) for n in shape[1:]))
        self.array = group.create_array(
            name,
            shape=shape,
            chunks=blocks,
            dtype=self.dtype,
            # With a checksum: a file that is damaged is not read as numbers.
            compressors=Zstd(level=3, checksum=True),
            fill_value=np.nan if of.kind == "f8" else None,
            attributes={
                "_ARRAY_DIMENSIONS": list(of.dimensions),
                "long_name": of.meaning,
                **({"units": of.unit} if of.unit else {}),
            },
        )
        self.block, self.written, self.waiting = blocks[0], 0, [np.zeros((0, *shape[1:]))]

    def append(self, rows: np.ndarray) -> None:
        """Further rows; whole blocks of them go to the disk."""
        self.waiting.append(rows)
        if sum(len(part) for part in self.waiting) >= self.block:
            ready = np.concatenate([part for part in self.waiting if len(part)])
            whole = len(ready) // self.block * self.block
            self._write(ready[:whole])
            self.waiting = [ready[whole:]]

    def finish(self) -> None:
        """The rows that are left."""
        parts = [part for part in self.waiting if len(part)]
        if parts:
            self._write(np.concatenate(parts))

    def _write(self, rows: np.ndarray) -> None:
        end = self.written + len(rows)
        self.array[self.written : end] = rows.astype(self.dtype)
        self.written = end
