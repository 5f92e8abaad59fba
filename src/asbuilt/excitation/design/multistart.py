"""Many starts: the best of several local searches, with progress and an end on demand."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Iterable
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from asbuilt.arrays import Array
from asbuilt.dynamics.kernels.blas import one_blas_thread
from asbuilt.excitation.design.interior_point import Optimum
from asbuilt.excitation.design.process_pool import Crew

Task = TypeVar("Task")

POLL = 0.2
"""Time after which progress is told and the deadline looked at, though no search has ended [s]."""


@dataclass(frozen=True, eq=False)
class Candidate:
    """What one local search found: coefficients and value, minus infinity where it found nothing."""

    number: int
    coefficients: Array
    value: float

    @classmethod
    def of(cls, number: int, optimum: Optimum | None) -> Candidate:
        """Return what a search ended at."""
        return (
            cls(number, np.zeros((0, 0)), -np.inf)
            if optimum is None
            else cls(number, optimum.coefficients, optimum.value)
        )


@dataclass(frozen=True, slots=True)
class SearchProgress:
    """How a phase of a design stands: seconds since it began, of those it has.

    Searches finished, of those planned; the best value so far.
    """

    seconds: float
    limit: float
    finished: int
    planned: int
    best: float
    phase: str = "search"

    @property
    def share(self) -> float:
        """The share of the phase that is over, by searches or by time, whichever is further."""
        return min(1.0, max(self.finished / self.planned, self.seconds / self.limit))


class Deadline:
    """Say when to stop: after `seconds`, or once `stop` was called from anywhere.

    `interrupted` where a keyboard interrupt called it.
    """

    def __init__(self, seconds: float) -> None:
        self._begin = time.monotonic()
        self.seconds = seconds
        self._stopped = threading.Event()
        self.interrupted = False

    @property
    def elapsed(self) -> float:
        """Seconds since the beginning."""
        return time.monotonic() - self._begin

    def stop(self) -> None:
        """Make every search that asks end."""
        self._stopped.set()

    def __reduce__(self) -> tuple[Callable[[float, float], Deadline], tuple[float, float]]:
        """Pickle when it ends: another process of this machine has the same clock.

        A later `stop` here is not heard there.
        """
        return Deadline.begun_at, (self._begin, self.seconds)

    @classmethod
    def begun_at(cls, begin: float, seconds: float) -> Deadline:
        """Return the deadline that began when the clock was at `begin`."""
        deadline = cls(seconds)
        deadline._begin = begin
        return deadline

    def __call__(self) -> bool:
        """Return whether to stop now."""
        return self._stopped.is_set() or self.elapsed > self.seconds


def search_all(
    tasks: Iterable[Task],
    search: Callable[[Task], Candidate],
    deadline: Deadline,
    *,
    crew: Crew[Task, Candidate] | None = None,
    progress: Callable[[SearchProgress], None] | None = None,
) -> list[Candidate]:
    """Do the searches that the tasks ask for, here and by a crew, best first in the answer.

    A keyboard interrupt or the deadline ends them early and keeps what they have.

    Each search must look at the deadline itself; the first begins even where the time is up, so
    that there is an answer however slow the machine. The order does not depend on timing: equal
    values are ordered by number. What a lost crew was at is done here.
    """
    found: list[Candidate] = []
    waiting = deque(tasks)
    planned = len(waiting)
    pending: dict[Future[Candidate], Task] = {}
    own: Future[Candidate] | None = None
    with one_blas_thread(), ThreadPoolExecutor(max_workers=1) as here:
        try:
            while True:
                while waiting and not (deadline() and (found or pending)):
                    helped = own is not None
                    if helped and (crew is None or not crew.has_room):
                        break
                    task = waiting.popleft()
                    if crew is not None and helped:
                        future = crew.submit(task)
                    else:
                        future = own = here.submit(search, task)
                    pending[future] = task
                if not pending:
                    break
                for future in wait(pending, timeout=POLL, return_when=FIRST_COMPLETED).done:
                    task = pending.pop(future)
                    if future is not own and future.exception() is not None:
                        waiting.appendleft(task)
                        continue
                    own = None if future is own else own
                    found.append(future.result())
                if progress is not None:
                    best = max((candidate.value for candidate in found), default=-np.inf)
                    progress(
                        SearchProgress(
                            deadline.elapsed, deadline.seconds, len(found), planned, best
                        )
                    )
        except KeyboardInterrupt:
            deadline.stop()
            deadline.interrupted = True
            if crew is not None:
                crew.close()
            if own is not None:
                found.append(own.result())
    return best_first(found)


def best_first(candidates: Iterable[Candidate]) -> list[Candidate]:
    """Return the candidates that found something, best first.

    Equal ones in the order of their numbers.
    """
    return sorted(
        (candidate for candidate in candidates if np.isfinite(candidate.value)),
        key=lambda c: (-c.value, c.number),
    )
