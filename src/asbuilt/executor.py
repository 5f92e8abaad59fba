"""Many tasks on a process pool or a Dask cluster, through anything that has `submit`."""

from __future__ import annotations

import logging
import os
import re
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, CancelledError, Future, wait
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from itertools import islice
from typing import Any, Generic, TypeVar

from asbuilt.children import ChildEnded, ChildPool
from asbuilt.errors import AsbuiltError, MissingExtraError, UsageError
from asbuilt.findings import Cure
from asbuilt.untrusted import describe_problem, shorten_path

Task = TypeVar("Task")
Result = TypeVar("Result")
TOGETHER = 0.25
"""Time [s] of tasks that are submitted together: a submission to a cluster takes milliseconds."""
LONGEST_TOGETHER = 1.0
LATE_TOGETHER = 0.04
"""The same after a while, and the share of the time so far that it may take: with few tasks left,
some workers wait that long for others."""
MOST_TOGETHER = 100
ATTEMPTS = 2
"""Times that a task is run alone after its process died."""
CONNECTING = 5.0
GIVEN_UP = 8.0
"""Seconds until a scheduler that does not answer is given up: by Dask, and by us if it is not."""
ADDRESS = re.compile(r"(?:(?:tcp|tls|ucx|wss?)://)?[\w.:%\[\]-]{1,250}:\d{1,5}")
"""Addresses that Dask connects to; for others it starts a cluster here, or asks the network."""
ONE_THREAD = dict.fromkeys(
    ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OMP_NUM_THREADS", "POLARS_MAX_THREADS"), "1"
)
"""Settings of a worker: the processes share the cores, threads would share them once more."""
_Done = tuple[list[tuple[Any, ...]], float]
"""What tasks came to, one tuple each, and the seconds they took together."""
ENDED = (ChildEnded, CancelledError)
"""What a task raises whose process died."""


@dataclass(frozen=True, slots=True, eq=False)
class Outcome(Generic[Task, Result]):
    """Hold a task with its result, or why it has none, and the error if it is one of ours."""

    task: Task
    result: Result | None = None
    problem: str | None = None
    error: AsbuiltError | None = None


@dataclass(frozen=True, eq=False)
class Workers:
    """Hold how tasks are run elsewhere, and how many at a time.

    Parameters
    ----------
    count
        Number of workers.
    submit
        Runs a function on arguments, all of which must be picklable, as the method of
        `concurrent.futures.Executor` and of Dask's executor does.
    close
        Gives up what is under way; nothing can be submitted after it.
    dashboard
        Address of the page that shows the work, if there is one.
    """

    count: int
    submit: Callable[..., Future[Any]]
    close: Callable[[], None]
    dashboard: str | None = None

    def run(
        self, function: Callable[[Task], Result], tasks: Iterable[Task]
    ) -> Iterator[Outcome[Task, Result]]:
        """Yield the outcome of each task as it is done; few tasks are submitted ahead.

        Short tasks are submitted several at a time. Those whose process died are repeated in the
        end, one at a time, so that only the one that kills its process, whatever memory the others
        took, fails.
        """
        waiting = iter(tasks)
        done = 0
        spent = 0.0
        running: dict[Future[_Done], list[Task]] = {}
        suspects: list[Task] = []
        while True:
            # Submissions under way for each worker, so that none is idle while results are taken.
            while len(running) < self.count * 3:
                batch = list(islice(waiting, _choose_batch(done, spent, self.count)))
                if not batch:
                    break
                running[self.submit(_run_batch, function, batch)] = batch
            if not running:
                break
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                batch = running.pop(future)
                try:
                    found, seconds = future.result()
                except Exception as problem:
                    if len(batch) == 1 and not isinstance(problem, ENDED):
                        yield Outcome(batch[0], problem=_describe_failure(problem))
                    else:
                        suspects += batch
                    continue
                done = done + len(batch)
                spent = spent + seconds
                yield from (Outcome(task, *each) for task, each in zip(batch, found, strict=True))
        yield from (self._run_alone(function, task) for task in suspects)

    def _run_alone(self, function: Callable[[Task], Result], task: Task) -> Outcome[Task, Result]:
        """Return the outcome of a task that is the only one under way."""
        for _ in range(ATTEMPTS):
            try:
                (found,), _ = self.submit(_run_batch, function, [task]).result()
            except ENDED:
                continue
            except Exception as problem:
                return Outcome(task, problem=_describe_failure(problem))
            return Outcome(task, *found)
        return Outcome(
            task, problem=f"its worker was killed {ATTEMPTS} times, such as for want of memory"
        )


def _choose_batch(tasks: int, seconds: float, workers: int) -> int:
    """Return how many tasks are submitted together, after so many that took so long [s] in all.

    They take about `TOGETHER` seconds, or longer after a while.
    """
    if not tasks:
        return 1
    late = LATE_TOGETHER * seconds / workers
    together = min(max(TOGETHER, late), LONGEST_TOGETHER)  # seconds
    return max(1, min(MOST_TOGETHER, int(together * tasks / max(seconds, 1e-9))))


