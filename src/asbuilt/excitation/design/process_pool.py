"""Process pool of a search; threads would wait for each other in Python code."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import Future
from pickle import PicklingError
from typing import Generic, TypeVar

from loky.process_executor import ProcessPoolExecutor

from asbuilt.executor import end_with_parent, interrupts_ignored

Task = TypeVar("Task")
Result = TypeVar("Result")

MOST = 7
"""Most processes beside this one; each needs about 250 MB."""


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
                    env={"OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"},
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
