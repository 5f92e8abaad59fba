"""Cases of which a few are run each time, and all in `make studies`."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import islice
from typing import Any

import pytest


def first_of(count: int, cases: Iterable[Any]) -> list[Any]:
    """Return the cases, those after the first `count` marked as studies."""
    remaining = iter(cases)
    first = list(islice(remaining, count))
    return first + [
        pytest.param(
            *_parts(each),
            marks=(pytest.mark.study, *getattr(each, "marks", ())),
            id=getattr(each, "id", None),
        )
        for each in remaining
    ]


def _parts(case: Any) -> tuple[Any, ...]:
    """Return the values of a case, be it a `pytest.param`, a tuple of several or a single one."""
    return tuple(getattr(case, "values", case)) if isinstance(case, tuple) else (case,)
