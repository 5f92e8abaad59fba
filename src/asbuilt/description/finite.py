"""Numbers and tables that people and programs write into descriptions."""

from __future__ import annotations

import csv
import math
import sys
from pathlib import Path

from asbuilt.errors import DescriptionError
from asbuilt.untrusted import read_text

LARGEST = 1e18
"""Largest number of a description in SI units; limits may be as large as `sys.float_info.max`."""


def parse_finite_number(text: str, what: str) -> float:
    """Return the finite number that a text says.

    Raises `DescriptionError` with `what` it is and the text otherwise.

    >>> parse_finite_number("1e-3", "line 2: mass")
    0.001
    """
    try:
        value = float(text)
    except ValueError:
        raise DescriptionError(f"{what} is {text[:60]!r}; it must be a number") from None
    if not math.isfinite(value):
        raise DescriptionError(f"{what} is {text[:60]}; it must be finite")
    if abs(value) > LARGEST and abs(value) != sys.float_info.max:
        raise DescriptionError(f"{what} is {text[:60]}; it must be at most {LARGEST:g}")
    return value


def read_rows(path: Path, separators: str, row_of: str) -> tuple[list[tuple[int, list[str]]], str]:
    """Return the rows of a CSV table with the numbers of their lines, and the separator.

    It is the one of `separators` that the header has most of. Raises `DescriptionError` where the
    file is no such table, or has no row of a `row_of` below its header.
    """
    text = read_text(path, "table", DescriptionError)
    try:
        separator = max(separators, key=text.partition("\n")[0].count)
        reader = csv.reader(text.splitlines(), delimiter=separator, skipinitialspace=True)
        lines = [(reader.line_num, row) for row in reader if any(cell.strip() for cell in row)]
    except csv.Error as error:
        raise DescriptionError(f"{path}: the table cannot be read as CSV text: {error}") from None
    if len(lines) < 2:
        raise DescriptionError(
            f"{path}: the table has no rows; expected a header and one row per {row_of}"
        )
    return lines, separator
