"""What files hold, in a few letters: the same letters mean the same content."""

from __future__ import annotations

import os
import re
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from hashlib import blake2b
from itertools import islice
from pathlib import Path

READ_WHOLE = 256_000_000
"""Bytes of a file that is read for its fingerprint: less than half a second. The system's record
of the last change stands for a longer one: nothing can be written without changing it."""
REFERRING = (".urdf", ".xml", ".mjcf", ".xacro", ".sdf", ".toml")
"""Ends of files that name other files, such as meshes, includes and logs."""
LONGEST_REFERRING = 2_000_000
"""Bytes of a file that people write, as of descriptions that are read."""
MOST_FILES = 20_000
"""Files of a folder, and of one description, that are looked at."""
CHUNK = 1 << 20
_QUOTED = re.compile(r"""["']([^"'\n\0]{1,500})["']""")


class Fingerprints:
    """Read what files hold, each content once.

    Parameters
    ----------
    written
        Folder that is written into, which is no part of a folder that is read.
    """

    def __init__(self, written: Path) -> None:
        self._written = written
        self._held: dict[Path, str] | None = None
        self._contents: dict[tuple[str, int, int, int, int], str] = {}
        self._references: dict[str, tuple[str, ...]] = {}

    @contextmanager
    def hold(self) -> Iterator[None]:
        """Look at each file once inside a `with` statement, which is one moment."""
        before = self._held
        self._held = {} if before is None else before
        try:
            yield
        finally:
            self._held = before

    def of_inputs(self, *paths: str | Path) -> str:
        """Return the fingerprint of files and folders and of the files that they name."""
        mark = blake2b(digest_size=16)
        for path in paths:
            for file in (Path(path), *self._list_referenced(Path(path))):
                mark.update(f"{file}\0{self.of(file)}\0".encode("utf-8", "surrogateescape"))
        return mark.hexdigest()

    def of(self, path: Path) -> str:
        """Return the fingerprint of a file, or of all files of a folder; empty if there is none."""
        held = {} if self._held is None else self._held
        if path not in held:
            held[path] = self._look(path)
        return held[path]

    def _look(self, path: Path) -> str:
        try:
            state = path.stat()
            if stat.S_ISREG(state.st_mode):
                return self._read(path, state)
            if not stat.S_ISDIR(state.st_mode):
                return ""
            mark = blake2b(digest_size=16)
            for file in sorted(islice(self._list_files(path), MOST_FILES)):
                own = self._read(file, file.stat())
                mark.update(f"{file}\0{own}\0".encode("utf-8", "surrogateescape"))
        except (OSError, ValueError):
            return ""
        return mark.hexdigest()

    def _read(self, path: Path, state: os.stat_result) -> str:
        """Return the digest of a file that has not changed since it was read, else read it."""
        times = (state.st_mtime_ns, state.st_ctime_ns)
        known = (str(path), state.st_ino, state.st_size, *times)
        if known not in self._contents:
            mark = blake2b(digest_size=16)
            if state.st_size > READ_WHOLE:
                mark.update(repr(known).encode("utf-8", "surrogateescape"))
            else:
                with path.open("rb") as stream:
                    while piece := stream.read(CHUNK):
                        mark.update(piece)
            self._contents[known] = mark.hexdigest()
        return self._contents[known]

    def _list_referenced(self, path: Path) -> list[Path]:
        """Return the files beside a description or a sheet that it names, and those they name."""
        seen: dict[Path, None] = {}
        waiting = [path]
        while waiting and len(seen) < MOST_FILES:
            for file in self._find_named(waiting.pop()):
                if file not in seen and file != path:
                    seen[file] = None
                    waiting.append(file)
        return list(seen)

    def _find_named(self, path: Path) -> Iterator[Path]:
        """Yield the files that are named between quotes, wherever they lie below the folder."""
        if path.suffix.lower() not in REFERRING or not path.is_file():
            return
        mark = self.of(path)
        if mark not in self._references:
            with path.open("rb") as stream:
                text = stream.read(LONGEST_REFERRING).decode("utf-8", "replace")
            quoted = (name.split("://")[-1] for name in _QUOTED.findall(text))
            self._references[mark] = tuple(dict.fromkeys(quoted))
        names = self._references[mark]
        folder = path.parent
        with suppress(OSError, ValueError):
            folders = [folder, *(folder / name for name in names if (folder / name).is_dir())]
            for name in names:
                # The name of a ROS package stands before the path in it.
                for tail in (name, name.partition("/")[2]):
                    if tail and "." in tail:
                        yield from (place / tail for place in folders if (place / tail).is_file())

    def _list_files(self, folder: Path) -> Iterator[Path]:
        """Yield the files of a folder and of those in it, in no order."""
        for place, folders, names in os.walk(folder):
            folders[:] = [folder for folder in folders if Path(place) / folder != self._written]
            yield from (Path(place) / name for name in names)
