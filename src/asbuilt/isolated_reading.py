"""Files of unknown origin, read in another process with limits of what they may cost.

Logs, meshes and tables that libraries parse go through this door. Limits are bytes of memory and of
temporary files, and CPU time, which a slow computer does not use up sooner. Only files that the
reader of a format reads count.

A process that has read a file well reads the next; one that has met an error is not used again.
"""

from __future__ import annotations

import atexit
import contextlib
import errno
import json
import pickle
import signal
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from asbuilt.arrays import Array
from asbuilt.children import STILL, Child, ChildEnded
from asbuilt.errors import AsbuiltError, MissingExtraError, RecordingError
from asbuilt.findings import Cure
from asbuilt.untrusted import check_regular, describe_problem

T = TypeVar("T")
LARGEST_PART = 500e6
"""Size [bytes] of a file beyond which its head, or a part of it, may cost no more."""
MOST_FILES = 500
"""Files that a process reads before another takes its place, lest its memory grow."""
Answer = tuple[dict[str, Any], Sequence[Array]]
"""What a reader found: plain data, and arrays of numbers, each (N,)."""


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
    """

    size: float = 4e9
    memory: float = 512e6
    memory_ratio: float = 16.0
    time: float = 10.0
    time_ratio: float = 2e-6
    disk: int = 4_000_000_000

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
    what
        What such a file holds.
    error
        Class of the errors.
    largest
        Largest file [bytes], if not that of `LIMITS`.
    in_parts
        Whether files are read part by part, and their head alone at once.
    """

    title: str = ""
    extra: str = ""
    cure: str = "record or export it again"
    reads: tuple[str, ...] = ()
    what: str = "recording"
    error: type[AsbuiltError] = RecordingError
    largest: float | None = None
    in_parts: bool = False


ANY_FILE = FileKind()


def read_apart(
    read: Callable[..., Answer], path: Path, kind: FileKind = ANY_FILE, **settings: Any
) -> Answer:
    """Return what `read(path, **settings)` returns, called in a process of its own.

    Parameters
    ----------
    read
        A function of a module; the other process imports it by name. What it raises, and what its
        libraries raise, becomes an error of ours.
    path
        The file, or the folder of a bag.
    kind
        What messages call such files.
    settings
        Further arguments of `read`.

    Raises
    ------
    AsbuiltError
        Of the class of the kind, as `read` does; and for whatever else it raises, for a crash, or
        beyond `LIMITS`.
    MissingExtraError
        If a library is missing.
    """
    size = _limit_size(path, kind)
    answer, arrays = _call((read, path, kind), settings, size)
    if "error" in answer:
        raise _rebuild_error(answer["error"], path, kind)
    return answer, arrays


def read_parts_apart(
    read: Callable[..., Iterator[Answer]], path: Path, kind: FileKind = ANY_FILE, **settings: Any
) -> Iterator[Answer]:
    """Yield what `read(path, **settings)` yields in a process of its own, part by part.

    So a file is read that has no room in memory. Each part has the limits of a file of its own;
    parameters and errors are those of `read_apart`.
    """
    size = _limit_size(path, kind)
    child = _start_child()
    given: dict[str, Any] = {"begin": read, **settings}
    try:
        while True:
            try:
                answer, arrays = _ask(child, (take_part, path, kind), given, size)
            except ChildEnded as ended:
                answer = {"error": _describe_crash(path, size, ended)}
            if "error" in answer:
                raise _rebuild_error(answer["error"], path, kind)
            if answer == END:
                return
            yield answer, arrays
            given = {}
    finally:
        child.end()


END = {"end": True}
_parts: Iterator[Answer] = iter(())
"""What is left of the file that this process reads part by part."""


def take_part(
    path: Path, begin: Callable[..., Iterator[Answer]] | None = None, **settings: Any
) -> Answer:
    """Return the next part of a file, the first if it is to `begin`; `END` after the last."""
    global _parts  # noqa: PLW0603 - it lasts from one request to the next
    if begin is not None:
        _parts = begin(path, **settings)
    return next(_parts, (END, []))


