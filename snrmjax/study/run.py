"""Run a study, or continue it after any stop, on this machine, in shards or on a cluster.

The plan is immutable, files are written atomically, and the data set is made of them at the end.
"""

import os
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from snrmjax.io.files import shown
from snrmjax.numerics.compiled import on_numbers
from snrmjax.numerics.rules import InputError
from snrmjax.study.execution import (
    Workers,
    available_cores,
    dask_cluster,
    local_processes,
    receipts,
)
from snrmjax.study.store import (
    StudyFolder,
    collect_chunks,
    description,
    differences,
    is_collected,
    read_study_plan,
    stored_description,
    whole_chunks,
    write_study_plan,
)
from snrmjax.study.study import Ensemble, Study

if TYPE_CHECKING:
    import xarray

_SHOWN = 3  # differences listed in an error


class Progress(NamedTuple):
    """Progress of a run."""

    members: int
    done: int
    failed: int
    seconds: float  # since this run began
    done_before: int  # members that were complete at the start

    @property
    def per_second(self) -> float:
        """Members computed per second."""
        return (self.done - self.done_before) / max(self.seconds, 1e-9)

    @property
    def seconds_left(self) -> float:
        """Remaining time at the present rate."""
        return (self.members - self.done) / max(self.per_second, 1e-9)


ProgressReport = Callable[[Progress], None]


class StudyRun(NamedTuple):
    """Summary of a run."""

    path: Path
    members: int
    failed: int  # members of this run without a result
    computed: int  # members of this run
    missing_chunks: int  # of other shards, still to be computed
    damaged_chunks: int  # computed again
    seconds: float

    @property
    def complete(self) -> bool:
        """Whether the data set exists."""
        return self.missing_chunks == 0

    def open(self) -> "xarray.Dataset":
        """The data set. Raises `ValueError` while chunks are missing."""
        return open_study(self.path)


def open_study(path: str | os.PathLike[str]) -> "xarray.Dataset":
    """The data set of a study, its arrays read on access.

    Returns an `xarray.Dataset` over `member` with the varied quantities as coordinates. Raises
    `ValueError` where there is none.
    """
    import xarray

    folder = StudyFolder(Path(path))
    if stored_description(folder) is None:
        state = "is not complete" if folder.work.exists() else "does not exist"
        raise InputError(f"the study {path} {state}: run it (again) first.")
    return xarray.open_zarr(path, chunks=None, consolidated=True)


@on_numbers("Derivatives by what varies: `sj.study.response_quantities`.")
def run_study(
    study: Study,
    out: str | os.PathLike[str],
    *,
    processes: int | None = None,
    scheduler: str | None = None,
    shard: tuple[int, int] = (1, 1),
    progress: ProgressReport | None = None,
    workers: Workers | None = None,
) -> StudyRun:
    """Compute a study and store it as one data set; the same call continues a stopped study.

    Chunks of members are computed by processes of this machine, each on one core, or by a Dask
    cluster, and kept in `out.parts`; the complete set becomes `out`, a Zarr store. Stopping loses
    only the chunks in progress. Results do not depend on the number of processes.

    Arguments: `out` is the folder of the data set; `processes` of this machine (None: one for each
    core) or the address of a running Dask `scheduler`; `shard` (i, n) computes the i-th of n parts;
    `progress` is called after each chunk; `workers` of your own replace processes.
    Returns a `StudyRun`. A member that fails is a row with its status.
    Raises `ValueError` before anything is written for a study that cannot be run, and for an `out`
    that holds another study, is in use by another process, or cannot be written; `ClusterGone`
    where the scheduler is lost: call again.
    Not differentiable: derivatives by what varies: `snrmjax.study.response_quantities`.
    """
    if processes is not None and processes < 1:
        raise InputError(f"`processes` must be at least 1, but is {processes}.")
    if processes is not None and scheduler is not None:
        raise InputError("`processes` are of this machine: a scheduler has its own.")
    if not 1 <= shard[0] <= shard[1]:
        raise InputError(f"a shard i/n needs i from 1 to n, but is {shard[0]}/{shard[1]}.")
    ensemble = study.ensemble()
    described = description(study)
    folder = StudyFolder(Path(os.path.abspath(out)))
    begin = time.perf_counter()
    if is_collected(folder, described):
        return StudyRun(folder.out, len(ensemble.table), 0, 0, 0, 0, 0.0)
    if workers is None and scheduler is not None:
        workers = dask_cluster(scheduler)  # fails before anything is written
    workers = workers or local_processes(min(processes or len(available_cores()), study.n_chunks))
    with closing(workers), _disk_errors(folder), _locked(folder, shard):
        _claim(folder, described)
        whole, damaged = whole_chunks(folder, study.n_chunks)
        for chunk in damaged:
            chunk.unlink()
        done = _computed(ensemble, folder, whole, workers, shard, progress)
        missing = study.n_chunks - len(whole_chunks(folder, study.n_chunks)[0])
        if not missing:
            collect_chunks(ensemble, folder, described)
    return StudyRun(
        folder.out,
        len(ensemble.table),
        done.failed,
        done.done - done.done_before,
        missing,
        len(damaged),
        time.perf_counter() - begin,
    )


