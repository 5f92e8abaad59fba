"""Numbers that people and programs write into descriptions."""

from __future__ import annotations

import math
import sys

from asbuilt.errors import DescriptionError

LARGEST = 1e18
"""Largest number of a description in SI units; limits may be as large as `sys.float_info.max`."""


def finite_number(text: str, what: str) -> float:
    """Return the finite number that a text says.

    Raises `DescriptionError` with `what` it is and the text otherwise.

    >>> finite_number("1e-3", "line 2: mass")
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