def read_guarded(
    read: Callable[..., T], path: Path, kind: FileKind = ANY_FILE, **settings: Any
) -> T:
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
            # Some libraries raise it again without the name of what they lack.
            package = problem.name or f"that {kind.title or path.suffix} asks for"
            raise MissingExtraError(package, kind.extra, f"reading {path}") from problem
        raise kind.error(
            f"{path} is not a {kind.what}: it cannot be read as {kind.title or path.suffix}"
            f" ({type(problem).__name__}: {describe_problem(problem)})",
            cure=Cure(kind.cure),
            file=str(path),
        ) from problem


_idle: list[Child] = []


@atexit.register
def _end_idle() -> None:
    while _idle:
        _idle.pop().end()


def _call(
    asked: tuple[Callable[..., Any], Path, FileKind], settings: Mapping[str, Any], size: float
) -> Answer:
    """Return the answer of another process, and the arrays that follow it.

    A process that was idle may end before it sees the request; then another one is asked.
    """
    while True:
        child = _take_idle() or _start_child()
        try:
            answer, arrays = _ask(child, asked, settings, size)
        except ChildEnded as ended:
            if child.calls > 1:
                continue
            return {"error": _describe_crash(asked[1], size, ended)}, []
        except BaseException:
            child.end()
            raise
        # Size of a file [bytes] beyond which its process is not kept: memory that it took may stay,
        # 240 MB after an hour of seven joints at 100 Hz, which has 25 MB as Parquet.
        if "error" in answer or size > 32e6 or child.calls >= MOST_FILES:
            child.end()
        else:
            _idle.append(child)
        return answer, arrays


def _start_child() -> Child:
    return Child({"OPENBLAS_NUM_THREADS": "1", "POLARS_MAX_THREADS": "2"})


def _ask(
    child: Child,
    asked: tuple[Callable[..., Any], Path, FileKind],
    settings: Mapping[str, Any],
    size: float,
) -> Answer:
    """Return the answer of one process about a file of so many bytes; `ChildEnded` if it dies."""
    memory = LIMITS.memory_for(size)
    content, *arrays = child.call(
        pickle.dumps((_answer, (asked, dict(settings), memory, LIMITS.disk))),
        memory=memory,
        seconds=LIMITS.time_for(size),
        largest=memory,
        disk=LIMITS.disk,
    )
    return json.loads(content), [np.frombuffer(array, dtype=np.float64) for array in arrays]


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


def _rebuild_error(error: Mapping[str, Any], path: Path, kind: FileKind) -> AsbuiltError:
    fields = error.get("fields", {})
    if "extra" in fields:
        return MissingExtraError(fields["package"], fields["extra"], f"reading {path}")
    cure = error.get("cure") or kind.cure
    return kind.error(error["message"], cure=Cure(cure), **{"file": str(path)} | fields)


def _limit_size(path: Path, kind: FileKind) -> float:
    """Return the size [bytes] by which a file is limited."""
    size = _measure_size(path, kind)
    return min(size, LARGEST_PART) if kind.in_parts else size


def _measure_size(path: Path, kind: FileKind) -> float:
    """Return the size [bytes] of a regular file, or of the files in a folder that are read."""
    largest = LIMITS.size if kind.largest is None else kind.largest
    files = [path]
    if path.is_dir():
        inside = (file for file in path.rglob("*") if not file.is_dir())
        files = [file for file in inside if not kind.reads or file.suffix.lower() in kind.reads]
    for file in files:
        check_regular(file, kind.what, kind.error, largest)
    return float(sum(file.stat().st_size for file in files))


def _answer(
    asked: tuple[Callable[..., Answer], Path, FileKind],
    settings: Mapping[str, Any],
    memory: int,
    disk: int,
) -> list[Any]:
    """Return what a file holds, or why nothing, as JSON, and its arrays.

    Nothing that the file holds comes back as a pickle.
    """
    path = asked[1]
    try:
        document, arrays = read_guarded(*asked, **settings)
    except AsbuiltError as problem:
        fields = {k: v for k, v in problem.fields.items() if isinstance(v, str | int | list)}
        error = {"message": problem.message, "cure": str(problem.cure or ""), "fields": fields}
    except MemoryError:
        error = {"message": f"{path} needs more than {memory / 1e6:.0f} MB to read"}
    except OSError:
        error = {"message": f"{path} unpacks to more than {disk / 1e9:.3g} GB"}
    else:
        values = [np.ascontiguousarray(array, np.float64) for array in arrays]
        return [json.dumps(document).encode(), *values]
    return [json.dumps({"error": error}).encode()]
