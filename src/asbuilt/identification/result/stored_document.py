"""The JSON document of a stored result, checked before anything is made of it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from asbuilt.errors import ResultError
from asbuilt.findings import Cure
from asbuilt.untrusted import describe_problem, parse_json

FORMAT = "asbuilt identification result"
FORMAT_VERSION = 1
AGAIN = Cure("identify again")
REQUIRED = ("model", "drive", "parameters")
"""Fields without which nothing else is worth reading."""


def parse_stored_document(text: str) -> Mapping[str, Any]:
    """Return the document of a stored result.

    Raises
    ------
    ResultError
        If the text is no such document, or of another version of the format.
    """
    expected = Cure("give the result.json that identify wrote")
    try:
        whole = parse_json(text)
    except ValueError as problem:
        raise ResultError(
            f"this is not a stored result: {describe_problem(problem)}", cure=expected
        ) from None
    if not isinstance(whole, Mapping) or whole.get("format") != FORMAT:
        raise ResultError(
            f"this JSON is not a stored result: its format is not {FORMAT!r}", cure=expected
        )
    if whole.get("version") != FORMAT_VERSION:
        raise ResultError(
            f"this result has format version {whole.get('version')}, this program reads"
            f" {FORMAT_VERSION}",
            cure=AGAIN,
        )
    missing = [name for name in REQUIRED if name not in whole]
    if missing:
        raise ResultError(f"the stored result is damaged: it has no {missing[0]!r}", cure=AGAIN)
    return whole
