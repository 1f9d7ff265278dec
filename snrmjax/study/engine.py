"""Runs a study: chunks that are missing are computed, and all of them are collected."""

import time
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from snrmjax.study.chunks import StudyFolder, chunk_identity
from snrmjax.study.computations.base import joined, with_refused
from snrmjax.study.study import PlannedStudy
from snrmjax.study.tasks import LOST, Receipt, compute_chunk, computed_rows, stored
from snrmjax.study.workers import AbstractWorkers, WorkerDied

_DEATHS_BESIDE = 2  # of a chunk's worker, before the chunk is computed alone
_TRIES_OF_ONE = 3  # of a member alone in a process, before it is given up


class Job(NamedTuple):
    """A study whose chunks are to be computed, where they go and what they are known by."""

    planned: PlannedStudy
    folder: StudyFolder
    fingerprint: str

    def task(self, number: int) -> tuple[PlannedStudy, StudyFolder, int, str]:
        """Arguments of `compute_chunk`."""
        return self.planned, self.folder, number, chunk_identity(self.fingerprint, number)


def receipts(job: Job, workers: AbstractWorkers, numbers: Sequence[int]) -> Iterator[Receipt]:
    """Compute chunks and give their receipts in the order in which they are done.

    The first chunk goes alone: it compiles for the others. A chunk whose process died twice beside
    others is computed alone; if it dies there too, its members are, and one that keeps killing its
    process is stored as lost. Raises what a task raised.
    """
    pending, alone = deque(numbers), deque[int]()
    deaths: Counter[int] = Counter()
    if pending:
        yield from _singly(job, workers, pending.popleft())
    running: dict[Any, int] = {}
    while pending or running:
        while pending and len(running) < workers.width:
            number = pending.popleft()
            running[workers.submit(compute_chunk, *job.task(number))] = number
        died: list[int] = []
        for future in workers.wait_for_one(running):
            number = running.pop(future)
            try:
                yield workers.result(future)
            except WorkerDied:
                died.append(number)
        for number in died:
            deaths[number] += 1
            (pending if deaths[number] < _DEATHS_BESIDE else alone).append(number)
    for number in alone:
        yield from _singly(job, workers, number)


def _singly(job: Job, workers: AbstractWorkers, number: int) -> Iterator[Receipt]:
    """A chunk alone in the workers, and where its process dies its members."""
    begin = time.perf_counter()
    try:
        yield workers.result(workers.submit(compute_chunk, *job.task(number)))
    except WorkerDied:
        rows = _rescued(job, workers, job.planned.rows_of(number))
        yield stored(*job.task(number), rows, begin)


def _rescued(job: Job, workers: AbstractWorkers, numbers: range) -> dict[str, np.ndarray]:
    """Rows of members by halves; a member that kills its process has a status and nothing else."""
    for _ in range(1 if len(numbers) > 1 else _TRIES_OF_ONE):
        try:
            return workers.result(workers.submit(computed_rows, job.planned, numbers))
        except WorkerDied:
            continue
    if len(numbers) > 1:
        middle = len(numbers) // 2
        halves = numbers[:middle], numbers[middle:]
        return joined([_rescued(job, workers, half) for half in halves])
    return with_refused(job.planned.study.computation, None, {0: LOST})


class Progress(NamedTuple):
    """Where a run stands."""

    members: int
    done: int
    failed: int
    seconds: float  # since this run began
    done_before: int  # members that were there when it began
    size: int  # bytes of the chunks of this run
    memory: int  # bytes, most that one worker has held

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
            size=self.size + receipt.size,
            memory=max(self.memory, receipt.memory),
        )


ProgressReport = Callable[[Progress], None]
