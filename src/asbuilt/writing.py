"""Files: the one door through which they are written, whole or not at all.

Only regular files are replaced, and none that the command reads.
"""

from __future__ import annotations

import errno
import os
import stat
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from functools import cache
from pathlib import Path

from asbuilt.children import HOST, is_running
from asbuilt.errors import UsageError
from asbuilt.findings import Cure
from asbuilt.untrusted import is_input, shorten_path

_OWNER = f"{HOST}.{os.getpid()}"
"""Machine and process in the names of temporary files."""
_PENDING: ContextVar[dict[Path, Path] | None] = ContextVar("_PENDING", default=None)
"""Temporary file of each file that is yet to be renamed."""


def atomic_write(
    path: str | os.PathLike[str],
    data: str | bytes | Iterable[bytes],
    *,
    mode: int | None = None,
    create: bool = False,
    own: bool = False,
) -> Path:
    """Write `data` under a temporary name next to `path`, then rename it onto `path`.

    Text is written as UTF-8 with its line ends. Missing folders are made. Inside `file_set` the
    file is renamed with the others.

    Parameters
    ----------
    path
        The file. A symbolic link is not followed, and not replaced.
    data
        Its content, whole or in pieces.
    mode
        Its permissions; None: the replaced file's, or what the umask leaves.
    create
        Whether it is made only if nothing has its name, of several writers by the first alone.
    own
        Whether it is replaced even if this command has read it, as a store mends a file of its own.

    Raises
    ------
    FileExistsError
        If it is to be created, and is there.
    UsageError
        With the system's reason, if the place is not writable, or is one that `check_replaceable`
        refuses.
    """
    target = Path(path)
    whole = data.encode("utf-8", "backslashreplace") if isinstance(data, str) else data
    pieces = [whole] if isinstance(whole, bytes) else whole
    check_replaceable(target, own=own)
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        _remove_leftovers_once(target.parent)
        descriptor, temporary = tempfile.mkstemp(
            prefix=f".{target.name[:16]}.{_OWNER}.", suffix=".part", dir=target.parent
        )
    except (OSError, ValueError) as error:
        raise _make_unwritable_error(shorten_path(target), error) from error
    try:
        with os.fdopen(descriptor, "wb") as stream:
            stream.writelines(pieces)
            stream.flush()
            os.fsync(stream.fileno())
        Path(temporary).chmod(_read_permissions(target) if mode is None else mode)
        pending = _PENDING.get()
        if create:
            _create(Path(temporary), target)
        elif pending is None:
            Path(temporary).replace(target)
        else:
            pending[target] = Path(temporary)
    except BaseException as error:
        Path(temporary).unlink(missing_ok=True)
        if isinstance(error, FileExistsError) or not isinstance(error, OSError):
            raise
        size = f"{len(whole)} bytes to " if isinstance(whole, bytes) else ""
        raise UsageError(f"cannot write {size}{target}: {error.strerror or error}") from error
    return target


def check_replaceable(target: Path, *, own: bool = False) -> None:
    """Raise `UsageError` if a path is a file that must not be replaced; one may be absent.

    These are folders, symbolic links, devices, pipes and sockets, and files that the command reads
    unless they are its `own`.
    """
    try:
        state = target.lstat()
    except FileNotFoundError:
        return
    except (OSError, ValueError) as error:
        raise _make_unwritable_error(shorten_path(target), error) from None
    if stat.S_ISDIR(state.st_mode):
        why = "it is a folder"
        cure = "give the name of a file in it"
    elif stat.S_ISLNK(state.st_mode):
        why = f"it is a symbolic link to {os.readlink(target)}"
        cure = "give the name of the file itself, or remove the link"
    elif not stat.S_ISREG(state.st_mode):
        why = "it is a device, pipe or socket"
        cure = "give the name of a regular file"
    elif is_input(target) and not own:
        why = "this command reads it"
        cure = "give another name"
    else:
        return
    raise UsageError(f"cannot write {target}: {why}", cure=Cure(cure), file=str(target))


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
                if path in pending or not path.is_file() or is_input(path):
                    continue
                if not (os.path.exists(keep) and path.samefile(keep)):
                    path.unlink()
        for target in sorted(pending, key=lambda path: path.name == mark):
            pending.pop(target).replace(target)
    except OSError as error:
        raise UsageError(f"cannot write into {folder}: {error.strerror or error}") from error
    finally:
        _PENDING.reset(token)
        for temporary in pending.values():
            temporary.unlink(missing_ok=True)


def check_writable(folder: Path) -> None:
    """Raise `UsageError` unless a folder is writable or can be made; nothing is made."""
    try:
        nearest = next(place for place in (folder, *folder.absolute().parents) if place.exists())
    except (OSError, ValueError) as error:
        raise _make_unwritable_error(f"into {shorten_path(folder)}", error) from None
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


def _make_unwritable_error(place: str, problem: OSError | ValueError) -> UsageError:
    too_long = getattr(problem, "errno", None) == errno.ENAMETOOLONG
    return UsageError(
        f"cannot write {place}: {getattr(problem, 'strerror', None) or problem}",
        cure=Cure("give a shorter name" if too_long else "choose a folder you may write to"),
    )


def remove_leftovers(folder: Path) -> None:
    """Remove temporary files that processes of this machine left behind when they were killed."""
    for path in folder.glob(".*.part"):
        *_, host, process, _, _ = ["", "", *path.name.split(".")]
        if host == HOST and process.isdigit() and not is_running(int(process)):
            path.unlink(missing_ok=True)


_remove_leftovers_once = cache(remove_leftovers)
"""Looking into a folder at each of its files would make many files slow."""


def _create(temporary: Path, target: Path) -> None:
    """Give a file its name if nothing has it, also where the file system has no hard links."""
    try:
        os.link(temporary, target)
        temporary.unlink()
    except FileExistsError:
        raise
    except OSError:
        target.open("xb").close()
        temporary.replace(target)


def _read_permissions(target: Path) -> int:
    """Return the mode of the file that is replaced, or rw-rw-rw- less the umask."""
    if target.exists():
        return target.stat().st_mode & 0o777
    mask = os.umask(0)
    os.umask(mask)
    return 0o666 & ~mask
