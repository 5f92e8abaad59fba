"""Binary logs of unknown origin, read in another process with limits of what they may cost.

Limits are bytes of memory and of temporary files, and CPU time, which a slow computer does not use
up sooner. Only files that the reader of a format reads count.

A process that has read a file well reads the next; one that has met an error is not used again.
"""

from __future__ import annotations

import atexit
import contextlib
import errno
import json
import pickle
import signal
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from dataclasses import fields as dataclass_fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from asbuilt.children import STILL, Child, ChildEnded
from asbuilt.errors import AsbuiltError, MissingExtraError, RecordingError
from asbuilt.experiment.logs.formats.log_format import LogTable
from asbuilt.findings import Cure
from asbuilt.untrusted import check_regular, describe_problem

if TYPE_CHECKING:
    from asbuilt.experiment.logs.sheet import RecordingSheet

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
        Seconds of CPU time, and further ones per byte of the file; bags are decoded at about 1
        MB/s.
    disk
        Bytes of temporary files, as of a compressed bag that is unpacked.
    columns
        Most columns of a log; 30 joints with 10 quantities have 300.
    """

    size: float = 4e9
    memory: float = 512e6
    memory_ratio: float = 16.0
    time: float = 10.0
    time_ratio: float = 2e-6
    disk: int = 4_000_000_000
    columns: int = 10_000

    def memory_for(self, n_bytes: float) -> int:
        """Return the memory [bytes] that a file of this size may take."""
        return int(self.memory + self.memory_ratio * n_bytes)

    def time_for(self, n_bytes: float) -> float:
        """Return the CPU time [s] that a file of this size may take."""
        return self.time + self.time_ratio * n_bytes


LIMITS = Limits()


@dataclass(frozen=True, slots=True)
class FileKind:
    """Name a kind of file in messages.

    Parameters
    ----------
    title
        What it is read as, such as "HDF5"; by default its suffix.
    extra
        The extra of asbuilt that has the library which reads it.
    cure
        What to do with a file that cannot be read.
    reads
        Suffixes of the files of a folder that are read; others, such as videos, do not count.
    """

    title: str = ""
    extra: str = ""
    cure: str = "record or export it again"
    reads: tuple[str, ...] = ()


def isolate(
    read: Callable[..., LogTable], kind: FileKind, *, by_sheet: bool = False
) -> Callable[[Path, RecordingSheet], LogTable]:
    """Return the reader of a format that calls `read` in another process (`read_isolated`).

    It gets the path of a file, and the recording sheet too if the format is read `by_sheet`.
    """
    return lambda path, sheet: read_isolated(
        read, path, kind, **({"sheet": sheet} if by_sheet else {})
    )


def read_guarded(
    read: Callable[..., LogTable], path: Path, kind: FileKind = FileKind(), **settings: Any
) -> LogTable:
    """Return what `read(path, **settings)` returns; whatever it raises becomes an error of ours.

    So readers pass on what their libraries raise, and what damaged content makes of them.
    """
    try:
        return read(path, **settings)
    except (AsbuiltError, MemoryError):
        raise
    except BaseException as problem:
        if isinstance(problem, OSError) and problem.errno == errno.EFBIG:
            raise  # beyond the limit of temporary files, which the caller knows
        if isinstance(problem, ImportError) and kind.extra:
            raise MissingExtraError(str(problem.name), kind.extra, f"reading {path}") from problem
        raise RecordingError(
            f"{path} is not a recording: it cannot be read as {kind.title or path.suffix}"
            f" ({type(problem).__name__}: {describe_problem(problem)})",
            cure=Cure(kind.cure),
            file=str(path),
        ) from problem


def read_isolated(
    read: Callable[..., LogTable], path: Path, kind: FileKind = FileKind(), **settings: Any
) -> LogTable:
    """Return what `read(path, **settings)` returns, called in a process of its own.

    Parameters
    ----------
    read
        A function of a module; the other process imports it by name.
    path
        The file, or the folder of a bag.
    kind
        What messages call such files.
    settings
        Further arguments of `read`.

    Raises
    ------
    RecordingError
        As `read` does; and for whatever else it raises, for a crash, or beyond `LIMITS`.
    MissingExtraError
        If a library is missing.
    """
    size = _measure_size(path, kind.reads)
    answer, arrays = _call((read, path, kind), settings, size)
    if "error" in answer:
        raise _rebuild_error(answer["error"], path)
    known = {name: tuple(each) for name, each in answer.pop("known").items()}
    lists = {name: tuple(each) for name, each in answer.items() if isinstance(each, list)}
    columns = dict(zip(lists.pop("columns"), arrays, strict=True))
    return LogTable(**{**answer, **lists, "columns": columns, "known": known})


_idle: list[Child] = []


@atexit.register
def _end_idle() -> None:
    while _idle:
        _idle.pop().end()


def _call(
    asked: tuple[Callable[..., Any], Path, FileKind], settings: Mapping[str, Any], size: float
) -> tuple[dict[str, Any], list[Any]]:
    """Return the answer of another process, and the columns that follow it.

    A process that was idle may end before it sees the request; then another one is asked.
    """
    memory = LIMITS.memory_for(size)
    request = pickle.dumps((_answer, (asked, dict(settings), memory, LIMITS.disk)))
    while True:
        child = _take_idle() or Child({"OPENBLAS_NUM_THREADS": "1", "POLARS_MAX_THREADS": "2"})
        try:
            content, *columns = child.call(
                request,
                memory=memory,
                seconds=LIMITS.time_for(size),
                largest=memory,
                disk=LIMITS.disk,
            )
        except ChildEnded as ended:
            if child.calls > 1:
                continue
            return {"error": _describe_crash(asked[1], size, ended)}, []
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


def _describe_crash(path: Path, size: float, ended: ChildEnded) -> dict[str, Any]:
    """Return why a process gave no answer; what took too long may still be sound."""
    status = ended.status
    if ended.stopped == "still":
        return {
            "message": f"{path} was not read: stopped after {STILL:g} s without progress",
            "cure": "check the disk or network on which it lies, or copy it here, and try again",
        }
    if ended.stopped == "disk":
        what = f"unpacks to more than {LIMITS.disk / 1e9:.3g} GB"
    elif status < 0 and signal.Signals(-status).name in ("SIGPROF", "SIGXCPU"):
        what = f"takes more than {LIMITS.time_for(size):.3g} s of computing to read"
    elif status < 0:
        what = f"crashes its reader ({signal.Signals(-status).name})"
    else:
        what = f"ends its reader with status {status}"
    return {"message": f"{path} is damaged: it {what}"}


def _rebuild_error(error: Mapping[str, Any], path: Path) -> AsbuiltError:
    fields = error.get("fields", {})
    if "extra" in fields:
        return MissingExtraError(fields["package"], fields["extra"], f"reading {path}")
    cure = error.get("cure") or FileKind().cure
    return RecordingError(error["message"], cure=Cure(cure), **{"file": str(path)} | fields)


def _measure_size(path: Path, reads: Sequence[str] = ()) -> float:
    """Return the size [bytes] of a regular file, or of the files in a folder that are read."""
    files = [path]
    if path.is_dir():
        inside = (file for file in path.rglob("*") if not file.is_dir())
        files = [file for file in inside if not reads or file.suffix.lower() in reads]
    for file in files:
        check_regular(file, "recording", RecordingError, LIMITS.size)
    return float(sum(file.stat().st_size for file in files))


def _answer(
    asked: tuple[Callable[..., LogTable], Path, FileKind],
    settings: Mapping[str, Any],
    memory: int,
    disk: int,
) -> list[Any]:
    """Return the table of a file, or why it has none, as JSON, and its columns.

    Nothing that the file holds comes back as a pickle.
    """
    path = asked[1]
    try:
        table = read_guarded(*asked, **settings)
        if len(table.columns) > LIMITS.columns:
            raise RecordingError(
                f"{path} has {len(table.columns)} columns; at most {LIMITS.columns} are read"
            )
    except AsbuiltError as problem:
        fields = {k: v for k, v in problem.fields.items() if isinstance(v, str | int | list)}
        error = {"message": problem.message, "cure": str(problem.cure or ""), "fields": fields}
    except MemoryError:
        error = {"message": f"{path} needs more than {memory / 1e6:.0f} MB to read"}
    except OSError:
        error = {"message": f"{path} unpacks to more than {disk / 1e9:.3g} GB"}
    else:
        document = {entry.name: getattr(table, entry.name) for entry in dataclass_fields(table)}
        values = [np.ascontiguousarray(each, np.float64) for each in table.columns.values()]
        return [json.dumps(document | {"columns": list(table.columns)}).encode(), *values]
    return [json.dumps({"error": error}).encode()]
