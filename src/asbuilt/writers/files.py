"""Files written whole or not at all, and the lines that list them."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path

from asbuilt.errors import UsageError


def atomic_write(path: str | os.PathLike[str], data: str | bytes) -> Path:
    """Write `data` under a temporary name beside `path`, then rename it onto `path`.

    Text is written as UTF-8 with its line ends. Missing folders are made. Raises `UsageError` with
    the system's reason if the place is not writable.
    """
    target = Path(path)
    content = data.encode("utf-8") if isinstance(data, str) else data
    try:
        if target.is_dir():
            raise UsageError(
                f"cannot write {target}: it is a folder; give the name of a file in it"
            )
        target.parent.mkdir(parents=True, exist_ok=True)
        descriptor, temporary = tempfile.mkstemp(
            prefix=f".{target.name[:64]}.", suffix=".part", dir=target.parent
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
        Path(temporary).replace(target)
    except OSError as error:
        Path(temporary).unlink(missing_ok=True)
        raise UsageError(
            f"cannot write {len(content)} bytes to {target}: {error.strerror or error}"
        ) from error
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise
    return target


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


def _permissions(target: Path) -> int:
    """Return the mode of the file that is replaced, or rw-rw-rw- less the umask."""
    if target.exists():
        return target.stat().st_mode & 0o777
    mask = os.umask(0)
    os.umask(mask)
    return 0o666 & ~mask
