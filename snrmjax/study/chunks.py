"""Chunks of a study on disk: each a file that is there whole, named by what is in it."""

import hashlib
import io
import json
import os
import re
import uuid
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from snrmjax.io.files import write_atomically

_NAME = re.compile(r"(\d{8})-([0-9a-f]{16})-([0-9a-f]{64})\.npz")
PLAN, CHUNKS = "plan.json", "chunks"


class StudyFolder(NamedTuple):
    """Where a study is kept: the data set `out`, and beside it the chunks it is made of."""

    out: Path

    @property
    def work(self) -> Path:
        """The folder of the plan and the chunks."""
        return self.out.with_name(f"{self.out.name}.parts")

    @property
    def chunks(self) -> Path:
        """The folder of the chunks."""
        return self.work / CHUNKS


class ChunkName(NamedTuple):
    """What the name of a chunk's file says of it."""

    number: int
    identity: str  # of the study and the chunk's place in it
    checksum: str  # of the file's bytes


class FoundChunks(NamedTuple):
    """Chunks that are there and whole, and the files that are not."""

    whole: dict[int, Path]
    damaged: tuple[Path, ...]
    foreign: tuple[Path, ...]


def chunk_identity(fingerprint: str, number: int) -> str:
    """What a chunk of this study at this place is known by."""
    return hashlib.sha256(f"{fingerprint} {number}".encode()).hexdigest()[:16]


def write_chunk(
    folder: StudyFolder, number: int, identity: str, rows: Mapping[str, np.ndarray]
) -> Path:
    """Write the rows of a chunk: to a temporary file, which takes its name when it is on disk.

    Raises `OSError` where it cannot be written; nothing is left behind then.
    """
    buffer = io.BytesIO()
    np.savez_compressed(buffer, allow_pickle=False, **rows)
    content = buffer.getvalue()
    name = f"{number:08d}-{identity}-{hashlib.sha256(content).hexdigest()}.npz"
    temporary, target = folder.chunks / f".{uuid.uuid4().hex}.tmp", folder.chunks / name
    try:
        with temporary.open("xb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, target)
    finally:
        temporary.unlink(missing_ok=True)
    return target


def read_chunk(path: Path) -> dict[str, np.ndarray]:
    """The rows of a chunk. Raises `ValueError` where the file is not what its name says."""
    content = path.read_bytes()
    known = _NAME.fullmatch(path.name)
    if known is None or hashlib.sha256(content).hexdigest() != known[3]:
        raise ValueError(f"{path.name} is damaged: its checksum differs.")
    with np.load(io.BytesIO(content), allow_pickle=False) as file:
        return {name: file[name] for name in file.files}


def found_chunks(folder: StudyFolder, fingerprint: str, n_chunks: int) -> FoundChunks:
    """Every chunk that is there, its checksum compared."""
    whole: dict[int, Path] = {}
    damaged, foreign = [], []
    for path in sorted(folder.chunks.glob("*.npz")):
        known = _NAME.fullmatch(path.name)
        number = int(known[1]) if known else -1
        ours = known is not None and known[2] == chunk_identity(fingerprint, number)
        if not ours or not 0 <= number < n_chunks:
            foreign.append(path)
        elif known is not None and hashlib.sha256(path.read_bytes()).hexdigest() != known[3]:
            damaged.append(path)
        else:
            whole[number] = path
    return FoundChunks(whole, tuple(damaged), tuple(foreign))


def write_study_plan(folder: StudyFolder, described: Mapping[str, object]) -> None:
    """Write what the study is beside its chunks, once."""
    folder.chunks.mkdir(parents=True, exist_ok=True)
    text = json.dumps(described, indent=1, sort_keys=True)
    write_atomically(folder.work / PLAN, text + "\n")


def read_study_plan(folder: StudyFolder) -> dict | None:
    """What the study that is kept there is; None where there is none.

    Raises `ValueError` where the plan cannot be read.
    """
    path = folder.work / PLAN
    if not path.exists():
        return None
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise ValueError(
            f"{path} is damaged: remove {folder.work} to compute the study anew."
        ) from error
    if not isinstance(found, dict):
        raise ValueError(f"{path} is no plan of a study.")
    return found


def remove_leftovers(folder: StudyFolder, found: FoundChunks) -> None:
    """Remove damaged and foreign files and temporary ones of writers that were stopped."""
    for path in (*found.damaged, *found.foreign, *folder.chunks.glob(".*.tmp")):
        path.unlink(missing_ok=True)
