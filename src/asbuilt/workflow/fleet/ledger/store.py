"""Files of a ledger, in a folder or at a URL; each is written once, whole or not at all."""

from __future__ import annotations

import os
import tempfile
from importlib import import_module
from pathlib import Path
from typing import Any, Protocol

from asbuilt.errors import MissingExtraError, ResultError, UsageError
from asbuilt.findings import Cure

EXTRAS = {"s3": "s3", "s3a": "s3", "gs": "gcs", "gcs": "gcs", "az": "azure", "abfs": "azure"}
"""Extra that has the file system of a protocol."""


READABLE = 0o644
"""Mode of a file: what is in a ledger never changes."""


class Store(Protocol):
    """Read and write whole files by their path below the root, parts separated by `/`."""

    root: str

    def names(self, folder: str) -> list[str]:
        """Return the names of files and folders in a folder, sorted; none if it is absent."""
        ...

    def read(self, path: str) -> bytes:
        """Return the content of a file; raises OSError if that is impossible."""
        ...

    def write(self, path: str, content: bytes) -> None:
        """Write a file that appears whole or not at all; raises `UsageError` with the reason."""
        ...


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


class LocalStore:
    """Files in a folder of this machine, or of a share that it mounts."""

    def __init__(self, root: str) -> None:
        self.root = root
        self._folder = Path(root)

    def names(self, folder: str) -> list[str]:
        """Return the names in a folder, those of files that are being written left out."""
        place = self._folder / folder
        if not place.is_dir():
            if place.exists():
                raise UsageError(f"{place} is a file; a ledger is a folder or a URL")
            return []
        return sorted(path.name for path in place.iterdir() if not path.name.startswith("."))

    def read(self, path: str) -> bytes:
        """Return the content of a file."""
        return (self._folder / path).read_bytes()

    def write(self, path: str, content: bytes) -> None:
        """Write a file under a temporary name and rename it."""
        target, temporary = self._folder / path, None
        try:
            target.parent.mkdir(parents=True, exist_ok=True)
            descriptor, temporary = tempfile.mkstemp(
                prefix=f".{target.name[:64]}.", suffix=".part", dir=target.parent
            )
            with os.fdopen(descriptor, "wb") as stream:
                stream.write(content)
                stream.flush()
                os.fsync(stream.fileno())
            Path(temporary).chmod(READABLE)
            Path(temporary).replace(target)
        except OSError as problem:
            raise UsageError(
                f"cannot write {len(content)} bytes to {target}: {problem.strerror or problem}",
                cure=Cure("free some space, or choose a folder that you may write to"),
                file=str(target),
            ) from problem
        finally:
            if temporary is not None:
                Path(temporary).unlink(missing_ok=True)


class RemoteStore:
    """Files at a URL that fsspec knows; an object store shows a file once it is whole."""

    def __init__(self, url: str) -> None:
        self.root = url.rstrip("/")
        protocol = url.partition("://")[0]
        extra = EXTRAS.get(protocol, "cluster")
        try:
            fsspec = import_module("fsspec")
            self._files, self._folder = fsspec.url_to_fs(self.root)
        except ImportError as problem:
            package = getattr(problem, "name", None) or "fsspec"
            raise MissingExtraError(package, extra, f"a ledger at {protocol}://") from None
        except ValueError as problem:
            raise UsageError(f"the ledger {url} cannot be opened: {problem}") from None

    def names(self, folder: str) -> list[str]:
        """Return the names in a folder."""
        place = f"{self._folder}/{folder}".rstrip("/")
        try:
            found = self._files.ls(place, detail=False, refresh=True)
        except FileNotFoundError:
            return []
        except Exception as problem:
            raise _unreachable(self.root, problem) from problem
        names = {path.rstrip("/").rpartition("/")[2] for path in found if path.rstrip("/") != place}
        return sorted(name for name in names if name and not name.startswith("."))

    def read(self, path: str) -> bytes:
        """Return the content of a file."""
        content: Any = self._files.cat_file(f"{self._folder}/{path}")
        return bytes(content)

    def write(self, path: str, content: bytes) -> None:
        """Write a file in one request."""
        try:
            self._files.pipe_file(f"{self._folder}/{path}", content)
        except Exception as problem:
            raise UsageError(
                f"cannot write {len(content)} bytes to {self.root}/{path}: {problem}"
            ) from problem


def _unreachable(root: str, problem: Exception) -> ResultError:
    reason = f"{type(problem).__name__} {problem}".strip()
    return ResultError(f"the ledger {root} cannot be reached: {reason}", file=root)
