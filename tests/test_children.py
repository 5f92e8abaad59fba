"""Functions in child processes: what they may see and take, and how they end."""

from __future__ import annotations

import os
import pickle
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from asbuilt import children
from asbuilt.children import Child, ChildEnded, ChildPool


def call(child: Child, function: Callable[..., Any], *arguments: Any, **limits: Any) -> bytes:
    (answer,) = child.call(pickle.dumps((function, arguments)), **limits)
    return bytes(answer)


def test_a_child_of_a_stranger_has_neither_environment_nor_site(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("SECRET", "42")
    seen = []
    for trusted in (False, True):
        child = Child({"OWN": "1"}, trusted=trusted)
        code = "bytes(repr((os.getenv('SECRET'), os.getenv('OWN'), sys.flags.no_site)), 'ascii')"
        seen.append(call(child, eval, f"[{code}]", _modules()))
        assert child.end() == 0
    assert seen == [b"(None, '1', 1)", b"('42', '1', 0)"]


def _modules() -> dict[str, Any]:
    return {"os": _Imported("os"), "sys": _Imported("sys")}


class _Imported:
    """A module that is imported where it arrives."""

    def __init__(self, name: str) -> None:
        self.name = name

    def __reduce__(self) -> tuple[Any, ...]:
        return __import__, (self.name,)


def test_arrays_come_back_to_the_last_bit_and_one_child_answers_many_calls() -> None:
    child = Child({})
    for n in (0, 1, 100_000):
        (answer,) = child.call(pickle.dumps((_listed, (np.arange(n) / 3.0,))))
        np.testing.assert_array_equal(np.frombuffer(answer), np.arange(n) / 3.0)
    assert child.calls == 3
    child.end()


_listed = np.atleast_2d


@pytest.mark.parametrize(
    ("function", "arguments", "limits", "status"),
    [
        (sum, (range(10**12),), {"seconds": 0.2}, -signal.SIGPROF),
        (signal.raise_signal, (signal.SIGKILL,), {}, -signal.SIGKILL),
        (os._exit, (3,), {}, 3),
        (np.zeros, ((1, 10**9),), {"memory": 10**8}, 1),
    ],
)
def test_a_child_that_ends_says_how(
    function: Callable[..., Any], arguments: Any, limits: Any, status: int
) -> None:
    with pytest.raises(ChildEnded) as caught:
        call(Child({}), function, *arguments, **limits)
    assert caught.value.status == status


def test_an_answer_beyond_its_size_is_refused() -> None:
    child = Child({})
    with pytest.raises(ChildEnded):
        call(child, _listed, np.zeros(1000), largest=7999)
    assert not child.is_usable


def test_a_pool_that_is_closed_gives_up_what_is_under_way() -> None:
    pool = ChildPool(2, {})
    assert pool.submit(abs, -2).result() == 2
    sleeping = [pool.submit(time.sleep, 3600) for _ in range(3)]
    began = time.monotonic()
    time.sleep(0.2)
    pool.close()
    assert all(each.cancelled() or each.exception() for each in sleeping)
    # Far less than they sleep, on a busy machine, too.
    assert time.monotonic() - began < 1800.0


def test_folders_of_a_process_that_was_killed_are_removed_by_the_next(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    program = (
        "import time; from asbuilt.children import open_scratch; folder = open_scratch();"
        " print(folder.name, flush=True); time.sleep(60)"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", program],
        env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path), "TMPDIR": str(tmp_path)},
        stdout=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    left = Path(process.stdout.readline().strip())
    (left / "unpacked").write_bytes(bytes(1000))
    foreign = tmp_path / left.name.replace(children.HOST, "elsewhere")
    foreign.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    children.remove_scratch()
    assert left.exists()  # its process runs
    process.kill()
    process.wait()
    children.remove_scratch()
    assert not left.exists()
    assert foreign.exists()
