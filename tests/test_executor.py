"""Tasks on a process pool: order, failures, and processes that are killed."""

from __future__ import annotations

import contextlib
import os
import random
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from asbuilt.errors import AsbuiltError, UsageError
from asbuilt.executor import Workers, open_workers, run_in_order


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


def halved(number: int) -> int | None:
    if number % 2:
        raise UsageError(f"{number} is odd", value=number)
    return None if number == 4 else number // 2


def lost(number: int) -> int:
    if number == 2:
        os.kill(os.getpid(), signal.SIGKILL)
    return number


@pytest.mark.parametrize("count", [None, 0, 2])
def test_results_come_in_the_order_of_their_tasks(count: int | None) -> None:
    def check(workers: Workers | None) -> None:
        assert run_in_order(halved, range(0, 12, 2), workers) == [0, 1, None, 3, 4, 5]
        assert run_in_order(halved, [], workers) == []
        with pytest.raises(UsageError) as caught:
            run_in_order(halved, [2, 5, 4, 3], workers)
        assert caught.value.fields["value"] == 5

    if count is None:
        check(None)
        return
    with open_workers(count) as workers:
        check(workers)


def test_a_task_whose_process_dies_is_an_error() -> None:
    with open_workers(1) as workers, pytest.raises(AsbuiltError, match="killed"):
        run_in_order(lost, [1, 2, 3], workers)


def test_modules_in_the_current_folder_are_not_run(tmp_path: Path) -> None:
    """Python searches the current folder first unless it is told not to."""
    for name in ("cloudpickle", "json", "numpy", "signal"):
        (tmp_path / f"{name}.py").write_text(f"open({str(tmp_path / 'ran')!r}, 'w')\n")
    code = (
        "from asbuilt.executor import open_workers\n"
        "with open_workers(1) as workers:\n"
        "    print(sorted(each.result for each in workers.run(abs, [-1, -2])))"
    )
    done = subprocess.run(
        [sys.executable, "-P", "-c", code], cwd=tmp_path, capture_output=True, check=False,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(each for each in sys.path if each)},
    )  # fmt: skip
    assert done.stdout == b"[1, 2]\n", done.stderr
    assert not (tmp_path / "ran").exists()


def said_by(kind: str, connection: socket.socket) -> None:
    """Answer as something that is no scheduler does."""
    with contextlib.suppress(OSError):
        if kind == "http":
            connection.sendall(b"HTTP/1.1 400 Bad Request\r\n\r\n")
        elif kind == "huge":
            connection.sendall(struct.pack("<QQ", 1, 2**62) + bytes(100))
        elif kind == "random":
            connection.sendall(random.Random(1).randbytes(4096))
        elif kind == "traceback":
            connection.sendall(struct.pack("<QQ", 16, 1) + b"\x80\x04K\x01." * 9)
        if kind in ("http", "closed"):
            connection.close()


@pytest.mark.parametrize("kind", ["http", "closed", "huge", "random", "traceback",
    pytest.param("silent", marks=pytest.mark.study)])  # fmt: skip
def test_what_is_no_scheduler_is_one_error(kind: str, capfd: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("distributed")
    kept = []

    def serve() -> None:
        while True:
            kept.append(server.accept()[0])
            said_by(kind, kept[-1])

    began = time.monotonic()
    with socket.create_server(("127.0.0.1", 0)) as server:
        threading.Thread(target=serve, daemon=True).start()
        address = f"tcp://127.0.0.1:{server.getsockname()[1]}"
        with (
            pytest.raises(UsageError, match="no Dask scheduler answers at tcp"),
            open_workers(scheduler=address),
        ):
            pass
    # It does not wait for ever, as it would for each of many tries.
    assert time.monotonic() - began < 600.0
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("address", ["", "here", "inproc://", "tcp://x", "file:1/2", "a" * 10**5])
def test_what_is_no_address_is_refused_unasked(address: str) -> None:
    with pytest.raises(UsageError, match="is no address") as caught, open_workers(None, address):
        pass
    assert len(str(caught.value)) < 200
