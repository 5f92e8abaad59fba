"""Stored results and studies."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

from asbuilt.errors import ResultError
from asbuilt.identification.result.stored_document import parse_stored_document
from asbuilt.untrusted import read_text

if TYPE_CHECKING:
    from asbuilt.identification.result.result import IdentificationResult
    from asbuilt.workflow.study_result import Study

RESULT = "result.json"
LARGEST = 30_000_000
"""Bytes of a stored result; a result of seven joints has 0.4 MB."""


def read_result(path: str | os.PathLike[str]) -> IdentificationResult:
    """Read a stored result.

    Parameters
    ----------
    path
        The `result.json` that `identify` or `write_result` wrote, or the folder that holds it.

    Raises
    ------
    ResultError
        If the file cannot be read, is not a stored result, or is damaged.
    """
    return read_study(path).result


def read_study(path: str | os.PathLike[str]) -> Study:
    """Read a stored result with the findings of its study.

    Raises
    ------
    ResultError
        If the file cannot be read, is not a stored result, or is damaged.
    """
    place = Path(path)
    # `identify --out` names a folder, and so do those who use what it wrote.
    place = place / RESULT if place.is_dir() else place
    text = read_text(place, "result", ResultError, LARGEST)
    try:
        # Checked before the study is imported, which takes longer than the check.
        parse_stored_document(text)
        from asbuilt.workflow.study_result import Study  # noqa: PLC0415 (heavy, and of no use before)

        return Study.from_json(text)
    except ResultError as problem:
        raise ResultError(f"{path}: {problem.message}", cure=problem.cure, file=str(path)) from None
