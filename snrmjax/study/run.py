"""A study from its plan to its data set: run, continued after any stop, in shards or on a cluster.

An immutable plan, files that appear whole, and a data set made of them at the end.
"""

import os
import shutil
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from snrmjax.study.compute import Progress, ProgressReport, receipts
from snrmjax.study.identity import description, differences
from snrmjax.study.store import (
    StudyFolder,
    collect_chunks,
    is_collected,
    read_study_plan,
    stored_description,
    whole_chunks,
    write_study_plan,
)
from snrmjax.study.study import PlannedStudy, Study, planned
from snrmjax.study.workers import (
    AbstractWorkers,
    DaskCluster,
    LocalProcesses,
    available_cores,
)

if TYPE_CHECKING:
    import xarray

_SHOWN = 3  # differences that a refusal lists


class Shard(NamedTuple):
    """One of several parts of a study that are computed apart: the `part`-th of `parts`."""

    part: int  # from 1
    parts: int


class StudyRun(NamedTuple):
    """How a run ended."""

    path: Path
    members: int
    failed: int  # members without a result, of those that this run computed
    computed: int  # members that this run computed
    missing_chunks: int  # that other shards have still to compute
    damaged_chunks: int  # that were found and computed again
    seconds: float

    @property
    def complete(self) -> bool:
        """Whether the data set is there."""
        return self.missing_chunks == 0

    def open(self) -> "xarray.Dataset":
        """The data set. Raises `ValueError` while chunks are missing."""
        return open_study(self.path)


class RunSettings(NamedTuple):
    """Who computes a study, and whom to tell how it stands."""

    processes: int | None = None  # None: one for each core
    scheduler: str | None = None  # address of a running Dask scheduler
    shard: Shard | None = None
    progress: ProgressReport | None = None  # called after each chunk
    workers: AbstractWorkers | None = None  # your own, in place of processes or a scheduler


HERE = RunSettings()


def open_study(path: str | os.PathLike[str]) -> "xarray.Dataset":
    """The data set of a study, its arrays read as they are used.

    Returns an `xarray.Dataset` over `member` with the varied quantities as coordinates. Raises
    `ValueError` where there is none.
    """
    import xarray

    folder = StudyFolder(Path(path))
    if stored_description(folder) is None:
        state = "is not complete" if folder.work.exists() else "does not exist"
        raise ValueError(f"the study {path} {state}: run it (again) first.")
    return xarray.open_zarr(path, chunks=None, consolidated=True)


def run_study(study: Study, out: str | os.PathLike[str], settings: RunSettings = HERE) -> StudyRun:
    """Compute a study and store it as one data set; the same call continues what was stopped.

    Chunks of members are computed by processes of this machine, each on one core, or by a Dask
    cluster, and kept beside `out` in `out.parts`; when all are there they become `out`, a Zarr
    store. Stopping at any moment loses chunks in flight only. Digits do not depend on how many
    processes there are.

    Arguments: `out` is the folder of the data set.
    Returns a `StudyRun`. A member that fails is a row with its status.
    Raises `ValueError` before anything is written for a study that cannot be run, and for an `out`
    that has another study, that another process is at work on, or that cannot be written;
    `ClusterGone` where the scheduler ends: call again.
    """
    plan = planned(study)
    described = description(study)
    folder = StudyFolder(Path(os.path.abspath(out)))
    _check_settings(settings)
    begin = time.perf_counter()
    if is_collected(folder, described):
        return StudyRun(folder.out, len(plan.table), 0, 0, 0, 0, 0.0)
    workers = _workers(settings, study.n_chunks)  # a cluster that is not there leaves nothing
    with closing(workers), _words_for_disk(folder), _locked(folder, settings.shard):
        _claim(folder, described)
        whole, damaged = whole_chunks(folder, study.n_chunks)
        for chunk in damaged:
            chunk.unlink()
        done = _computed(plan, folder, whole, settings, workers)
        missing = study.n_chunks - len(whole_chunks(folder, study.n_chunks)[0])
        if not missing:
            collect_chunks(plan, folder, described)
    return StudyRun(
        folder.out,
        *(len(plan.table), done.failed, done.done - done.done_before),
        *(missing, len(damaged), time.perf_counter() - begin),
    )


def _computed(
    plan: PlannedStudy,
    folder: StudyFolder,
    whole: list[int],
    settings: RunSettings,
    workers: AbstractWorkers,
) -> Progress:
    part, parts = settings.shard or (1, 1)
    before = sum(len(plan.rows_of(k)) for k in whole)
    missing = sorted({*range(part - 1, plan.study.n_chunks, parts)} - {*whole})
    state = Progress(len(plan.table), before, 0, 0.0, before)
    begin = time.perf_counter()
    for receipt in receipts(plan, folder, workers, missing):
        state = state.with_receipt(receipt, time.perf_counter() - begin)
        if settings.progress is not None:
            settings.progress(state)
    return state


def _workers(settings: RunSettings, n_chunks: int) -> AbstractWorkers:
    if settings.workers is not None:
        return settings.workers
    if settings.scheduler is not None:
        return DaskCluster(settings.scheduler)
    return LocalProcesses(min(settings.processes or len(available_cores()), n_chunks))


def _check_settings(settings: RunSettings) -> None:
    if settings.processes is not None and settings.processes < 1:
        raise ValueError(f"`processes` must be at least 1, but is {settings.processes}.")
    if settings.processes is not None and settings.scheduler is not None:
        raise ValueError("`processes` are of this machine: a scheduler has its own.")
    if settings.shard is not None and not 1 <= settings.shard.part <= settings.shard.parts:
        raise ValueError(
            f"a shard i/n needs i from 1 to n, but is {settings.shard.part}/{settings.shard.parts}."
        )


def _claim(folder: StudyFolder, described: dict) -> None:
    """Make the folder this study's, or see that it is."""
    known = read_study_plan(folder) or stored_description(folder)
    found = [] if known is None else differences(described, known)
    if found:
        further = f" (and {len(found) - _SHOWN} more)" if len(found) > _SHOWN else ""
        listed = "; ".join(str(one) for one in found[:_SHOWN])
        raise ValueError(
            f"{folder.out} has another study: {listed}{further}. Take another --out, or go back to "
            "that study."
        )
    if not folder.plan.exists():
        write_study_plan(folder, described)


@contextmanager
def _locked(folder: StudyFolder, shard: Shard | None) -> Iterator[None]:
    """Nobody else at work on the same study, or the same shard of it."""
    from filelock import FileLock, Timeout

    made = not folder.work.exists()
    name = ".lock" if shard is None else f".lock-{shard.part}-of-{shard.parts}"
    folder.work.mkdir(parents=True, exist_ok=True)
    try:
        lock = FileLock(folder.work / name, timeout=0).acquire()
    except Timeout as error:
        raise ValueError(
            f"another process is at work on {folder.out}: wait until it ends."
        ) from error
    with lock:
        try:
            yield
        finally:
            if made and not folder.plan.exists():
                shutil.rmtree(folder.work, ignore_errors=True)


@contextmanager
def _words_for_disk(folder: StudyFolder) -> Iterator[None]:
    """An error of the disk in one sentence."""
    try:
        yield
    except OSError as error:
        raise ValueError(
            f"{folder.out} cannot be written: {error.strerror or error}. What is done stays; the "
            "same command continues."
        ) from error
