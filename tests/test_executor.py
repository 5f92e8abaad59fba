"""Tasks on a process pool: order, failures, and processes that are killed."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest

from asbuilt.errors import UsageError
from asbuilt.executor import open_workers


def square(number: int) -> int:
    if number == 3:
        raise ValueError("three is refused")
    return number * number


def marked(task: tuple[int, str]) -> int:
    """Kill the own process: for -1 always, for -2 the first time."""
    number, folder = task
    mark = Path(folder) / str(number)
    if number == -1 or (number == -2 and not mark.exists()):
        mark.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return number


def test_every_task_has_an_outcome_and_few_are_drawn_ahead() -> None:
    drawn = []

    def tasks() -> Iterator[int]:
        for number in range(100):
            drawn.append(number)
            yield number

    with open_workers(0) as workers:
        outcomes = workers.run(square, tasks())
        first = next(outcomes)
        assert len(drawn) < 100
        found = {each.task: (each.result, each.problem) for each in [first, *outcomes]}
    assert found.pop(3) == (None, "ValueError: three is refused")
    assert found == {number: (number * number, None) for number in range(100) if number != 3}


def test_a_killed_process_costs_the_task_that_kills_it(tmp_path: Path) -> None:
    tasks = [(number, str(tmp_path)) for number in (1, 2, -1, 3, -2, *range(4, 12))]
    with open_workers(2) as workers:
        found = {each.task[0]: each for each in workers.run(marked, tasks)}
    assert set(found) == {task[0] for task in tasks}
    assert found[-1].result is None
    assert "killed" in str(found[-1].problem)
    assert {each.result for number, each in found.items() if number != -1} == set(found) - {-1}


def test_wrong_workers_are_refused() -> None:
    with pytest.raises(UsageError, match="0 or more, got -1"), open_workers(-1):
        pass