def _run_batch(function: Callable[[Any], Any], tasks: list[Any]) -> _Done:
    began = time.monotonic()
    return [_run(function, task) for task in tasks], time.monotonic() - began


def _run(function: Callable[[Any], Any], task: Any) -> tuple[Any, ...]:
    """Return the result of a task; or None, why, and an error that can be raised elsewhere."""
    try:
        return (function(task),)
    except Exception as problem:
        return (
            None,
            _describe_failure(problem),
            problem if isinstance(problem, AsbuiltError) else None,
        )


def _describe_failure(problem: BaseException) -> str:
    if type(problem).__name__ == "KilledWorker":
        return "its worker was killed again and again"
    return f"{type(problem).__name__}: {problem}"


def run_in_order(
    function: Callable[[Task], Result], tasks: Iterable[Task], workers: Workers | None = None
) -> list[Result]:
    """Return `function(task)` of all tasks, by workers or, if there are none, here.

    Raises
    ------
    AsbuiltError
        The error of the first task that raises one, as it would here; or one that names the loss
        of a worker.
    """
    if workers is None:
        return [function(task) for task in tasks]
    numbered = list(enumerate(tasks))
    found = {each.task[0]: each for each in workers.run(partial(_run_numbered, function), numbered)}
    outcomes = [found[number] for number, _ in numbered]
    for outcome in outcomes:
        if outcome.problem is not None:
            raise outcome.error or AsbuiltError(
                f"a worker did not finish its part: {outcome.problem}"
            )
    return [outcome.result for outcome in outcomes]  # type: ignore[misc]


def _run_numbered(function: Callable[[Task], Result], task: tuple[int, Task]) -> Result:
    return function(task[1])


def count_cores() -> int:
    """Return the number of cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextmanager
def open_workers(workers: int | None = None, scheduler: str | None = None) -> Iterator[Workers]:
    """Yield workers: processes of this machine, or the workers of a Dask scheduler.

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
        with _open_cluster(scheduler) as found:
            yield found
        return
    count = count_cores() if workers is None else workers
    if count < 0:
        raise UsageError(f"the number of workers must be 0 or more, got {count}")
    pool = ChildPool(count, ONE_THREAD) if count else _Here()
    try:
        yield Workers(max(count, 1), pool.submit, pool.close)
    finally:
        pool.close()


class _Here:
    """Run tasks in this process when they are submitted."""

    def submit(self, function: Callable[..., Any], /, *arguments: Any) -> Future[Any]:
        future: Future[Any] = Future()
        try:
            future.set_result(function(*arguments))
        except Exception as problem:
            future.set_exception(problem)
        return future

    def close(self) -> None:
        """Do nothing: what was submitted is done."""


@contextmanager
def _open_cluster(address: str) -> Iterator[Workers]:
    if not ADDRESS.fullmatch(address):
        raise UsageError(f"{shorten_path(address)!r} is no address such as tcp://10.0.0.1:8786")
    try:
        distributed = import_module("distributed")
    except ImportError:
        raise MissingExtraError("distributed", "cluster", "a Dask scheduler") from None
    client, threads = _connect_scheduler(distributed, address)
    try:
        if not threads:
            raise UsageError(
                f"the Dask scheduler at {address} has no workers",
                cure=Cure(f"start some with `dask worker {address}`"),
            )
        submit = client.get_executor(pure=False).submit
        yield Workers(threads, submit, lambda: None, client.dashboard_link)
    finally:
        client.close()


def _connect_scheduler(distributed: Any, address: str) -> tuple[Any, int]:
    """Return the client of a scheduler and the number of its threads.

    Another thread connects, since what is no scheduler may say nothing for ever, or anything; that
    ends in one `UsageError` too, and in no lines of the client's log.
    """
    cure = Cure("start one with `dask scheduler`, and workers with `dask worker ADDRESS`")
    found: Future[tuple[Any, int]] = Future()

    def connect() -> None:
        try:
            client = distributed.Client(address, timeout=CONNECTING)
            found.set_result((client, sum(client.nthreads().values())))
        except BaseException as problem:
            found.set_exception(problem)

    log = logging.getLogger("distributed")
    before = log.level
    log.level = logging.CRITICAL + 1
    try:
        threading.Thread(target=connect, daemon=True).start()
        return found.result(GIVEN_UP)
    except TimeoutError:
        why = f"nothing that it says in {GIVEN_UP:.0f} s is of Dask"
    except (Exception, MemoryError) as problem:
        why = describe_problem(problem)
    finally:
        log.level = before
    raise UsageError(f"no Dask scheduler answers at {address}: {why}", cure=cure)
