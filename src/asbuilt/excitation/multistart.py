"""Many starts on all cores: the best of several local searches, with progress and an end on demand."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import dataclass

import numpy as np

from asbuilt.dynamics.blas import one_blas_thread
from asbuilt.excitation.motion import Array

POLL = 0.2


@dataclass(frozen=True, eq=False)
class Candidate:
    """What one local search found: coefficients and value, minus infinity where it found nothing."""

    number: int
    coefficients: Array
    value: float


@dataclass(frozen=True, slots=True)
class SearchProgress:
    """How a phase of a design stands: seconds since it began, of those it has; searches finished, of those planned; the best value so far."""

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
    """Say when to stop: after `seconds`, or once `stop` was called from anywhere; `interrupted` where a keyboard interrupt called it."""

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

    def __call__(self) -> bool:
        """Return whether to stop now."""
        return self._stopped.is_set() or self.elapsed > self.seconds


def cores() -> int:
    """Return the number of cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def search_all(
    searches: Sequence[Callable[[], Candidate]],
    deadline: Deadline,
    *,
    threads: int | None = None,
    progress: Callable[[SearchProgress], None] | None = None,
) -> list[Candidate]:
    """Run the searches, best first in the answer; a keyboard interrupt or the deadline ends them early and keeps what they have.

    Each search must look at the deadline itself; the first begins even where the time is up, so that there is an answer however slow the machine. The order does not depend on timing: equal values are ordered by number.
    """
    found: list[Candidate] = []
    count = min(len(searches), threads or cores())
    with one_blas_thread(), ThreadPoolExecutor(max_workers=max(count, 1)) as pool:
        waiting = iter(searches)
        pending: set[Future[Candidate]] = set()
        try:
            while True:
                while len(pending) < count and not (deadline() and (found or pending)):
                    following = next(waiting, None)
                    if following is None:
                        break
                    pending.add(pool.submit(following))
                if not pending:
                    break
                done, pending = wait(pending, timeout=POLL, return_when=FIRST_COMPLETED)
                found += [future.result() for future in done]
                if progress is not None:
                    best = max((candidate.value for candidate in found), default=-np.inf)
                    progress(SearchProgress(deadline.elapsed, deadline.seconds, len(found), len(searches), best))
        except KeyboardInterrupt:
            deadline.stop()
            deadline.interrupted = True
            found += [future.result() for future in pending]
    return best_first(found)


def best_first(candidates: Iterable[Candidate]) -> list[Candidate]:
    """Return the candidates that found something, best first; equal ones in the order of their numbers."""
    return sorted((candidate for candidate in candidates if np.isfinite(candidate.value)), key=lambda c: (-c.value, c.number))
