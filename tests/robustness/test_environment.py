"""What the surroundings of a command may do: no terminal, no space, no cache, no mercy."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

LINUX = pytest.mark.skipif(sys.platform != "linux", reason="needs /proc and /dev/full")
ASBUILT = (sys.executable, "-m", "asbuilt")


def environment(**more: str) -> dict[str, str]:
    return os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)} | more


@pytest.mark.study
def test_ascii_output() -> None:
    told = subprocess.run(
        [*ASBUILT, "base", "two-link"], env=environment(PYTHONIOENCODING="ascii", PYTHONUTF8="0"),
        capture_output=True, check=False,
    )  # fmt: skip
    assert told.returncode == 0, told.stderr
    told.stdout.decode("ascii")


@LINUX
@pytest.mark.parametrize(
    ("words", "where"),
    [
        ("show two-link", "--json >&-"),
        ("-h", ">&-"),
        ("fleet show /nowhere", "--json | true"),
        ("-h", "0<&- >&- 2>&-"),
        *(
            pytest.param(words, where, marks=pytest.mark.study)
            for words, ways in (
                (
                    "show two-link",
                    (
                        ">/dev/full",
                        "| head -c 1",
                        "--json | true",
                        ">&-",
                        "2>&-",
                        ">&- 2>&-",
                        "0<&- >&- 2>&-",
                    ),
                ),
                ("-h", (">/dev/full", "2>&-", ">&- 2>&-", "| head -c 1")),
            )
            for where in ways
        ),
    ],
)
def test_output_that_goes_nowhere(words: str, where: str) -> None:
    command = f"{sys.executable} -m asbuilt {words} {where}"
    told = subprocess.run(
        ["bash", "-c", command], env=environment(), capture_output=True, check=False
    )
    assert b"Traceback" not in told.stderr
    assert b"Exception ignored" not in told.stderr
    assert b"unexpected" not in told.stderr
    if "&-" in where:
        assert told.returncode == 0, told.stderr
    if "full" in where:
        assert told.returncode == 1
        assert b"No space left" in told.stderr


@LINUX
@pytest.mark.parametrize(
    "where",
    [
        "2>/dev/full",
        *(
            pytest.param(where, marks=pytest.mark.study)
            for where in ("--json >&-", "2>&-", ">&- 2>&-")
        ),
    ],
)
def test_errors_that_go_nowhere(where: str) -> None:
    command = f"{sys.executable} -m asbuilt show nothing.urdf {where}"
    told = subprocess.run(
        ["bash", "-c", command], env=environment(), capture_output=True, check=False
    )
    assert told.returncode == 1
    assert b"Traceback" not in told.stdout + told.stderr
    assert b"unexpected" not in told.stdout + told.stderr


@LINUX
@pytest.mark.study
def test_no_writable_cache(tmp_path: Path) -> None:
    """Numba keeps machine code beside the source or in a folder; here it can in neither."""
    code = (
        "from numba.core import caching;"
        "caching.CacheImpl._locator_classes = [];"
        "import asbuilt.experiment.signal.parallel_filter as f, numpy as np;"
        "print(f.design_parallel_filter(5.0, 100.0).apply(np.ones((1, 500))).mean())"
    )
    told = subprocess.run(
        [sys.executable, "-c", code], env=environment(), capture_output=True, check=False
    )
    assert told.returncode == 0, told.stderr
    assert float(told.stdout) == pytest.approx(1.0)


@LINUX
@pytest.mark.parametrize(
    "how", [signal.SIGKILL, pytest.param(signal.SIGTERM, marks=pytest.mark.study)]
)
def test_workers_die_with_their_parent(how: int) -> None:
    code = (
        "from asbuilt.excitation.design.multistart import open_pool; import time\n"
        "with open_pool(abs, 1) as pool:\n"
        "    while not pool.is_free: time.sleep(0.05)\n"
        "    print('ready', flush=True); time.sleep(600)"
    )
    parent = subprocess.Popen(
        [sys.executable, "-c", code], env=environment(MARK_OF_TEST=str(time.time())),
        stdout=subprocess.PIPE, start_new_session=True,
    )  # fmt: skip
    assert parent.stdout is not None
    assert parent.stdout.readline() == b"ready\n"
    assert len(session(parent.pid)) > 1
    parent.send_signal(how)
    parent.wait()
    for _ in range(600):
        if not session(parent.pid):
            return
        time.sleep(0.1)
    pytest.fail(f"left behind: {session(parent.pid)}")


def session(leader: int) -> list[int]:
    """Processes of a session that still run."""
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            fields = (folder / "stat").read_text().rpartition(")")[2].split()
        except OSError:
            continue
        if int(fields[3]) == leader and fields[0] != "Z":
            found.append(int(folder.name))
    return found


@LINUX
@pytest.mark.parametrize("delay", [0.0, 0.1, 0.2, 0.3, 0.6])
def test_interrupt_while_modules_are_imported(delay: float) -> None:
    code = """
import sys
from asbuilt.cli import run

class Finder:
    @staticmethod
    def find_spec(name, *rest):
        if name == "asbuilt.cli.app":
            print("ready", flush=True)

sys.meta_path.insert(0, Finder)
sys.argv = ["asbuilt", "base", "ur10e"]
run()
"""
    command = subprocess.Popen(
        [sys.executable, "-c", code],
        env=environment(),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )
    assert command.stdout is not None
    assert command.stdout.readline() == b"ready\n"
    time.sleep(delay)
    command.send_signal(signal.SIGINT)
    said = command.communicate()[1]
    assert b"Traceback" not in said, said
    assert b"KeyboardInterrupt" not in said, said
