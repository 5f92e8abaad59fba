"""The comparison of pages with prints fails where words or numbers differ."""

from __future__ import annotations

import pytest

from shown_numbers import missing

PRINTED = """rank  54 of 54   error 0.21 %
-------
A1   2.46  1.2e-05
A2  -0.33  0.0089
"""


@pytest.mark.parametrize(
    ("page", "found"),
    [
        ("rank 54 of 54 error 0.2 %\n...\nA2 -0.30 0.009", True),
        ("A1 2.4 1.1e-05", True),
        ("...\nA2 0.33 0.0089", False),
        ("rank 30 of 54", False),
        ("A1 2.46 9e-05", False),
        ("rank 54 of 54 errors", False),
        ("A2 -0.33 0.0089\n...\nA1 2.46", False),
    ],
)
def test_numbers_and_words(page: str, found: bool) -> None:
    assert bool(missing(page, PRINTED, 0.25)) != found
