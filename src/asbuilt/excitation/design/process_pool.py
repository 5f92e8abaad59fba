"""Process pool of a search; threads would wait for each other in Python code."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import contextmanager
from pickle import PicklingError
from typing import Generic, TypeVar

from loky.process_executor import ProcessPoolExecutor

Task = TypeVar("Task")
Result = TypeVar("Result")

MOST = 7
"""Most processes beside this one; each needs about 250 MB."""
ORPHAN_CHECK = 0.5
"""Seconds between looks at the parent process."""


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
            with _interrupts_ignored():
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
    threading.Thread(target=_end_with, args=(parent,), daemon=True).start()


def _end_with(parent: int) -> None:
    """End this process soon after its parent, which may be killed without a chance to say so."""
    while os.getppid() == parent:
        time.sleep(ORPHAN_CHECK)
    os._exit(1)


def _is_ready() -> bool:
    return bool(_work)


def _do(task: object) -> object:
    return _work[0](task)


@contextmanager
def _interrupts_ignored() -> Iterator[None]:
    """Start processes that ignore Ctrl-C, which this process handles."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
