"""The lines and documents that list the files written."""

from __future__ import annotations

import base64
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any


def path_texts(files: Mapping[str, str | os.PathLike[str]] | None) -> dict[str, str]:
    """Return the paths of files by kind as text, for documents."""
    return {kind: os.fspath(path) for kind, path in (files or {}).items()}


def with_files(
    document: Mapping[str, Any], files: Mapping[str, str | os.PathLike[str]]
) -> dict[str, Any]:
    """Return a JSON document with the paths of what was written."""
    return {**document, "files": path_texts(files)}


def data_address(content: bytes, kind: str) -> str:
    """Return the address of content that a page holds itself; `kind` such as `image/png`."""
    return f"data:{kind};base64,{base64.b64encode(content).decode('ascii')}"


def file_lines(
    files: Mapping[str, Path], notes: Mapping[str, Sequence[str]], width: int
) -> list[str]:
    """Return a line for every file, its kind in a column of this width, and a line for each note.

    A kind without a file has its first note in the place of the path.
    """
    lines = []
    for kind in dict.fromkeys((*files, *notes)):
        remarks = list(notes.get(kind, ()))
        lines.append(f"  {kind:<{width}} {files[kind] if kind in files else remarks.pop(0)}")
        lines += [f"  {'':<{width}} note: {note}" for note in remarks]
    return lines


def quote_yaml(text: str) -> str:
    r"""Return a text as YAML, where JSON's pairs of surrogates would be two characters.

    Examples
    --------
    >>> print(quote_yaml('a "b" \u540d'))
    "a \U00000022b\U00000022 \U0000540d"
    """
    plain = (
        character
        if " " <= character <= "~" and character not in '"\\'
        else f"\\U{ord(character):08x}"
        for character in text
    )
    return f'"{"".join(plain)}"'
