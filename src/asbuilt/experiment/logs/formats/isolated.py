"""Binary logs of unknown origin, read in another process with limits of memory and time.

A process that starts costs more than most files take to read, so one that has read a file well
reads the next. It gains nothing that it lacked: it is no prison, it only takes crashes, memory and
time upon itself. One that has met an error is not used again.
"""

from __future__ import annotations

import atexit
import contextlib
import ctypes
import importlib
import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, cast

import numpy as np

from asbuilt.errors import AsbuiltError, MissingExtraError, RecordingError
from asbuilt.experiment.logs.formats.log_format import LogTable
from asbuilt.findings import Cure
from asbuilt.isolation import isolated_command, isolated_environment
from asbuilt.untrusted import check_regular, reason

PROGRAM = "from asbuilt.experiment.logs.formats.isolated import serve; serve({parent})"
DIES_WITH_PARENT = 1
"""PR_SET_PDEATHSIG of Linux."""
MOST_FILES = 500
"""Files that a process reads before another takes its place, lest its memory grow."""
LARGEST_KEPT = 32e6
"""Size of a file [bytes] beyond which its process is not kept: memory that it took may stay, 240 MB
after an hour of seven joints at 100 Hz, which has 25 MB as Parquet.
"""


@dataclass(frozen=True, slots=True)
class Limits:
    """Limit what one file may cost.

    Parameters
    ----------
    size
        Largest file [bytes]; longer recordings are streamed from Parquet or text.
    memory, memory_ratio
        Bytes beside those of the libraries, and further bytes per byte of the file; arrays of
        doubles compress to a tenth, seldom further.
    time, time_ratio
        Seconds, and further seconds per byte of the file; bags are decoded at about 1 MB/s.
    columns
        Most columns of a log; 30 joints with 10 quantities have 300.
    """

    size: float = 4e9
    memory: float = 512e6
    memory_ratio: float = 16.0
    time: float = 10.0
    time_ratio: float = 2e-6
    columns: int = 10_000

    def memory_for(self, n_bytes: float) -> int:
        """Return the memory [bytes] that a file of this size may take."""
        return int(self.memory + self.memory_ratio * n_bytes)

    def time_for(self, n_bytes: float) -> float:
        """Return the time [s] that a file of this size may take."""
        return self.time + self.time_ratio * n_bytes


LIMITS = Limits()


def read_isolated(read: Callable[..., LogTable], path: Path, **settings: str | None) -> LogTable:
    """Return what `read(path, **settings)` returns, called in a process of its own.

    Parameters
    ----------
    read
        A function of a module; the other process imports it by name.
    path
        The file, or the folder of a bag.
    settings
        Further arguments of `read`.

    Raises
    ------
    RecordingError
        As `read` does; and for whatever else it raises, for a crash, or beyond `LIMITS`.
    MissingExtraError
        As `read` does.
    """
    size = _size(path)
    answer, arrays = _call(read, path, size, settings)
    if "error" in answer:
        raise _error(answer["error"], path)
    table = answer["table"]
    return LogTable(
        source=str(path),
        columns=dict(zip(table["columns"], arrays, strict=True)),
        named=bool(table["named"]),
        text_columns=tuple(table["text_columns"]),
        known={name: (what, joint) for name, (what, joint) in table["known"].items()},
        notes=tuple(table["notes"]),
        order=tuple(table["order"]),
    )


