"""Compute the chunks of a study in processes that may die: local ones, or a Dask cluster's."""

import copyreg
import importlib
import os
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    CancelledError,
    Executor,
    Future,
    wait,
)
from multiprocessing.util import Finalize
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import jax
import numpy as np
from threadpoolctl import threadpool_limits

import snrmjax.model
from snrmjax.io.programs.compilation_cache import WORTH_KEEPING, default_cache_folder
from snrmjax.io.programs.effect_files import load_effects, loaded_effects
from snrmjax.numerics.rules import InputError
from snrmjax.study.computations.base import COMPLETE, Failure, MemberStatus, joined, with_refused
from snrmjax.study.store import StudyFolder, write_chunk
from snrmjax.study.study import Ensemble

LOST = Failure(MemberStatus.LOST, "the process that computed it died")

_DEATHS_IN_PARALLEL = 2  # of a chunk's worker before the chunk is computed alone
_TRIES_OF_ONE = 3  # of a single member in a process, before it is stored as lost
_PATIENCE = "10s"  # time-out for the scheduler's answer
_ONE_THREAD = {
    # Workers share the cores, and results must not depend on the number of threads.
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false",
}

# lazy-loader 0.6 gives modules its own class, which pickle does not recognise as a module: without
# this a user's function that refers to this package could not be sent to a worker.
if type(snrmjax.model) is not ModuleType:
    copyreg.pickle(
        type(snrmjax.model), lambda module: (importlib.import_module, (module.__name__,))
    )


class WorkerDied(Exception):
    """The process of a task has died."""


class ClusterGone(Exception):
    """The cluster's scheduler cannot be reached."""


class Workers:
    """An executor that is started on demand, and restarted after one of its processes died.

    Arguments: `start` makes the executor; `width` is its number of parallel tasks; `stop` ends it;
    the errors `died` mean that a task's process has died, `gone` that the cluster is lost.
    """

    def __init__(
        self,
        start: Callable[[], Executor],
        width: int,
        stop: Callable[[Any], None],
        died: tuple[type[Exception], ...] = (),
        gone: tuple[type[Exception], ...] = (),
    ) -> None:
        self.width = width
        self._start, self._stop, self._died, self._gone = start, stop, died, gone
        self._executor: Executor | None = None

    def submit(self, function: Callable[..., Any], *arguments: Any) -> Future:
        """Start a task. Raises `ClusterGone`."""
        if self._executor is None:
            self._executor = self._start()
        lost: tuple[type[Exception], ...] = (OSError, *self._gone)
        try:
            return self._executor.submit(function, *arguments)
        except lost as error:
            raise ClusterGone("the Dask scheduler is gone") from error

    def result(self, future: Future) -> Any:
        """The result of a task. Raises `WorkerDied`, `ClusterGone` or the task's own error."""
        try:
            return future.result()
        except BrokenExecutor as error:
            self.close()  # loky ends all processes after one death: the next task starts new ones
            raise WorkerDied(str(error)) from error
        except self._died as error:
            raise WorkerDied(str(error)) from error
        except self._gone as error:
            raise ClusterGone("the Dask scheduler is gone") from error

    def close(self) -> None:
        """Stop the processes, or leave the cluster."""
        if self._executor is not None:
            self._stop(self._executor)
            self._executor = None


def local_processes(processes: int) -> Workers:
    """Processes of this machine, each on its own core (loky: spawned, not forked)."""

    def start() -> Executor:
        from loky import ProcessPoolExecutor
        from loky.backend import get_context

        context = get_context("loky")
        # A queue without a feeder thread, which would still hold its locks when this process ends.
        queue, cores = context.SimpleQueue(), available_cores()
        for k in range(processes):
            queue.put(cores[k % len(cores)])
        # All processes use the same cache of compiled programs.
        cache = jax.config.values["jax_compilation_cache_dir"] or default_cache_folder()
        kept = {
            "JAX_COMPILATION_CACHE_DIR": str(cache),
            "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": str(WORTH_KEEPING),
        }
        return ProcessPoolExecutor(
            processes,
            context=context,
            initializer=settle,
            initargs=(os.getpid(), queue, tuple(loaded_effects())),
            timeout=None,
            # Each process would allocate most of a GPU's memory, and responses are slow on a GPU.
            env={"JAX_PLATFORMS": "cpu", **_ONE_THREAD, **kept},
        )

    return Workers(start, processes, lambda pool: pool.shutdown(wait=True, kill_workers=True))


