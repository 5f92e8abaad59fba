"""Stored thresholds."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path

from asbuilt.codec import FieldError, json_text, plain, restored
from asbuilt.errors import ResultError
from asbuilt.findings import Cure
from asbuilt.monitoring.thresholds import Thresholds
from asbuilt.untrusted import parsed_json, read_text

FORMAT = "asbuilt thresholds"
LARGEST = 1_000_000
"""Bytes of a file of thresholds; that of seven joints has 4 kB."""


def thresholds_text(thresholds: Thresholds) -> str:
    """Return thresholds as JSON that `read_thresholds` reads."""
    return json_text({"format": FORMAT, **plain(thresholds)})


def read_thresholds(path: str | os.PathLike[str]) -> Thresholds:
    """Read thresholds that `watch` wrote.

    Raises
    ------
    ResultError
        If the file cannot be read, holds no thresholds, or is damaged.
    """
    text = read_text(Path(path), "thresholds", ResultError, LARGEST)
    again = Cure("give the thresholds.json that watch wrote")
    try:
        whole = parsed_json(text)
        if not isinstance(whole, Mapping) or whole.get("format") != FORMAT:
            raise ResultError(f"{path} holds no thresholds", cure=again, file=str(path))
        found = restored(Thresholds, whole)
    except ResultError:
        raise
    except (ValueError, TypeError, KeyError, FieldError) as problem:
        raise ResultError(
            f"{path}: the thresholds are damaged: {problem}", cure=again, file=str(path)
        ) from None
    return found