class _Reader:
    """A process that reads one file after another."""

    def __init__(self) -> None:
        self._process = subprocess.Popen(
            isolated_command(PROGRAM.format(parent=os.getpid())),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env=isolated_environment({"OPENBLAS_NUM_THREADS": "1", "POLARS_MAX_THREADS": "2"}),
        )
        self._made_by = (os.getpid(), tuple(sys.path))
        self.files = 0

    @property
    def is_usable(self) -> bool:
        """Whether it still runs, and was started by this process with the same modules."""
        mine = self._made_by == (os.getpid(), tuple(sys.path))
        return mine and self._process.poll() is None

    def answer(self, request: Mapping[str, Any], most: int) -> tuple[dict[str, Any], list[Any]]:
        """Return the answer to a request and its columns; `EOFError` if the process ends."""
        self.files += 1
        stdin, stdout = cast(BinaryIO, self._process.stdin), cast(BinaryIO, self._process.stdout)
        with contextlib.suppress(BrokenPipeError):
            stdin.write(json.dumps(request).encode() + b"\n")
            stdin.flush()
        found = _received(stdout, most)
        if found is None:
            raise EOFError
        return found

    def end(self) -> int:
        """End the process if it runs, and return its exit status."""
        if self._made_by[0] != os.getpid():
            return 0
        for stream in (self._process.stdin, self._process.stdout):
            with contextlib.suppress(OSError):
                cast(BinaryIO, stream).close()
        try:
            return self._process.wait(ENDING)
        except subprocess.TimeoutExpired:
            self._process.kill()
            return self._process.wait()


ENDING = 0.5
"""Seconds that a process is given to end by itself, as one that has no more requests does."""
_idle: list[_Reader] = []


@atexit.register
def _end_idle() -> None:
    while _idle:
        _idle.pop().end()


def _call(
    read: Callable[..., Any], path: Path, size: float, settings: Mapping[str, Any]
) -> tuple[dict[str, Any], list[Any]]:
    """Return the answer of another process, and the columns that follow it.

    A process that was idle may end before it sees the request; then another one is asked.
    """
    request = {
        "module": read.__module__,
        "function": read.__name__,
        "path": str(path),
        "folder": str(Path.cwd()),
        "settings": dict(settings),
        "memory": LIMITS.memory_for(size),
        "time": LIMITS.time_for(size),
    }
    while True:
        reader = _taken() or _Reader()
        try:
            answer, columns = reader.answer(request, LIMITS.memory_for(size))
        except EOFError:
            status = reader.end()
            if reader.files > 1:
                continue
            return {"error": _crash(path, size, status)}, []
        except BaseException:
            reader.end()
            raise
        if "error" in answer or size > LARGEST_KEPT or reader.files >= MOST_FILES:
            reader.end()
        else:
            _idle.append(reader)
        return answer, columns


def _taken() -> _Reader | None:
    """Return an idle process that can be used."""
    while _idle:
        with contextlib.suppress(IndexError):
            reader = _idle.pop()
            if reader.is_usable:
                return reader
            reader.end()
    return None


def _received(stream: BinaryIO, most: int) -> tuple[dict[str, Any], list[Any]] | None:
    """Return the answer and its columns, None if the other process ended before."""
    head = stream.readline()
    if not head.endswith(b"\n"):
        return None
    answer = json.loads(head)
    columns: list[Any] = []
    for _ in answer.get("table", {}).get("columns", ()):
        n = int(answer["table"]["n_samples"])
        if 8 * n * len(answer["table"]["columns"]) > most:
            return None
        values = np.empty(n)
        view = memoryview(values.data).cast("B")
        while view.nbytes:
            got = stream.readinto(view)  # type: ignore[attr-defined]
            if not got:
                return None
            view = view[got:]
        columns.append(values)
    return answer, columns


def _crash(path: Path, size: float, status: int) -> dict[str, Any]:
    if -status in (signal.SIGALRM, signal.SIGXCPU):
        what = f"takes longer than {LIMITS.time_for(size):.0f} s to read"
    elif status < 0:
        what = f"crashes its reader ({signal.Signals(-status).name})"
    else:
        what = f"ends its reader with status {status}"
    return {"kind": "RecordingError", "message": f"{path} is damaged: it {what}"}


