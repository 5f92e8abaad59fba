from __future__ import annotations

import math
import os
import pickle
import threading
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager

import numpy as np
import pytest

from asbuilt.excitation.design.multistart import Candidate, Deadline, search_all
from asbuilt.excitation.design.process_pool import Crew


@contextmanager
def ready(work, size: int = 1) -> Iterator[Crew]:
    """A crew that has loaded what it needs."""
    with closing(Crew(work, size)) as crew:
        end = time.monotonic() + 60
        while not crew.has_room and time.monotonic() < end:
            time.sleep(0.05)
        yield crew


def test_a_crew_does_its_work_and_says_when_it_is_full() -> None:
    with ready(math.sqrt) as crew:
        future = crew.submit(9.0)
        assert not crew.has_room or future.done()
        assert future.result(timeout=60) == 3.0
    assert not crew.has_room


def test_nobody_beside_this_process_is_no_crew() -> None:
    with closing(Crew(math.sqrt, 0)) as crew:
        assert not crew.has_room


def test_work_that_cannot_be_handed_over_is_done_here() -> None:
    with closing(Crew(threading.Lock().acquire, 1)) as crew:
        assert not crew.has_room


def candidate(number: int) -> Candidate:
    return Candidate(number, np.zeros((1, 1)), float(number))


def slow(number: int) -> Candidate:
    time.sleep(0.02)
    return candidate(number)


def test_what_a_lost_crew_was_at_is_done_here() -> None:
    with ready(os._exit) as crew:
        found = search_all(range(30), slow, Deadline(60.0), crew=crew)
    assert [each.number for each in found] == list(range(30))[::-1]


def test_an_interrupt_keeps_what_was_found() -> None:
    def stop(state) -> None:
        if state.finished >= 3:
            raise KeyboardInterrupt

    deadline = Deadline(60.0)
    with ready(time.sleep) as crew:
        found = search_all(range(1000, 1030), slow, deadline, crew=crew, progress=stop)
    assert 3 <= len(found) < 30
    assert deadline.interrupted
    assert deadline()


def test_a_deadline_is_the_same_elsewhere() -> None:
    deadline = Deadline(100.0)
    there = pickle.loads(pickle.dumps(deadline))
    assert there.elapsed == pytest.approx(deadline.elapsed, abs=0.05)
    assert there.seconds == 100.0
    assert pickle.loads(pickle.dumps(Deadline(-1.0)))()
