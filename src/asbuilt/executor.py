"""Many tasks on a process pool or a Dask cluster, through anything that has `submit`."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, CancelledError, Future, wait
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib import import_module
from typing import Any, Generic, Protocol, TypeVar

from asbuilt.errors import MissingExtraError, UsageError
from asbuilt.findings import Cure

Task = TypeVar("Task")
Result = TypeVar("Result")

ORPHAN_CHECK = 0.5
"""Seconds between looks at the parent process."""
PER_WORKER = 4
"""Tasks that wait at each worker, so that none is idle while results are taken."""
ATTEMPTS = 2
"""Times that a task is run alone after its process died among others."""
CONNECTING = 20.0
"""Seconds until a scheduler that does not answer is given up."""
ONE_THREAD = {
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "OMP_NUM_THREADS": "1",
    "POLARS_MAX_THREADS": "1",
}
"""Settings of a worker: the processes share the cores, threads would share them once more."""


class Executor(Protocol):
    """Run functions elsewhere, as `concurrent.futures.Executor` and Dask's executor do."""

    def submit(self, function: Callable[..., Any], /, *arguments: Any) -> Future[Any]:
        """Run a function on arguments; all must be picklable."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class Outcome(Generic[Task, Result]):
    """Hold a task with its result, or why it has none."""

    task: Task
    result: Result | None = None
    problem: str | None = None


@dataclass(eq=False)
class Workers:
    """Hold an executor that can be replaced once its processes are lost.

    Parameters
    ----------
    count
        Number of workers.
    executor
        Runs the tasks.
    renew
        Returns an executor in place of one that is broken; None if the executor repairs itself.
    dashboard
        Address of the page that shows the work, if there is one.
    """

    count: int
    executor: Executor
    renew: Callable[[], Executor] | None = None
    dashboard: str | None = None
    _suspects: deque[Any] = field(default_factory=deque, init=False, repr=False)

    def run(
        self, function: Callable[[Task], Result], tasks: Iterable[Task]
    ) -> Iterator[Outcome[Task, Result]]:
        """Yield the outcome of each task as it is done; few tasks are submitted ahead.

        Where a process dies, all tasks under way are repeated one at a time, so that only the one
        that kills its process fails.
        """
        waiting, running = iter(tasks), dict[Future[Result], Task]()
        while True:
            for task in _first(waiting, self.count * PER_WORKER - len(running)):
                self._start(function, task, running)
            if not running and not self._suspects:
                return
            done = wait(running, return_when=FIRST_COMPLETED).done if running else ()
            for future in done:
                task = running.pop(future)
                outcome = _outcome(task, future)
                if outcome is None:
                    self._suspects.append(task)
                else:
                    yield outcome
            if self._suspects:
                yield from self._retried(function, running)

    def _start(
        self,
        function: Callable[[Task], Result],
        task: Task,
        running: dict[Future[Result], Task],
    ) -> None:
        try:
            running[self.executor.submit(function, task)] = task
        except BrokenExecutor:
            self._suspects.append(task)

    def _retried(
        self, function: Callable[[Task], Result], running: dict[Future[Result], Task]
    ) -> Iterator[Outcome[Task, Result]]:
        """Repeat the tasks that were under way when a process died, one at a time."""
        for future in wait(running).done:
            outcome = _outcome(running[future], future)
            if outcome is None:
                self._suspects.append(running[future])
            else:
                yield outcome
        running.clear()
        if self.renew is not None:
            self.executor = self.renew()
        while self._suspects:
            task, outcome = self._suspects.popleft(), None
            for _ in range(ATTEMPTS):
                future = self.executor.submit(function, task)
                outcome = _outcome(task, future)
                if outcome is not None:
                    break
                if self.renew is not None:
                    self.executor = self.renew()
            yield outcome or Outcome(
                task,
                problem=f"its worker was killed {ATTEMPTS} times, such as for want of memory",
            )


def _first(tasks: Iterator[Task], count: int) -> Iterator[Task]:
    """Yield at most `count` tasks, each when it is asked for."""
    for _ in range(count):
        try:
            yield next(tasks)
        except StopIteration:
            return


def _outcome(task: Task, future: Future[Result]) -> Outcome[Task, Result] | None:
    """Return the outcome of a task that ends, None if its process died."""
    try:
        return Outcome(task, future.result())
    except (BrokenExecutor, CancelledError):
        return None
    except Exception as problem:
        if type(problem).__name__ == "KilledWorker":
            return Outcome(task, problem="its worker was killed again and again")
        return Outcome(task, problem=f"{type(problem).__name__}: {problem}")


@contextmanager
def open_workers(workers: int | None = None, scheduler: str | None = None) -> Iterator[Workers]:
    """Yield workers: processes of this machine, or those of a Dask scheduler.

    Parameters
    ----------
    workers
        Number of processes, by default one for each core; 1 runs the tasks in a process too, 0 in
        this one.
    scheduler
        Address of a Dask scheduler, such as `tcp://10.0.0.1:8786`.

    Raises
    ------
    UsageError
        If the number is negative, or no scheduler answers.
    MissingExtraError
        If Dask is needed and not installed.
    """
    if scheduler is not None:
        with _cluster(scheduler) as found:
            yield found
        return
    count = len(os.sched_getaffinity(0)) if workers is None else workers
    if count < 0:
        raise UsageError(f"the number of workers must be 0 or more, got {count}")
    if count == 0:
        yield Workers(1, _Here())
        return
    pools: list[Any] = []

    def renew() -> Executor:
        for pool in pools:
            pool.shutdown(wait=True, kill_workers=True)
        pools[:] = [_pool(count)]
        return pools[0]  # type: ignore[no-any-return]

    try:
        yield Workers(count, renew(), renew)
    finally:
        for pool in pools:
            pool.shutdown(wait=True, kill_workers=True)


class _Here:
    """Run tasks in this process when they are submitted."""

    def submit(self, function: Callable[..., Any], /, *arguments: Any) -> Future[Any]:
        future: Future[Any] = Future()
        try:
            future.set_result(function(*arguments))
        except Exception as problem:
            future.set_exception(problem)
        return future


def _pool(count: int) -> Any:
    process_executor = import_module("loky.process_executor")
    with interrupts_ignored():
        pool = process_executor.ProcessPoolExecutor(
            count, timeout=None, initializer=_begin, initargs=(os.getpid(),), env=ONE_THREAD
        )
        pool.submit(os.getpid).result()
    return pool


@contextmanager
def _cluster(address: str) -> Iterator[Workers]:
    try:
        distributed = import_module("distributed")
    except ImportError:
        raise MissingExtraError("distributed", "cluster", "a Dask scheduler") from None
    try:
        client = distributed.Client(address, timeout=CONNECTING)
    except (OSError, ValueError) as problem:
        raise UsageError(
            f"no Dask scheduler answers at {address}: {problem}",
            cure=Cure("start one with `dask scheduler`, and workers with `dask worker ADDRESS`"),
        ) from None
    try:
        threads = sum(client.nthreads().values())
        if not threads:
            raise UsageError(
                f"the Dask scheduler at {address} has no workers",
                cure=Cure(f"start some with `dask worker {address}`"),
            )
        executor = client.get_executor(pure=False)
        yield Workers(threads, executor, dashboard=client.dashboard_link)
    finally:
        client.close()


def _begin(parent: int) -> None:
    threading.Thread(target=_end_with, args=(parent,), daemon=True).start()


def _end_with(parent: int) -> None:
    """End this process soon after its parent, which may be killed without a chance to say so."""
    while os.getppid() == parent:
        time.sleep(ORPHAN_CHECK)
    os._exit(1)


@contextmanager
def interrupts_ignored() -> Iterator[None]:
    """Start processes that ignore Ctrl-C, which this process handles."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
