"""Computes the chunks of a study in processes that may die, and counts what was done."""

import os
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from threadpoolctl import threadpool_limits

from snrmjax.study.computations.base import COMPLETE, joined, with_refused
from snrmjax.study.store import StudyFolder, write_chunk
from snrmjax.study.study import PlannedStudy
from snrmjax.study.workers import ENVIRONMENT, AbstractWorkers, WorkerDied

LOST = "lost: the process that computed it died"

_DEATHS_BESIDE = 2  # of a chunk's worker, before the chunk is computed alone
_TRIES_OF_ONE = 3  # of a member alone in a process, before it is given up


class Receipt(NamedTuple):
    """What is known of a chunk that was written."""

    members: int
    failed: int


def computed_rows(planned: PlannedStudy, numbers: range) -> dict[str, np.ndarray]:
    """The rows of some members."""
    os.environ.update({k: v for k, v in ENVIRONMENT.items() if k not in os.environ})
    with threadpool_limits(limits=1, user_api="blas"):
        return planned.rows(numbers)


def compute_chunk(planned: PlannedStudy, folder: StudyFolder, number: int) -> Receipt:
    """Compute a chunk and write it; returns its receipt. Raises `OSError` on a full disk."""
    return _stored(folder, number, computed_rows(planned, planned.rows_of(number)))


def _stored(folder: StudyFolder, number: int, rows: dict[str, np.ndarray]) -> Receipt:
    """Write the rows of a chunk and count them."""
    write_chunk(folder, number, rows)
    status = np.asarray(rows["status"])
    whole = np.isin(status, COMPLETE).reshape(len(status), -1).all(axis=1)
    return Receipt(len(status), int(np.sum(~whole)))


def receipts(
    planned: PlannedStudy, folder: StudyFolder, workers: AbstractWorkers, numbers: Sequence[int]
) -> Iterator[Receipt]:
    """Compute chunks and give their receipts in the order in which they are done.

    The first chunk goes alone: it compiles for the others. A chunk whose process died twice beside
    others is computed alone; if it dies there too, its members are, and one that keeps killing its
    process is stored as lost. Raises what a task raised.
    """
    pending, alone = deque(numbers), deque[int]()
    deaths: Counter[int] = Counter()
    if pending:
        yield _singly(planned, folder, workers, pending.popleft())
    running: dict[Any, int] = {}
    while pending or running:
        while pending and len(running) < workers.width:
            number = pending.popleft()
            running[workers.submit(compute_chunk, planned, folder, number)] = number
        for future in workers.wait_for_one(running):
            number = running.pop(future)
            try:
                yield workers.result(future)
            except WorkerDied:
                deaths[number] += 1
                (pending if deaths[number] < _DEATHS_BESIDE else alone).append(number)
    for number in alone:
        yield _singly(planned, folder, workers, number)


def _singly(
    planned: PlannedStudy, folder: StudyFolder, workers: AbstractWorkers, number: int
) -> Receipt:
    """A chunk alone in the workers, and where its process dies its members."""
    try:
        return workers.result(workers.submit(compute_chunk, planned, folder, number))
    except WorkerDied:
        return _stored(folder, number, _rescued(planned, workers, planned.rows_of(number)))


def _rescued(
    planned: PlannedStudy, workers: AbstractWorkers, numbers: range
) -> dict[str, np.ndarray]:
    """Rows of members by halves; a member that kills its process has a status and nothing else."""
    for _ in range(1 if len(numbers) > 1 else _TRIES_OF_ONE):
        try:
            return workers.result(workers.submit(computed_rows, planned, numbers))
        except WorkerDied:
            continue
    if len(numbers) > 1:
        middle = len(numbers) // 2
        halves = numbers[:middle], numbers[middle:]
        return joined([_rescued(planned, workers, half) for half in halves])
    return with_refused(planned.study.computation, None, {0: LOST})


class Progress(NamedTuple):
    """Where a run stands."""

    members: int
    done: int
    failed: int
    seconds: float  # since this run began
    done_before: int  # members that were there when it began

    @property
    def per_second(self) -> float:
        """Members computed a second."""
        return (self.done - self.done_before) / max(self.seconds, 1e-9)

    @property
    def seconds_left(self) -> float:
        """At this pace."""
        return (self.members - self.done) / max(self.per_second, 1e-9)

    def with_receipt(self, receipt: Receipt, seconds: float) -> "Progress":
        """After a further chunk."""
        return self._replace(
            done=self.done + receipt.members,
            failed=self.failed + receipt.failed,
            seconds=seconds,
        )


ProgressReport = Callable[[Progress], None]