def dask_cluster(address: str) -> Workers:
    """The workers of a running Dask scheduler, such as that at tcp://node1:8786.

    Raises `ValueError` without the package distributed, where no scheduler answers, and with
    effects of a file, which its workers do not load.
    """
    if loaded_effects():
        raise InputError(
            "a Dask cluster's workers do not load the files of `--effects`: run the study by "
            "shards, or make your effects a package that every worker imports."
        )
    try:
        import distributed
    except ImportError as error:
        raise InputError(
            "a Dask cluster needs the package distributed: pip install 'snrmjax[cluster]'."
        ) from error
    try:
        client = distributed.Client(address, timeout=_PATIENCE, set_as_default=False)
    except (OSError, TimeoutError, ValueError) as error:
        raise InputError(f"no Dask scheduler answers at {address}.") from error
    client_errors = (distributed.comm.CommClosedError, distributed.client.FutureCancelledError)
    return Workers(
        lambda: client.get_executor(pure=False),
        max(
            2 * sum(client.nthreads().values()), 2
        ),  # two tasks per thread, so that no thread is idle
        lambda executor: client.close(timeout=2),
        died=(distributed.KilledWorker,),
        gone=(CancelledError, *client_errors),
    )


def settle(parent: int, cores: Any, effects: Sequence[Path] = ()) -> None:
    """Initialise a worker: end it with its parent process, pin it to one core, load effects.

    Arguments: `parent` is the parent's process id, `cores` a queue with a core for every worker,
    to which a worker's core returns when it ends (loky replaces workers whose memory has grown);
    `effects` are files with user-defined effects.
    """

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(0.2)
        os._exit(1)

    # Before `cores.get`, which would wait for ever if the parent is killed now.
    threading.Thread(target=watch, daemon=True).start()
    core = cores.get()
    Finalize(None, cores.put, (core,), exitpriority=0)
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {core})
    for file in effects:
        load_effects(file)


def available_cores() -> list[int]:
    """Cores available to this process."""
    if hasattr(os, "sched_getaffinity"):
        return sorted(os.sched_getaffinity(0))
    return list(range(os.cpu_count() or 1))


class Receipt(NamedTuple):
    """Summary of a written chunk."""

    members: int
    failed: int


def computed_rows(ensemble: Ensemble, numbers: range) -> dict[str, np.ndarray]:
    """The result rows of some members."""
    os.environ.update({k: v for k, v in _ONE_THREAD.items() if k not in os.environ})
    with threadpool_limits(limits=1, user_api="blas"):
        return ensemble.rows(numbers)


def compute_chunk(ensemble: Ensemble, folder: StudyFolder, number: int) -> Receipt:
    """Compute a chunk and write it; returns its receipt. Raises `OSError` on a full disk."""
    return _stored(folder, number, computed_rows(ensemble, ensemble.rows_of(number)))


def _stored(folder: StudyFolder, number: int, rows: dict[str, np.ndarray]) -> Receipt:
    write_chunk(folder, number, rows)
    status = np.asarray(rows["status"])
    whole = np.isin(status, COMPLETE).reshape(len(status), -1).all(axis=1)
    return Receipt(len(status), int(np.sum(~whole)))


def receipts(
    ensemble: Ensemble, folder: StudyFolder, workers: Workers, numbers: Sequence[int]
) -> Iterator[Receipt]:
    """Compute chunks and yield their receipts in the order of completion.

    The first chunk is computed alone: it compiles for the others. A chunk whose process died twice
    in parallel is computed alone; if it dies again, its members are computed singly, and a member
    that keeps killing its process is stored as lost. Raises a task's own error.
    """
    pending, alone = deque(numbers), deque[int]()
    deaths: Counter[int] = Counter()
    if pending:
        yield _singly(ensemble, folder, workers, pending.popleft())
    running: dict[Future, int] = {}
    while pending or running:
        while pending and len(running) < workers.width:
            number = pending.popleft()
            running[workers.submit(compute_chunk, ensemble, folder, number)] = number
        for future in wait(running, return_when=FIRST_COMPLETED).done:
            number = running.pop(future)
            try:
                yield workers.result(future)
            except WorkerDied:
                deaths[number] += 1
                (pending if deaths[number] < _DEATHS_IN_PARALLEL else alone).append(number)
    for number in alone:
        yield _singly(ensemble, folder, workers, number)


def _singly(ensemble: Ensemble, folder: StudyFolder, workers: Workers, number: int) -> Receipt:
    """A chunk computed alone, or its members singly if its process dies."""
    try:
        return workers.result(workers.submit(compute_chunk, ensemble, folder, number))
    except WorkerDied:
        return _stored(folder, number, _rescued(ensemble, workers, ensemble.rows_of(number)))


def _rescued(ensemble: Ensemble, workers: Workers, numbers: range) -> dict[str, np.ndarray]:
    """Rows of members by bisection; a member that kills its process has only a status."""
    for _ in range(1 if len(numbers) > 1 else _TRIES_OF_ONE):
        try:
            return workers.result(workers.submit(computed_rows, ensemble, numbers))
        except WorkerDied:
            continue
    if len(numbers) > 1:
        middle = len(numbers) // 2
        halves = numbers[:middle], numbers[middle:]
        return joined([_rescued(ensemble, workers, half) for half in halves])
    return with_refused(ensemble.study.computation, None, {0: LOST})
