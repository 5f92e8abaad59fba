"""Processes of a search, here or on a cluster; threads would wait for each other in Python code."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import closing, contextmanager
from typing import Generic, TypeVar

from asbuilt.dynamics.kernels.blas import one_blas_thread
from asbuilt.executor import Workers, open_workers

Task = TypeVar("Task")
Result = TypeVar("Result")


@contextmanager
def open_pool(
    work: Callable[[Task], Result], size: int, scheduler: str | None = None
) -> Iterator[SearchPool[Task, Result]]:
    """Yield `size` processes of this machine, or the workers of a Dask scheduler.

    Raises
    ------
    UsageError
        If no scheduler answers, or it has no workers.
    MissingExtraError
        If Dask is needed and not installed.
    """
    # Most processes in addition to this one; each needs about 250 MB.
    with open_workers(min(size, 7), scheduler) as workers:
        count = 0 if scheduler is None and size < 1 else workers.count
        with closing(SearchPool(work, workers, count)) as pool:
            yield pool


class SearchPool(Generic[Task, Result]):
    """Run `work` on tasks in other processes; work, tasks and results must be picklable.

    Starting takes seconds; `is_free` says whether a process is ready and idle. It is never free if
    no process can be started or one was lost.
    """

    def __init__(self, work: Callable[[Task], Result], workers: Workers, size: int) -> None:
        self._work, self._workers, self._busy, self._lost = work, workers, 0, False
        # What each process imports with the work takes longer than many a search.
        self._ready = [workers.executor.submit(_load, work) for _ in range(size)]

    @property
    def is_free(self) -> bool:
        """Whether a process is ready and idle."""
        ready = sum(each.done() and each.exception() is None for each in self._ready)
        return not self._lost and self._busy < ready

    def submit(self, task: Task) -> Future[Result]:
        """Submit a task to a free process."""
        self._busy += 1
        future: Future[Result] = self._workers.executor.submit(_run, self._work, task)
        future.add_done_callback(self._done)
        return future

    def close(self) -> None:
        """Give the processes up: those of this machine are killed."""
        self._lost = True
        self._workers.close()

    def _done(self, future: Future[Result]) -> None:
        self._busy -= 1
        self._lost = self._lost or future.cancelled() or future.exception() is not None


def _load(work: object) -> None:
    """Unpickle the work of a process, and thereby import what it needs."""


def _run(work: Callable[[object], object], task: object) -> object:
    with one_blas_thread():
        return work(task)
