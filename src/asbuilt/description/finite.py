"""Numbers that people and programs write into descriptions."""

from __future__ import annotations

import math

from asbuilt.errors import DescriptionError


def finite_number(text: str, what: str) -> float:
    """Return the finite number that a text says.

    Raises `DescriptionError` with `what` it is and the text otherwise.

    >>> finite_number("1e-3", "line 2: mass")
    0.001
    """
    try:
        value = float(text)
    except ValueError:
        raise DescriptionError(f"{what} is {text!r}; it must be a number") from None
    if not math.isfinite(value):
        raise DescriptionError(f"{what} is {text}; it must be finite")
    return value