def _error(error: Mapping[str, Any], path: Path) -> AsbuiltError:
    if error["kind"] == "MissingExtraError":
        return MissingExtraError(error["package"], error["extra"], f"reading {path}")
    cure = error.get("cure") or "record or export it again"
    fields = {"file": str(path)} | error.get("fields", {})
    return RecordingError(error["message"], cure=Cure(cure), **fields)


def _size(path: Path) -> float:
    """Return the size [bytes] of a regular file or of those of a folder."""
    files = [path, *path.rglob("*")] if path.is_dir() else [path]
    for file in files:
        if not file.is_dir():
            check_regular(file, "recording", RecordingError, LIMITS.size)
    return float(sum(file.stat().st_size for file in files))


def serve(parent: int) -> None:
    """Answer requests from stdin on stdout until there are no more; what this process runs."""
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    _end_with(parent)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    for line in sys.stdin.buffer:
        answer, columns = _answer(json.loads(line))
        answers.write(json.dumps(answer).encode() + b"\n")
        for values in columns:
            answers.write(np.ascontiguousarray(values, dtype=np.float64).data)
        answers.flush()
        _unlimited()
    os._exit(0)


def _answer(request: Mapping[str, Any]) -> tuple[dict[str, Any], list[Any]]:
    path = Path(request["path"])
    try:
        os.chdir(request["folder"])
        read = getattr(importlib.import_module(request["module"]), request["function"])
        _limit(request["memory"], request["time"])
        table: LogTable = read(path, **request["settings"])
        if len(table.columns) > LIMITS.columns:
            raise RecordingError(
                f"{path} has {len(table.columns)} columns; at most {LIMITS.columns} are read"
            )
    except MissingExtraError as error:
        return {"error": {"kind": "MissingExtraError", **error.fields}}, []
    except AsbuiltError as error:
        fields = {k: v for k, v in error.fields.items() if isinstance(v, str | int | list)}
        cure = str(error.cure or "")
        return {"error": {"kind": "", "message": error.message, "cure": cure, "fields": fields}}, []
    except MemoryError:
        message = f"{path} needs more than {request['memory'] / 1e6:.0f} MB to read"
        return {"error": {"kind": "", "message": message}}, []
    except BaseException as error:
        said = f"{type(error).__name__}: {reason(error)}"
        message = f"{path} is not a recording: it cannot be read as {path.suffix} ({said})"
        return {"error": {"kind": "", "message": message}}, []
    document = {
        "columns": list(table.columns),
        "n_samples": table.n_samples,
        "named": table.named,
        "text_columns": list(table.text_columns),
        "known": {name: list(each) for name, each in table.known.items()},
        "notes": list(table.notes),
        "order": list(table.order),
    }
    return {"table": document}, list(table.columns.values())


def _limit(memory: int, seconds: float) -> None:
    """Limit memory beyond what is used already, and time, where the system can."""
    try:
        import resource  # noqa: PLC0415 - not on Windows
    except ImportError:
        return
    with contextlib.suppress(OSError, ValueError):
        used = int(Path("/proc/self/statm").read_text().split()[5]) * resource.getpagesize()
        most = resource.getrlimit(resource.RLIMIT_DATA)[1]
        resource.setrlimit(resource.RLIMIT_DATA, (used + memory, most))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    signal.setitimer(signal.ITIMER_REAL, seconds)


def _unlimited() -> None:
    """Lift the limits of `_limit`, between requests."""
    try:
        import resource  # noqa: PLC0415 - not on Windows
    except ImportError:
        return
    signal.setitimer(signal.ITIMER_REAL, 0.0)
    with contextlib.suppress(OSError, ValueError):
        most = resource.getrlimit(resource.RLIMIT_DATA)[1]
        resource.setrlimit(resource.RLIMIT_DATA, (most, most))


def _end_with(parent: int) -> None:
    """Have this process killed when its parent dies, where the system can."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(DIES_WITH_PARENT, signal.SIGKILL)
        if os.getppid() != parent:
            os._exit(1)
