"""Binary logs of unknown origin, read in another process with limits of memory and time.

A process that has read a file well reads the next; one that has met an error is not used again.
"""

from __future__ import annotations

import atexit
import contextlib
import json
import pickle
import signal
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from asbuilt import children
from asbuilt.children import Child, ChildEnded
from asbuilt.errors import AsbuiltError, MissingExtraError, RecordingError
from asbuilt.experiment.logs.formats.log_format import LogTable
from asbuilt.findings import Cure
from asbuilt.untrusted import check_regular, describe_problem

MOST_FILES = 500
"""Files that a process reads before another takes its place, lest its memory grow."""


@dataclass(frozen=True, slots=True)
class Limits:
    """Limit what one file may cost.

    Parameters
    ----------
    size
        Largest file [bytes]; longer recordings are streamed from Parquet or text.
    memory, memory_ratio
        Bytes in addition to the libraries', and further bytes per byte of the file; arrays of
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
    answer, arrays = _call(read, path, _measure_size(path), settings)
    if "error" in answer:
        raise _rebuild_error(answer["error"], path)
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


_idle: list[Child] = []


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
    memory = LIMITS.memory_for(size)
    request = pickle.dumps((_answer, (read, path, dict(settings), memory)))
    while True:
        child = _take_idle() or Child({"OPENBLAS_NUM_THREADS": "1", "POLARS_MAX_THREADS": "2"})
        try:
            content, *columns = child.call(
                request, children.Limits(memory, LIMITS.time_for(size), memory)
            )
        except ChildEnded as ended:
            if child.calls > 1:
                continue
            return {"error": _describe_crash(path, size, ended.status)}, []
        except BaseException:
            child.end()
            raise
        answer = json.loads(content)
        # Size of a file [bytes] beyond which its process is not kept: memory that it took may stay,
        # 240 MB after an hour of seven joints at 100 Hz, which has 25 MB as Parquet.
        if "error" in answer or size > 32e6 or child.calls >= MOST_FILES:
            child.end()
        else:
            _idle.append(child)
        return answer, [np.frombuffer(each, dtype=np.float64) for each in columns]


def _take_idle() -> Child | None:
    """Return an idle process that can be used."""
    while _idle:
        with contextlib.suppress(IndexError):
            child = _idle.pop()
            if child.is_usable:
                return child
            child.end()
    return None


def _describe_crash(path: Path, size: float, status: int) -> dict[str, Any]:
    if -status in (signal.SIGALRM, signal.SIGXCPU):
        what = f"takes longer than {LIMITS.time_for(size):.0f} s to read"
    elif status < 0:
        what = f"crashes its reader ({signal.Signals(-status).name})"
    else:
        what = f"ends its reader with status {status}"
    return {"kind": "RecordingError", "message": f"{path} is damaged: it {what}"}


def _rebuild_error(error: Mapping[str, Any], path: Path) -> AsbuiltError:
    if error["kind"] == "MissingExtraError":
        return MissingExtraError(error["package"], error["extra"], f"reading {path}")
    cure = error.get("cure") or "record or export it again"
    fields = {"file": str(path)} | error.get("fields", {})
    return RecordingError(error["message"], cure=Cure(cure), **fields)


def _measure_size(path: Path) -> float:
    """Return the size [bytes] of a regular file or of the files in a folder."""
    files = [path, *path.rglob("*")] if path.is_dir() else [path]
    for file in files:
        if not file.is_dir():
            check_regular(file, "recording", RecordingError, LIMITS.size)
    return float(sum(file.stat().st_size for file in files))


def _answer(
    read: Callable[..., LogTable], path: Path, settings: Mapping[str, Any], memory: int
) -> list[Any]:
    """Return the table of a file, or why it has none, as JSON, and its columns.

    Nothing that the file holds comes back as a pickle.
    """
    error: dict[str, Any] = {"kind": ""}
    try:
        table = read(path, **settings)
        if len(table.columns) > LIMITS.columns:
            raise RecordingError(
                f"{path} has {len(table.columns)} columns; at most {LIMITS.columns} are read"
            )
        return _split_table(table)
    except MissingExtraError as problem:
        error = {"kind": "MissingExtraError", **problem.fields}
    except AsbuiltError as problem:
        fields = {k: v for k, v in problem.fields.items() if isinstance(v, str | int | list)}
        error |= {"message": problem.message, "cure": str(problem.cure or ""), "fields": fields}
    except MemoryError:
        error["message"] = f"{path} needs more than {memory / 1e6:.0f} MB to read"
    except BaseException as problem:
        text = f"{type(problem).__name__}: {describe_problem(problem)}"
        error["message"] = f"{path} is not a recording: it cannot be read as {path.suffix} ({text})"
    return [json.dumps({"error": error}).encode()]


def _split_table(table: LogTable) -> list[Any]:
    document = {
        "columns": list(table.columns),
        "named": table.named,
        "text_columns": list(table.text_columns),
        "known": {name: list(each) for name, each in table.known.items()},
        "notes": list(table.notes),
        "order": list(table.order),
    }
    columns = (np.ascontiguousarray(each, dtype=np.float64) for each in table.columns.values())
    return [json.dumps({"table": document}).encode(), *columns]
