"""Computes the chunks of a study in processes that may die: local ones, or a Dask cluster's."""

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
from snrmjax.study.computations.base import COMPLETE, Failure, MemberStatus, joined, with_refused
from snrmjax.study.store import StudyFolder, write_chunk
from snrmjax.study.study import Ensemble

LOST = Failure(MemberStatus.LOST, "the process that computed it died")

_DEATHS_BESIDE = 2  # of a chunk's worker, before the chunk is computed alone
_TRIES_OF_ONE = 3  # of a member alone in a process, before it is given up
_PATIENCE = "10s"  # with a scheduler that does not answer
_ONE_THREAD = {
    # Workers share the cores, and digits must not depend on how many there are.
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false",
}

# lazy-loader 0.6 gives modules a class of its own, which pickles do not take for one of modules: a
# user's function that names this package would not reach a worker.
if type(snrmjax.model) is not ModuleType:
    copyreg.pickle(
        type(snrmjax.model), lambda module: (importlib.import_module, (module.__name__,))
    )


class WorkerDied(Exception):
    """The process that computed something is gone."""


class ClusterGone(Exception):
    """The cluster's scheduler cannot be reached, or is gone."""


class Workers:
    """An executor that is started when it is needed, and anew after one of its processes died.

    Arguments: `start` makes the executor; `width` is how many tasks it takes at a time; `stop` ends
    it; of errors, `died` say that a task's process is gone, `gone` that the whole cluster is.
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
        """What a task returned. Raises `WorkerDied`, `ClusterGone` or what the task raised."""
        try:
            return future.result()
        except BrokenExecutor as error:
            self.close()  # one death ends them all: the next task starts new ones
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
    """Processes of this machine, each on a core of its own (loky: started anew, not forked)."""

    def start() -> Executor:
        from loky import ProcessPoolExecutor
        from loky.backend import get_context

        context = get_context("loky")
        # Without a thread of its own, which would still hold its locks when this process ends.
        queue, cores = context.SimpleQueue(), available_cores()
        for k in range(processes):
            queue.put(cores[k % len(cores)])
        # Compiled programs are kept where all of them find them.
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
            # Each would take most of an accelerator's memory, on which responses are slow.
            env={"JAX_PLATFORMS": "cpu", **_ONE_THREAD, **kept},
        )

    return Workers(start, processes, lambda pool: pool.shutdown(wait=True, kill_workers=True))


def dask_cluster(address: str) -> Workers:
    """The workers of a running Dask scheduler, such as that at tcp://node1:8786.

    Raises `ValueError` without the package distributed, where nothing answers there, and with
    effects of a file, which its workers do not load.
    """
    if loaded_effects():
        raise ValueError(
            "a Dask cluster's workers do not load the files of `--effects`: run the study by "
            "shards, or make your effects a package that every worker imports."
        )
    try:
        import distributed
    except ImportError as error:
        raise ValueError(
            "a Dask cluster needs the package distributed: pip install 'snrmjax[cluster]'."
        ) from error
    try:
        client = distributed.Client(address, timeout=_PATIENCE, set_as_default=False)
    except (OSError, TimeoutError, ValueError) as error:
        raise ValueError(f"no Dask scheduler answers at {address}.") from error
    client_errors = (distributed.comm.CommClosedError, distributed.client.FutureCancelledError)
    return Workers(
        lambda: client.get_executor(pure=False),
        max(2 * sum(client.nthreads().values()), 2),  # two tasks a thread, so that none waits
        lambda executor: client.close(timeout=2),
        died=(distributed.KilledWorker,),
        gone=(CancelledError, *client_errors),
    )


def settle(parent: int, cores: Any, effects: Sequence[Path] = ()) -> None:
    """Before the first chunk: end with the process that started this one, and stay on one core.

    Arguments: `parent` is that process's number, `cores` a queue with a core for every worker,
    to which this one's goes back when it ends: loky exchanges a worker that has grown for a new
    one; `effects` are files with a user's own effects, which are loaded here too.
    """

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(0.2)
        os._exit(1)

    # First of all: a parent that is killed now leaves nobody who would fill the queue.
    threading.Thread(target=watch, daemon=True).start()
    core = cores.get()
    Finalize(None, cores.put, (core,), exitpriority=0)
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {core})
    for file in effects:
        load_effects(file)


def available_cores() -> list[int]:
    """The cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return sorted(os.sched_getaffinity(0))
    return list(range(os.cpu_count() or 1))


class Receipt(NamedTuple):
    """What is known of a chunk that was written."""

    members: int
    failed: int


def computed_rows(ensemble: Ensemble, numbers: range) -> dict[str, np.ndarray]:
    """The rows of some members."""
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
    """Compute chunks and give their receipts in the order in which they are done.

    The first chunk goes alone: it compiles for the others. A chunk whose process died twice beside
    others is computed alone; if it dies there too, its members are, and one that keeps killing its
    process is stored as lost. Raises what a task raised.
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
                (pending if deaths[number] < _DEATHS_BESIDE else alone).append(number)
    for number in alone:
        yield _singly(ensemble, folder, workers, number)


def _singly(ensemble: Ensemble, folder: StudyFolder, workers: Workers, number: int) -> Receipt:
    """A chunk alone in the workers, and where its process dies its members."""
    try:
        return workers.result(workers.submit(compute_chunk, ensemble, folder, number))
    except WorkerDied:
        return _stored(folder, number, _rescued(ensemble, workers, ensemble.rows_of(number)))


def _rescued(ensemble: Ensemble, workers: Workers, numbers: range) -> dict[str, np.ndarray]:
    """Rows of members by halves; a member that kills its process has a status and nothing else."""
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
