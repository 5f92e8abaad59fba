"""Processes of a search, here or on a cluster; threads would wait for each other in Python code."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import closing, contextmanager
from pickle import PicklingError
from typing import Generic, Protocol, TypeVar

from loky.process_executor import ProcessPoolExecutor

from asbuilt.dynamics.kernels.blas import one_blas_thread
from asbuilt.executor import Workers, end_with_parent, interrupts_ignored, open_workers
from asbuilt.isolation import SAFE_PATH

Task = TypeVar("Task")
Result = TypeVar("Result")
Given_contra = TypeVar("Given_contra", contravariant=True)

MOST = 7
"""Most processes beside this one; each needs about 250 MB."""


class Pool(Protocol[Given_contra, Result]):
    """Run a search on tasks elsewhere."""

    @property
    def is_free(self) -> bool:
        """Whether a process is ready and idle."""
        ...

    def submit(self, task: Given_contra) -> Future[Result]:
        """Submit a task to a free process."""
        ...

    def close(self) -> None:
        """Give the processes up."""
        ...


@contextmanager
def open_pool(
    work: Callable[[Task], Result], size: int, scheduler: str | None = None
) -> Iterator[Pool[Task, Result]]:
    """Yield `size` processes of this machine, or the workers of a Dask scheduler.

    Raises
    ------
    UsageError
        If no scheduler answers, or it has no workers.
    MissingExtraError
        If Dask is needed and not installed.
    """
    if scheduler is not None:
        with open_workers(None, scheduler) as workers:
            yield ClusterPool(work, workers)
        return
    with closing(ProcessPool(work, size)) as pool:
        yield pool


class ClusterPool(Generic[Task, Result]):
    """Run `work` on tasks by the workers of a cluster; each gets the work with its task."""

    def __init__(self, work: Callable[[Task], Result], workers: Workers) -> None:
        self._work, self._workers, self._busy, self._lost = work, workers, 0, False

    @property
    def is_free(self) -> bool:
        """Whether fewer tasks are under way than there are workers."""
        return not self._lost and self._busy < self._workers.count

    def submit(self, task: Task) -> Future[Result]:
        """Submit a task."""
        self._busy += 1
        future: Future[Result] = self._workers.executor.submit(_worked, self._work, task)
        future.add_done_callback(self._done)
        return future

    def close(self) -> None:
        """Submit nothing more; tasks under way end at their deadline."""
        self._lost = True

    def _done(self, future: Future[Result]) -> None:
        self._busy -= 1
        self._lost = self._lost or future.cancelled() or future.exception() is not None


def _worked(work: Callable[[object], object], task: object) -> object:
    with one_blas_thread():
        return work(task)


class ProcessPool(Generic[Task, Result]):
    """Run `work` on tasks in other processes; work, tasks and results must be picklable.

    Starting takes seconds; `is_free` says whether a process is ready and idle. It is never free if
    no process can be started or the processes are lost. Close it in the end.
    """

    def __init__(self, work: Callable[[Task], Result], size: int) -> None:
        self._size, self._busy = min(size, MOST), 0
        self._executor: ProcessPoolExecutor | None = None
        self._ready: Future[bool] | None = None
        if self._size < 1:
            return
        try:
            with interrupts_ignored():
                self._executor = ProcessPoolExecutor(
                    self._size,
                    timeout=None,
                    initializer=_begin,
                    initargs=(work, os.getpid()),
                    env={"OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"} | SAFE_PATH,
                )
                self._ready = self._executor.submit(_is_ready)
        except (OSError, ImportError, RuntimeError, TypeError, PicklingError):
            self.close()

    @property
    def is_free(self) -> bool:
        """Whether a process is ready and idle."""
        return (
            self._ready is not None
            and self._ready.done()
            and self._ready.exception() is None
            and self._busy < self._size
        )

    def submit(self, task: Task) -> Future[Result]:
        """Submit a task to a free process."""
        assert self._executor is not None
        self._busy += 1
        future: Future[Result] = self._executor.submit(_do, task)
        future.add_done_callback(self._done)
        return future

    def close(self) -> None:
        """Kill the processes."""
        if self._executor is not None:
            self._executor.shutdown(wait=True, kill_workers=True)
        self._executor = self._ready = None

    def _done(self, future: Future[Result]) -> None:
        self._busy -= 1
        if future.cancelled() or future.exception() is not None:
            self._size = 0


_work: list[Callable[[object], object]] = []
"""The work of this process, if it belongs to a pool."""


def _begin(work: Callable[[object], object], parent: int) -> None:
    _work[:] = [work]
    end_with_parent(parent)


def _is_ready() -> bool:
    return bool(_work)


def _do(task: object) -> object:
    return _work[0](task)
