"""Machine code kept on disk until any of the sources that it was made from changes."""

# mypy: allow-untyped-calls

from __future__ import annotations

import hashlib
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

from numba import njit


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
        index = made._cache._cache_file
        index._source_stamp = (index._source_stamp, source_digest(Path(__file__).parent))
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
