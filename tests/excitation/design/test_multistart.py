from __future__ import annotations

import math
import os
import pickle
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from asbuilt.excitation.design.interior_point import Optimum
from asbuilt.excitation.design.multistart import (
    Deadline,
    SearchPool,
    open_pool,
    search_all,
)


@contextmanager
def ready(work, size: int = 1) -> Iterator[SearchPool]:
    """A pool that has loaded what it needs."""
    with open_pool(work, size) as pool:
        end = time.monotonic() + 600
        while not pool.is_free and time.monotonic() < end:
            time.sleep(0.05)
        yield pool


def awaited(file: Path) -> str:
    """Return the name of a file once it exists."""
    while not file.exists():
        time.sleep(0.01)
    return file.name


def test_a_pool_does_its_work_and_says_when_it_is_full(tmp_path: Path) -> None:
    with ready(awaited) as pool:
        future = pool.submit(tmp_path / "go")
        assert not pool.is_free
        (tmp_path / "go").touch()
        assert future.result() == "go"
    assert not pool.is_free


def test_nobody_beside_this_process_is_no_pool() -> None:
    with open_pool(math.sqrt, 0) as pool:
        assert not pool.is_free


def test_work_that_cannot_be_handed_over_is_done_here() -> None:
    with open_pool(threading.Lock().acquire, 1) as pool:
        assert not pool.is_free


def candidate(number: int) -> Optimum:
    return Optimum(np.zeros((1, 1)), float(number), number=number)


def slow(number: int) -> Optimum:
    time.sleep(0.02)
    return candidate(number)


def test_what_a_lost_pool_was_at_is_done_here() -> None:
    with ready(os._exit) as pool:
        found = search_all(range(30), slow, Deadline(60.0), pool=pool)
    assert [each.number for each in found] == list(range(30))[::-1]


def test_an_interrupt_keeps_what_was_found() -> None:
    def stop(state) -> None:
        if state.finished >= 3:
            raise KeyboardInterrupt

    deadline = Deadline(60.0)
    with ready(time.sleep) as pool:
        found = search_all(range(1000, 1030), slow, deadline, pool=pool, progress=stop)
    assert 3 <= len(found) < 30
    assert deadline.interrupted
    assert deadline()


def test_a_deadline_is_the_same_elsewhere() -> None:
    deadline = Deadline(100.0)
    there = pickle.loads(pickle.dumps(deadline))
    assert there.elapsed == pytest.approx(deadline.elapsed, abs=0.05)
    assert there.seconds == 100.0
    assert pickle.loads(pickle.dumps(Deadline(-1.0)))()
