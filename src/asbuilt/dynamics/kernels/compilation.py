"""Machine code kept on disk until any of the sources that it was made from changes."""

# mypy: allow-untyped-calls

from __future__ import annotations

import glob
import hashlib
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

from numba import njit
from numba.core.caching import IndexDataCacheFile


class MachineCodeFiles(IndexDataCacheFile):
    """Keep the machine code of a function for several processes that compile it at once.

    Numba numbers the files of a function by its index, which processes read before others have
    written to it, and writes the index first. So two that compile different signatures at once give
    one number to both, and the index of a stale cache names files of the old sources until new ones
    are written: either runs code of another signature or source. Here a file is named by its
    content and written before the index. A process that is overtaken loses an entry of the index
    and compiles again.
    """

    def __init__(self, of: IndexDataCacheFile, sources: str) -> None:
        base = of._index_name.removesuffix(".nbi")
        super().__init__(of._cache_path, base, (of._source_stamp, sources))
        self._base = base

    def save(self, key: Any, data: Any) -> None:
        """Keep the code of a signature."""
        digest = hashlib.sha256(self._dump(data)).hexdigest()
        name = f"{self._base}.{digest[:16]}.nbc"
        if Path(self._index_path).exists() and not self._load_index():
            self._forget()
        self._save_data(name, data)
        self._save_index(self._load_index() | {key: name})

    def _forget(self) -> None:
        """Remove files of other sources, which the index names no longer."""
        for path in Path(self._cache_path).glob(f"{glob.escape(self._base)}.*.nbc"):
            path.unlink(missing_ok=True)


def compiled(function: Callable[..., Any]) -> Any:
    """Compile on first call, release the interpreter lock, keep the machine code on disk.

    Numba takes kept code for current as long as the file of the function itself is unchanged,
    though functions of other files are inlined into it. Here the sources of all compiled functions
    beside this file count too; where Numba does not let them, nothing is kept.
    """
    return _compiled(function, nogil=True)


def compiled_with_lock(function: Callable[..., Any]) -> Any:
    """Compile as `compiled` does, but keep the interpreter lock, which makes short calls faster."""
    return _compiled(function, nogil=False)


def compiled_with_reordered_sums(function: Callable[..., Any]) -> Any:
    """Compile as `compiled` does; sums may be taken in another order, several terms at once."""
    return _compiled(function, nogil=True, fastmath=True)


def _compiled(function: Callable[..., Any], *, nogil: bool, fastmath: bool = False) -> Any:
    try:
        made: Any = njit(cache=True, nogil=nogil, fastmath=fastmath, error_model="numpy")(function)
        sources = source_digest(Path(__file__).parent)
        made._cache._cache_file = MachineCodeFiles(made._cache._cache_file, sources)
    except (RuntimeError, AttributeError):
        made = njit(nogil=nogil, fastmath=fastmath, error_model="numpy")(function)
    return made


@cache
def source_digest(folder: Path) -> str:
    """Return a digest of all Python files of a folder that compile anything."""
    digest = hashlib.sha256()
    for path in sorted(folder.glob("*.py")):
        source = path.read_bytes()
        if b"compiled" in source or b"numba" in source:
            digest.update(hashlib.sha256(source).digest())
    return digest.hexdigest()
