"""Templates of programs, filled in."""

from __future__ import annotations

from collections.abc import Iterable
from functools import cache
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined


def render(template: str, **values: Any) -> str:
    """Return a template of this room filled in; a value that the template needs and does not get is an error."""
    return _environment().get_template(template).render(**values)


def numbers(values: Iterable[float], decimals: int = 6) -> str:
    """Return numbers with a fixed count of decimals, separated by commas; no minus before zero.

    Examples
    --------
    >>> numbers([1.0, -0.25, -1e-9], 3)
    '1.000, -0.250, 0.000'
    """
    return ", ".join(f"{round(float(value), decimals) + 0.0:.{decimals}f}" for value in values)


@cache
def _environment() -> Environment:
    return Environment(
        loader=PackageLoader("asbuilt.excitation.programs"),
        undefined=StrictUndefined,
        autoescape=False,
        keep_trailing_newline=True,
        trim_blocks=True,
        lstrip_blocks=True,
    )
