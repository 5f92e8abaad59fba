"""Multistart search here and in other processes, with progress, deadline and interrupt."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import closing, contextmanager
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np

from asbuilt.dynamics.kernels.blas import use_one_blas_thread
from asbuilt.excitation.design.interior_point import Optimum
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
        # Without a scheduler and a second core everything runs here.
        count = 0 if scheduler is None and size < 1 else workers.count
        with closing(SearchPool(work, workers, count)) as pool:
            yield pool


class SearchPool(Generic[Task, Result]):
    """Run `work` on tasks in other processes; work, tasks and results must be picklable.

    Starting takes seconds; `is_free` says whether a process is ready and idle. It is never free if
    no process can be started or one was lost.
    """

    def __init__(self, work: Callable[[Task], Result], workers: Workers, size: int) -> None:
        self._work = work
        self._workers = workers
        self._busy = 0
        self._lost = False
        # What each process imports with the work takes longer than many a search.
        # Idle processes load while others search: the first task then starts at once.
        self._ready = [workers.submit(_load, work) for _ in range(size)]

    @property
    def is_free(self) -> bool:
        """Whether a process is ready and idle."""
        ready = sum(
            ready_future.done() and ready_future.exception() is None for ready_future in self._ready
        )
        return not self._lost and self._busy < ready

    def submit(self, task: Task) -> Future[Result]:
        """Submit a task to a free process."""
        self._busy += 1
        future: Future[Result] = self._workers.submit(_run, self._work, task)
        future.add_done_callback(self._count_done)
        return future

    def close(self) -> None:
        """Give the processes up; local processes are killed."""
        self._lost = True
        self._workers.close()

    def _count_done(self, future: Future[Result]) -> None:
        # A process that was lost takes the pool with it: its tasks are searched here.
        self._busy -= 1
        self._lost = self._lost or future.cancelled() or future.exception() is not None


def _load(work: object) -> None:
    """Unpickle the work of a process, and thereby import what it needs."""


def _run(work: Callable[[object], object], task: object) -> object:
    # Processes share the cores already.
    with use_one_blas_thread():
        return work(task)


@dataclass(frozen=True, slots=True)
class SearchProgress:
    """State of a phase of a design: seconds and searches, spent and planned; best value so far."""

    seconds: float
    limit: float
    finished: int
    planned: int
    best: float
    phase: str = "search"

    @property
    def share(self) -> float:
        """Completed fraction of the phase, by searches or by time, whichever is larger."""
        return min(1.0, max(self.finished / self.planned, self.seconds / self.limit))


class Deadline:
    """Stop after `seconds`, or when `stop` is called; a keyboard interrupt sets `interrupted`."""

    def __init__(self, seconds: float) -> None:
        self._begin = time.monotonic()
        self.seconds = seconds
        self._stopped = threading.Event()
        self.interrupted = False

    @property
    def elapsed(self) -> float:
        """Seconds since the start."""
        return time.monotonic() - self._begin

    def stop(self) -> None:
        """End every search that uses this deadline."""
        self._stopped.set()

    def __reduce__(self) -> tuple[Callable[[float, float], Deadline], tuple[float, float]]:
        """Pickle the start by the clock of the day, which machines share, but no later `stop`."""
        # Monotonic clocks differ between machines; the time of day does not.
        return Deadline.begun_at, (time.time() - self.elapsed, self.seconds)

    @classmethod
    def begun_at(cls, begin: float, seconds: float) -> Deadline:
        """Return the deadline that started at the time `begin` since 1970 [s]."""
        deadline = cls(seconds)
        # Clocks that differ by seconds must not lengthen the deadline.
        deadline._begin -= max(time.time() - begin, 0.0)
        return deadline

    def __call__(self) -> bool:
        """Return whether to stop now."""
        return self._stopped.is_set() or self.elapsed > self.seconds


def search_all(
    tasks: Iterable[Task],
    search: Callable[[Task], Optimum | None],
    deadline: Deadline,
    *,
    pool: SearchPool[Task, Optimum | None] | None = None,
    progress: Callable[[SearchProgress], None] | None = None,
) -> list[Optimum]:
    """Return the optima of all tasks that have one, searched here and in a pool, best first.

    A keyboard interrupt or the deadline ends the searches early and keeps their results. Each
    search must check the deadline itself; the first one starts even after the deadline. The order
    does not depend on timing, and tasks of a lost pool are searched here.
    """
    found: list[Optimum | None] = []
    waiting = deque(tasks)
    planned = len(waiting)
    pending: dict[Future[Optimum | None], Task] = {}
    own: Future[Optimum | None] | None = None
    with use_one_blas_thread(), ThreadPoolExecutor(max_workers=1) as here:
        try:
            while True:
                # The first search starts even after the deadline: there must be something to
                # return.
                while waiting and not (deadline() and (found or pending)):
                    busy = own is not None
                    # Here one search runs at a time; others wait for a free process.
                    if busy and (pool is None or not pool.is_free):
                        break
                    task = waiting.popleft()
                    if pool is not None and busy:
                        future = pool.submit(task)
                    else:
                        future = own = here.submit(search, task)
                    pending[future] = task
                if not pending:
                    break
                # Interval at which progress is reported and the deadline checked [s].
                for future in wait(pending, timeout=0.2, return_when=FIRST_COMPLETED).done:
                    task = pending.pop(future)
                    # What failed elsewhere goes to the front, and is searched here.
                    if future is not own and future.exception() is not None:
                        waiting.appendleft(task)
                        continue
                    own = None if future is own else own
                    found.append(future.result())
                if progress is not None:
                    best = max((optimum.value for optimum in found if optimum), default=-np.inf)
                    progress(
                        SearchProgress(
                            deadline.elapsed, deadline.seconds, len(found), planned, best
                        )
                    )
        # An interrupt ends searches by their deadline, so that their results are kept.
        except KeyboardInterrupt:
            deadline.stop()
            deadline.interrupted = True
            if pool is not None:
                pool.close()
            if own is not None:
                found.append(own.result())
    # A motion that determines not all parameters has no finite value.
    return rank_optima(optimum for optimum in found if optimum and np.isfinite(optimum.value))


def rank_optima(optima: Iterable[Optimum]) -> list[Optimum]:
    """Return the optima, best first, equal ones by number."""
    # By number where equal, so that the order does not depend on timing.
    return sorted(optima, key=lambda optimum: (-optimum.value, optimum.number))
