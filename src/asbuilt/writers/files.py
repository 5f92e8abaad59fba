"""Files written whole or not at all, and the lines that list them."""

from __future__ import annotations

import os
import platform
import re
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from functools import cache
from pathlib import Path

from asbuilt.errors import UsageError

_HOST = re.sub(r"[^\w-]", "-", platform.node()) or "local"
_OWNER = f"{_HOST}.{os.getpid()}"
"""Machine and process in the names of temporary files."""
_PENDING: ContextVar[dict[Path, Path] | None] = ContextVar("_PENDING", default=None)
"""Temporary file of each file that is yet to be renamed."""


def atomic_write(path: str | os.PathLike[str], data: str | bytes) -> Path:
    """Write `data` under a temporary name beside `path`, then rename it onto `path`.

    Text is written as UTF-8 with its line ends. Missing folders are made. Inside `file_set` the
    file is renamed with the others. Raises `UsageError` with the system's reason if the place is
    not writable.
    """
    target = Path(path)
    content = data.encode("utf-8") if isinstance(data, str) else data
    try:
        if target.is_dir():
            raise UsageError(
                f"cannot write {target}: it is a folder; give the name of a file in it"
            )
        target.parent.mkdir(parents=True, exist_ok=True)
        _remove_leftovers(target.parent)
        descriptor, temporary = tempfile.mkstemp(
            prefix=f".{target.name[:64]}.{_OWNER}.", suffix=".part", dir=target.parent
        )
    except OSError as error:
        raise UsageError(
            f"cannot write {target}: {error.strerror or error}; choose a folder you may write to"
        ) from error
    try:
        with os.fdopen(descriptor, "wb") as stream:
            stream.write(content)
            stream.flush()
            os.fsync(stream.fileno())
        Path(temporary).chmod(_permissions(target))
        pending = _PENDING.get()
        if pending is None:
            Path(temporary).replace(target)
        else:
            pending[target] = Path(temporary)
    except OSError as error:
        Path(temporary).unlink(missing_ok=True)
        raise UsageError(
            f"cannot write {len(content)} bytes to {target}: {error.strerror or error}"
        ) from error
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise
    return target


@contextmanager
def file_set(folder: Path, mark: str, members: Sequence[str], keep: str = "") -> Iterator[None]:
    """Write files under temporary names and rename them together, or none if writing fails.

    Files of an earlier set that are not written again are removed, so that the folder never holds
    members of two sets.

    Parameters
    ----------
    folder
        Where the set lies.
    mark
        Name of the member that shows that a set lies there; it is renamed last.
    members
        Names of all files that a set may have.
    keep
        Path of a file that is never removed.
    """
    pending: dict[Path, Path] = {}
    token = _PENDING.set(pending)
    try:
        yield
        if (folder / mark).exists():
            for path in (folder / name for name in members):
                if path not in pending and path.is_file() and not _same(path, keep):
                    path.unlink()
        for target in sorted(pending, key=lambda path: path.name == mark):
            pending.pop(target).replace(target)
    except OSError as error:
        raise UsageError(f"cannot write into {folder}: {error.strerror or error}") from error
    finally:
        _PENDING.reset(token)
        for temporary in pending.values():
            temporary.unlink(missing_ok=True)


def path_texts(files: Mapping[str, str | os.PathLike[str]] | None) -> dict[str, str]:
    """Return the paths of files by kind as text, for documents."""
    return {kind: os.fspath(path) for kind, path in (files or {}).items()}


def file_lines(
    files: Mapping[str, Path], notes: Mapping[str, Sequence[str]], width: int
) -> list[str]:
    """Return a line for every file, its kind in a column of this width, and a line for each note.

    A kind without a file has its first note in the place of the path.
    """
    lines = []
    for kind in dict.fromkeys((*files, *notes)):
        said = list(notes.get(kind, ()))
        lines.append(f"  {kind:<{width}} {files[kind] if kind in files else said.pop(0)}")
        lines += [f"  {'':<{width}} note: {note}" for note in said]
    return lines


def check_writable(folder: Path) -> None:
    """Raise `UsageError` unless a folder is writable or can be made; nothing is made."""
    try:
        nearest = next(place for place in (folder, *folder.absolute().parents) if place.exists())
    except OSError as error:
        raise UsageError(
            f"cannot write into {folder}: {error.strerror or error}; choose a folder you may"
            " write to"
        ) from None
    if not nearest.is_dir():
        raise UsageError(
            f"cannot write into {folder}: {nearest} is a file; choose a folder you may write to"
        )
    if not os.access(
        nearest, os.W_OK | os.X_OK, effective_ids=os.access in os.supports_effective_ids
    ):
        raise UsageError(
            f"cannot write into {folder}: {nearest} is not open to you; choose a folder you may"
            " write to"
        )


def _same(path: Path, other: str) -> bool:
    return bool(other) and os.path.exists(other) and path.samefile(other)


@cache
def _remove_leftovers(folder: Path) -> None:
    """Remove temporary files that processes of this machine left behind when they were killed."""
    for path in folder.glob(".*.part"):
        *_, host, process, _, _ = ["", "", *path.name.split(".")]
        if host == _HOST and process.isdigit() and not _is_alive(int(process)):
            path.unlink(missing_ok=True)


def _is_alive(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except OSError:
        return True
    return True


def _permissions(target: Path) -> int:
    """Return the mode of the file that is replaced, or rw-rw-rw- less the umask."""
    if target.exists():
        return target.stat().st_mode & 0o777
    mask = os.umask(0)
    os.umask(mask)
    return 0o666 & ~mask
