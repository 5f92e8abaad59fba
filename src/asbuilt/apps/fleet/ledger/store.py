"""Files of a ledger, in a folder or at a URL; each is written once, whole or not at all."""

from __future__ import annotations

import io
from importlib import import_module
from pathlib import Path
from typing import Any
from urllib.parse import quote, unquote

import numpy as np
import polars as pl

from asbuilt.errors import MissingExtraError, ResultError, UsageError
from asbuilt.experiment import LogTable
from asbuilt.findings import Cure
from asbuilt.untrusted import describe_problem, read_bytes, shorten_path
from asbuilt.writing import atomic_write

LONGEST = 60
"""Characters of an identity."""

EXTRAS = {"s3": "s3", "s3a": "s3", "gs": "gcs", "gcs": "gcs", "az": "azure", "abfs": "azure"}
"""Extra that has the file system of a protocol."""
READABLE = 0o644
"""Mode of a file: what is in a ledger never changes."""
LARGEST = 50_000_000
"""Bytes of a file, packed or not; an entry of 30 joints has 4 MB, and 6 MB unpacked."""


def check_robot_id(robot_id: str) -> str:
    """Return the identity of a robot.

    Raises `UsageError` unless it is one line of 1 to 60 printable characters whose folder can be
    made; characters of other scripts take up to nine bytes of its name.
    """
    folder = quote(robot_id, safe=" ", errors="replace")
    if not (robot_id.strip() and robot_id.isprintable() and len(robot_id) <= LONGEST):
        raise UsageError(
            f"the identity of a robot has 1 to {LONGEST} printable characters, got"
            f" {robot_id[: LONGEST + 1]!r}",
            cure=Cure("give a short name or a serial number"),
        )
    # Bytes of a folder's name that every file system takes.
    if len(folder) > 250:
        raise UsageError(f"the identity {robot_id!r} is too long for the name of a folder")
    return robot_id


def name_entry_folder(robot_id: str) -> str:
    """Return the folder of a robot's entries; raises as `check_robot_id` does."""
    return "logs/" + quote(check_robot_id(robot_id), safe=" ").replace(".", "%2E")


def is_folder(name: str) -> bool:
    """Return whether this is the name of a robot's folder."""
    try:
        return name_entry_folder(unquote(name)) == f"logs/{name}"
    except UsageError:
        return False


class LocalStore:
    """Files in a folder of this machine, or of a share that it mounts."""

    def __init__(self, root: str) -> None:
        self.root = root
        self._folder = Path(root)

    def names(self, folder: str) -> list[str]:
        """Return the names in a folder, sorted, without files that are being written.

        There are none if the folder is absent.
        """
        place = self._folder / folder
        try:
            return sorted(path.name for path in place.iterdir() if not path.name.startswith("."))
        except FileNotFoundError:
            return []
        except NotADirectoryError:
            raise UsageError(f"{place} is a file; a ledger is a folder or a URL") from None
        except (OSError, ValueError) as problem:
            raise UsageError(
                f"{shorten_path(place)} cannot be read: {describe_problem(problem)}"
            ) from None

    def read(self, path: str) -> bytes:
        """Return the content of a file; raises `ResultError` if that is impossible."""
        return read_bytes(self._folder / path, "ledger file", ResultError, LARGEST)

    def write(self, path: str, content: bytes) -> None:
        """Write a file that appears whole or not at all; raises `UsageError` with the reason."""
        atomic_write(self._folder / path, content, mode=READABLE, own=True)

    def create(self, path: str, content: bytes) -> bool:
        """Write a file unless it is there, of several writers one; return whether it was."""
        try:
            atomic_write(self._folder / path, content, mode=READABLE, create=True)
        except FileExistsError:
            return False
        return True


class RemoteStore:
    """Files at a URL that fsspec knows; an object store shows a file once it is whole."""

    def __init__(self, url: str) -> None:
        self.root = url.rstrip("/")
        protocol = url.partition("://")[0]
        try:
            fsspec = import_module("fsspec")
            self._files, self._folder = fsspec.url_to_fs(self.root)
        except ImportError as problem:
            raise MissingExtraError(
                problem.name or "fsspec",
                EXTRAS.get(protocol, "cluster"),
                f"a ledger at {protocol}://",
            ) from None
        except Exception as problem:
            raise UsageError(
                f"the ledger {shorten_path(url)} cannot be opened: {describe_problem(problem)}"
            ) from None

    def names(self, folder: str) -> list[str]:
        """Return the names in a folder."""
        place = f"{self._folder}/{folder}".rstrip("/")
        try:
            found = self._files.ls(place, detail=False, refresh=True)
        except FileNotFoundError:
            return []
        except Exception as problem:
            raise _make_unreachable_error(self.root, problem) from problem
        names = {path.rstrip("/").rpartition("/")[2] for path in found if path.rstrip("/") != place}
        return sorted(name for name in names if name and not name.startswith("."))

    def read(self, path: str) -> bytes:
        """Return the content of a file."""
        try:
            content: Any = self._files.cat_file(f"{self._folder}/{path}", end=LARGEST + 1)
        except Exception as problem:
            raise _make_unreachable_error(f"{self.root}/{path}", problem) from problem
        if len(content) > LARGEST:
            raise ResultError(f"{self.root}/{path} has more than {LARGEST / 1e6:.0f} MB")
        return bytes(content)

    def create(self, path: str, content: bytes) -> bool:
        """Write a file in one request that fails if it is there, where the service can."""
        try:
            self.write(path, content, mode="create")
        except FileExistsError:
            return False
        return True

    def write(self, path: str, content: bytes, **how: str) -> None:
        """Write a file in one request."""
        try:
            self._files.pipe_file(f"{self._folder}/{path}", content, **how)
        except FileExistsError:
            raise
        except Exception as problem:
            raise UsageError(
                f"cannot write {len(content)} bytes to {self.root}/{path}:"
                f" {describe_problem(problem)}"
            ) from problem


Store = LocalStore | RemoteStore
"""Whole files by their path below a root, parts separated by `/`."""


def open_store(root: str) -> Store:
    """Return the store of a folder, or of a URL such as `s3://bucket/ledger`.

    Raises
    ------
    MissingExtraError
        If the file system of the URL is not installed.
    UsageError
        If there is no such protocol.
    """
    if "://" not in root or root.startswith("file://"):
        return LocalStore(root.removeprefix("file://"))
    return RemoteStore(root)


def _make_unreachable_error(root: str, problem: Exception) -> ResultError:
    return ResultError(
        f"{shorten_path(root)} cannot be reached: {type(problem).__name__}"
        f" {describe_problem(problem)}",
        file=root,
    )


def unpack_table(path: Path) -> LogTable:
    """Return the table of a Parquet file as one column, the bytes of an Arrow stream.

    `read_isolated` calls this, since decompression takes what memory it likes.
    """
    frame = pl.read_parquet(path)
    stream = io.BytesIO()
    if frame.estimated_size() > LARGEST:
        raise ResultError(f"it unpacks to more than {LARGEST / 1e6:.0f} MB")
    frame.write_ipc_stream(stream)
    # A column holds numbers of 8 bytes; Arrow ignores what follows its end mark.
    stream.write(bytes(-stream.tell() % 8))
    return LogTable(source=str(path), columns={"arrow": np.frombuffer(stream.getvalue())})
