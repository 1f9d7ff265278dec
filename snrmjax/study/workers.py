"""Who computes the chunks: processes of this machine, or a Dask cluster."""

import abc
import os
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Future, wait
from contextlib import contextmanager
from typing import Any, ClassVar

import jax

from snrmjax.io.compilation_cache import WORTH_KEEPING, default_cache_folder

ENVIRONMENT = {
    # One thread each: workers share the cores, and digits must not depend on how many there are.
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false",
}
INSTALL_CLUSTER = "a Dask cluster needs the package distributed: pip install 'snrmjax[cluster]'."


class WorkerDied(Exception):
    """The process that computed something is gone."""


class ClusterGone(Exception):
    """The cluster's scheduler cannot be reached, or is gone."""


class AbstractWorkers(abc.ABC):
    """Processes that compute; a task whose process dies ends with `WorkerDied`."""

    @property
    @abc.abstractmethod
    def width(self) -> int:
        """How many tasks they compute at a time."""

    @abc.abstractmethod
    def submit(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """Start a task; returns its future."""

    @abc.abstractmethod
    def wait_for_one(self, futures: Iterable[Any]) -> list[Any]:
        """Those of the futures that have ended, at least one."""

    @abc.abstractmethod
    def result(self, future: Any) -> Any:
        """What a task returned. Raises `WorkerDied`, `ClusterGone` or what the task raised."""

    @abc.abstractmethod
    def close(self) -> None:
        """Stop the processes, or leave the cluster."""


class LocalProcesses(AbstractWorkers):
    """Processes of this machine, each on a core of its own (loky: started anew, not forked)."""

    def __init__(self, processes: int) -> None:
        """Arguments: how many processes."""
        self.processes = processes
        self._pool: Any = None

    @property
    def width(self) -> int:
        """See `AbstractWorkers.width`."""
        return self.processes

    def submit(self, function: Callable[..., Any], *arguments: Any) -> Future:
        """See `AbstractWorkers.submit`."""
        if self._pool is None:
            self._pool = self._started()
        return self._pool.submit(function, *arguments)

    def wait_for_one(self, futures: Iterable[Future]) -> list[Future]:
        """See `AbstractWorkers.wait_for_one`."""
        return list(wait(list(futures), return_when=FIRST_COMPLETED).done)

    def result(self, future: Future) -> Any:
        """See `AbstractWorkers.result`."""
        try:
            return future.result()
        except BrokenExecutor as error:
            self.close()  # one death ends them all: the next task starts new ones
            raise WorkerDied(str(error)) from error

    def close(self) -> None:
        """See `AbstractWorkers.close`."""
        if self._pool is not None:
            self._pool.shutdown(wait=True, kill_workers=True)
            self._pool = None

    def _started(self) -> Any:
        from loky import ProcessPoolExecutor
        from loky.backend import get_context

        context = get_context("loky")
        cores = context.Queue()
        own = available_cores()
        for k in range(self.processes):
            cores.put(own[k % len(own)])
        return ProcessPoolExecutor(
            self.processes,
            context=context,
            initializer=settle,
            initargs=(os.getpid(), cores),
            timeout=None,
            env=_environment(),
        )


class DaskCluster(AbstractWorkers):
    """The workers of a running Dask scheduler."""

    patience: ClassVar[str] = "10s"  # with a scheduler that does not answer

    def __init__(self, address: str) -> None:
        """Arguments: the scheduler's address, such as tcp://node1:8786.

        Raises `ValueError` without the package distributed and where nothing answers there.
        """
        try:
            import distributed
        except ImportError as error:
            raise ValueError(INSTALL_CLUSTER) from error
        self._distributed = distributed
        self._gone = (distributed.comm.CommClosedError, distributed.client.FutureCancelledError)
        self.address = address
        try:
            self._client = distributed.Client(address, timeout=self.patience, set_as_default=False)
        except (OSError, TimeoutError, ValueError) as error:
            raise ValueError(f"no Dask scheduler answers at {address}.") from error

    @property
    def width(self) -> int:
        """See `AbstractWorkers.width`; two tasks a thread, so that none waits."""
        with self._reached():
            return max(2 * sum(self._client.nthreads().values()), 2)

    def submit(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """See `AbstractWorkers.submit`."""
        with self._reached():
            return self._client.submit(function, *arguments, pure=False)

    def wait_for_one(self, futures: Iterable[Any]) -> list[Any]:
        """See `AbstractWorkers.wait_for_one`."""
        with self._reached(), self._client.as_current():
            ended = self._distributed.wait(list(futures), return_when="FIRST_COMPLETED")
        return list(ended.done)

    def result(self, future: Any) -> Any:
        """See `AbstractWorkers.result`."""
        try:
            return future.result()
        except self._distributed.KilledWorker as error:
            raise WorkerDied(str(error)) from error
        except self._gone as error:
            raise ClusterGone(self._left) from error

    def close(self) -> None:
        """See `AbstractWorkers.close`."""
        self._client.close(timeout=2)

    @property
    def _left(self) -> str:
        return f"the Dask scheduler at {self.address} is gone"

    @contextmanager
    def _reached(self) -> Iterator[None]:
        """What has to do with the scheduler alone: any error of the network is its end."""
        try:
            yield
        except (*self._gone, OSError) as error:
            raise ClusterGone(self._left) from error


def settle(parent: int, cores: Any) -> None:
    """Before the first chunk: end with the process that started this one, and stay on one core.

    Arguments: `parent` is that process's number, `cores` a queue with a core for every worker.
    """

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(0.2)
        os._exit(1)

    # First of all: a parent that is killed now leaves nobody who would fill the queue.
    threading.Thread(target=watch, daemon=True).start()
    core = cores.get()
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {core})


def available_cores() -> list[int]:
    """The cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return sorted(os.sched_getaffinity(0))
    return list(range(os.cpu_count() or 1))


def _environment() -> dict[str, str]:
    """Of the workers: one thread, and compiled programs kept where all of them find them."""
    cache = jax.config.values["jax_compilation_cache_dir"] or default_cache_folder()
    kept = {
        "JAX_COMPILATION_CACHE_DIR": str(cache),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": str(WORTH_KEEPING),
    }
    return {**ENVIRONMENT, **kept}
