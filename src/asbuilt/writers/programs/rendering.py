"""Templates of programs, filled in."""

from __future__ import annotations

from collections.abc import Iterable
from functools import cache
from math import floor
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined


def render(template: str, **values: Any) -> str:
    """Return a template filled in.

    A value that the template needs and does not get is an error.
    """
    return _environment().get_template(template).render(**values)


def numbers(values: Iterable[float], decimals: int = 6) -> str:
    """Return numbers with a fixed count of decimals, separated by commas; no minus before zero.

    Examples
    --------
    >>> numbers([1.0, -0.25, -1e-9], 3)
    '1.000, -0.250, 0.000'
    """
    return ", ".join(f"{round(float(value), decimals) + 0.0:.{decimals}f}" for value in values)


def rounded_down(value: float, decimals: int = 4) -> str:
    """Return a positive number with fixed decimals, rounded down as a limit must be.

    Examples
    --------
    >>> rounded_down(0.06999), rounded_down(0.5)
    ('0.0699', '0.5000')
    """
    return f"{floor(value * 10**decimals + 1e-9) / 10**decimals:.{decimals}f}"


@cache
def _environment() -> Environment:
    return Environment(
        loader=PackageLoader("asbuilt.writers.programs"),
        undefined=StrictUndefined,
        autoescape=False,
        keep_trailing_newline=True,
        trim_blocks=True,
        lstrip_blocks=True,
    )
