"""What macOS and Windows lack or do otherwise, as far as Linux can show it."""

from __future__ import annotations

import ctypes
import os
import pickle
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest

from asbuilt import load_robot
from asbuilt.children import Child, is_running

ROOT = Path(__file__).parents[2]
ABSENT = ("fcntl", "grp", "pwd", "resource", "termios")
"""Modules that Windows has not."""
ELSEWHERE = f"""
import os, sys
sys.modules.update(dict.fromkeys({ABSENT}))  # importing None is an ImportError
del os.sched_getaffinity, os.sysconf  # macOS has not the first, Windows neither
from asbuilt.cli import main
main(sys.argv[1:])
"""
WITHOUT_FORK = """
import os
del os.fork, os.forkpty, os.register_at_fork
from asbuilt.executor import open_workers, run_in_order

def double(number):
    return 2 * number

if __name__ == "__main__":
    with open_workers(2) as workers:
        print(run_in_order(double, [1, 2, 3], workers))
"""
RESERVED = {"aux", "con", "nul", "prn", *(f"{kind}{n}" for kind in ("com", "lpt") for n in "123")}
"""Names that Windows gives to devices, whatever the suffix."""


def run_elsewhere(folder: Path, *words: str) -> str:
    """Return what a command prints to a console of Western Europe, without POSIX modules."""
    told = subprocess.run(
        [sys.executable, "-c", ELSEWHERE, *words],
        env=os.environ
        | {"PYTHONPATH": os.pathsep.join(sys.path)}
        | {"PYTHONIOENCODING": "cp1252", "PYTHONUTF8": "0"},
        cwd=folder,
        capture_output=True,
        check=False,
    )
    assert told.returncode == 0, told.stderr
    return told.stdout.decode("cp1252")


@pytest.mark.study
def test_a_study_without_posix_modules_on_a_console_of_western_europe(tmp_path: Path) -> None:
    """The log is one that Windows wrote, with CRLF at its line ends."""
    run_elsewhere(
        tmp_path, "simulate", "two-link", "--engine", "inverse-dynamics", "--out", "a.csv"
    )
    log = tmp_path / "a.csv"
    (tmp_path / "b.csv").write_bytes(log.read_bytes().replace(b"\n", b"\r\n"))
    printed = [run_elsewhere(tmp_path, "identify", "two-link", name) for name in ("a.csv", "b.csv")]
    assert printed[0].replace("a.csv", "b.csv") == printed[1]
    assert "\\u" not in printed[0], "a character that the console has not"
    assert "\r\r" not in printed[0]


@pytest.mark.study
def test_help_on_a_console_of_western_europe(tmp_path: Path) -> None:
    for words in (["-h"], ["identify", "-h"], ["drives"], ["base", "two-link"]):
        assert "\\u" not in run_elsewhere(tmp_path, *words), words


def test_workers_without_affinity_are_as_many_as_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    from asbuilt.executor import count_cores

    monkeypatch.delattr(os, "sched_getaffinity", raising=False)
    assert count_cores() == os.cpu_count()


def test_workers_are_started_anew_where_nothing_can_fork(tmp_path: Path) -> None:
    """Windows has no fork: workers import what they need, and the caller's module again."""
    script = tmp_path / "study.py"
    script.write_text(WITHOUT_FORK, encoding="utf-8")
    told = subprocess.run(
        [sys.executable, script],
        env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert told.returncode == 0, told.stderr
    assert told.stdout.split() == ["[2,", "4,", "6]"]


def test_a_child_without_limits_answers() -> None:
    child = Child({})
    hidden = "[bytes(str(m.update(resource=None)), 'ascii')]"
    sent = pickle.dumps((eval, (hidden, {"m": _ModulesThere()})))
    assert child.call(sent) == [b"None"]
    sent = pickle.dumps((eval, ("[bytes(str('resource' in m), 'ascii')]", {"m": _ModulesThere()})))
    assert child.call(sent, memory=1 << 30, seconds=10.0) == [b"True"]
    child.end()


class _ModulesThere:
    """The modules of the process where it arrives."""

    def __reduce__(self) -> tuple[object, ...]:
        return eval, ("__import__('sys').modules",)


def test_looking_for_a_process_of_windows_sends_it_no_signal(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Signal 0, which asks elsewhere, is Ctrl-C there."""

    class Kernel:
        """The three functions, with this process as the only one."""

        class OpenProcess:
            def __new__(cls, access: int, inherit: bool, process: int) -> object:
                return 4 if process == os.getpid() else None

        def WaitForSingleObject(self, handle: ctypes.c_void_p, patience: int) -> int:  # noqa: N802
            return 0x102 if handle.value == 4 else 0xFFFFFFFF

        def CloseHandle(self, handle: ctypes.c_void_p) -> None: ...  # noqa: N802

    def refuse(process: int, number: int) -> None:
        raise AssertionError(f"signal {number} for {process}")

    monkeypatch.setattr(sys, "platform", "win32")
    monkeypatch.setattr(ctypes, "WinDLL", lambda name: Kernel(), raising=False)
    monkeypatch.setattr(os, "kill", refuse)
    assert is_running(os.getpid())
    assert not is_running(os.getpid() + 1)


def test_a_description_with_line_ends_of_windows(tmp_path: Path) -> None:
    text = (ROOT / "src/asbuilt/description/robots/two-link.toml").read_bytes()
    assert b"\r" not in text
    for name, ends in (("unix", b"\n"), ("windows", b"\r\n")):
        (tmp_path / f"{name}.toml").write_bytes(text.replace(b"\n", ends))
    unix, windows = (load_robot(tmp_path / f"{name}.toml") for name in ("unix", "windows"))
    assert unix.joint_names == windows.joint_names
    assert repr(unix.links) == repr(windows.links)


def test_every_file_has_a_name_on_every_system() -> None:
    """File systems of macOS and Windows take `A` for `a`, and some names for devices."""
    paths = [
        each.relative_to(ROOT)
        for folder in ("src", "tests", "docs", "examples", "benchmarks", ".github")
        for each in (ROOT / folder).rglob("*")
        if "__pycache__" not in each.parts
    ]
    assert paths
    twice = [name for name, n in Counter(str(each).lower() for each in paths).items() if n > 1]
    assert not twice
    parts = {part for each in paths for part in each.parts}
    assert not [part for part in parts if part.split(".")[0].lower() in RESERVED]
    assert not [part for part in parts if set(part) & set('<>:"|?*\\') or part[-1] in ". "]
