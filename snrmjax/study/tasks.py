"""What a worker does: settle on one core, compute a chunk, write it, give a receipt."""

import os
import sys
import threading
import time
from typing import Any, NamedTuple

import numpy as np
from threadpoolctl import threadpool_limits

from snrmjax.study.chunks import StudyFolder, write_chunk
from snrmjax.study.computations.base import COMPLETE
from snrmjax.study.study import PlannedStudy

LOST = "lost: the process that computed it died"

ENVIRONMENT = {
    # One thread each: workers share the cores, and digits must not depend on how many there are.
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false",
}


class Receipt(NamedTuple):
    """What is known of a chunk that was written."""

    number: int
    members: int
    failed: int
    seconds: float  # of computing and writing
    size: int  # bytes on disk
    memory: int  # bytes, most that the worker has held


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


def computed_rows(planned: PlannedStudy, numbers: range) -> dict[str, np.ndarray]:
    """The rows of some members."""
    os.environ.update({k: v for k, v in ENVIRONMENT.items() if k not in os.environ})
    with threadpool_limits(limits=1, user_api="blas"):
        return planned.rows(numbers)


def compute_chunk(
    planned: PlannedStudy, folder: StudyFolder, number: int, identity: str
) -> Receipt:
    """Compute a chunk and write it; returns its receipt. Raises `OSError` on a full disk."""
    begin = time.perf_counter()
    rows = computed_rows(planned, planned.rows_of(number))
    return stored(planned, folder, number, identity, rows, begin)


def stored(
    planned: PlannedStudy,
    folder: StudyFolder,
    number: int,
    identity: str,
    rows: dict[str, np.ndarray],
    begin: float,
) -> Receipt:
    """Write the rows of a chunk and count them."""
    path = write_chunk(folder, number, identity, rows)
    status = np.asarray(rows["status"]).reshape(len(planned.rows_of(number)), -1)
    failed = int(np.sum(~np.all(np.isin(status, COMPLETE), axis=1)))
    size = path.stat().st_size
    return Receipt(number, len(status), failed, time.perf_counter() - begin, size, _memory())


def _memory() -> int:
    if sys.platform == "win32":
        return 0
    import resource

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024