def _computed(
    ensemble: Ensemble,
    folder: StudyFolder,
    whole: list[int],
    workers: Workers,
    shard: tuple[int, int],
    progress: ProgressReport | None,
) -> Progress:
    part, parts = shard
    before = sum(len(ensemble.rows_of(k)) for k in whole)
    missing = sorted({*range(part - 1, ensemble.study.n_chunks, parts)} - {*whole})
    state = Progress(len(ensemble.table), before, 0, 0.0, before)
    begin = time.perf_counter()
    for receipt in receipts(ensemble, folder, workers, missing):
        state = state._replace(
            done=state.done + receipt.members,
            failed=state.failed + receipt.failed,
            seconds=time.perf_counter() - begin,
        )
        if progress is not None:
            progress(state)
    return state


def _claim(folder: StudyFolder, described: dict) -> None:
    """Write the plan of this study into the folder, or check that it is the same."""
    known = read_study_plan(folder) or stored_description(folder)
    other = {} if known is None else differences(described, known)
    if other:
        each = [
            f"`{key}` is {shown(here)} here and {shown(there)} in the store"
            for key, (here, there) in list(other.items())[:_SHOWN]
        ]
        further = f" (and {len(other) - _SHOWN} more)" if len(other) > _SHOWN else ""
        raise InputError(
            f"{folder.out} holds another study: {'; '.join(each)}{further}. Choose another --out, "
            "or restore that study."
        )
    if not folder.plan.exists():
        write_study_plan(folder, described)


@contextmanager
def _locked(folder: StudyFolder, shard: tuple[int, int]) -> Iterator[None]:
    """Lock the study, or the shard of it, against other processes."""
    from filelock import FileLock, Timeout

    made = not folder.work.exists()
    name = ".lock" if shard == (1, 1) else ".lock-{}-of-{}".format(*shard)
    folder.work.mkdir(parents=True, exist_ok=True)
    try:
        lock = FileLock(folder.work / name, timeout=0).acquire()
    except Timeout as error:
        raise InputError(
            f"another process is at work on {folder.out}: wait until it ends."
        ) from error
    with lock:
        try:
            yield
        finally:
            if made and not folder.plan.exists():
                shutil.rmtree(folder.work, ignore_errors=True)


@contextmanager
def _disk_errors(folder: StudyFolder) -> Iterator[None]:
    """Report an error of the disk in one sentence."""
    try:
        yield
    except OSError as error:
        raise InputError(
            f"{folder.out} cannot be written: {error.strerror or error}. Completed chunks are "
            "kept; the same command continues."
        ) from error
