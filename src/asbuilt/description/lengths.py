"""Translations whose lengths have letters, so that base parameters can be written with letters."""

from __future__ import annotations

import re
from collections.abc import Mapping

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.model import Letters
from asbuilt.errors import DescriptionError

NO_LETTERS: Letters = ((), (), ())
"""The letters of a translation that is zero."""

_NUMBER = r"(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?"
_TERM = re.compile(
    rf"\s*(?P<sign>[+-])?\s*(?:(?P<factor>{_NUMBER})\s*\*\s*)?(?P<letter>[A-Za-z_]\w*)\s*"
)


def named(letters: Letters | None) -> Letters | None:
    """Return the letters, or None where there is not one."""
    return letters if letters is not None and any(letters) else None


def parsed_length(text: str, lengths: Mapping[str, float]) -> tuple[tuple[float, str], ...]:
    """Return the sum of (factor, letter) that a text such as `"L1 - 0.5*L2"` stands for.

    Raises `DescriptionError` where the text is no such sum or a letter is not among `lengths`.
    """
    terms: list[tuple[float, str]] = []
    position = 0
    while position < len(text):
        match = _TERM.match(text, position)
        if match is None or (terms and match["sign"] is None):
            raise DescriptionError(
                f"the length {text!r} is not a sum of named lengths such as 'L1' or '-0.5*L1 + L2'"
            )
        if match["letter"] not in lengths:
            known = ", ".join(sorted(lengths)) or "none"
            raise DescriptionError(
                f"the length {text!r} uses {match['letter']!r}, which is not among the named"
                f" lengths ({known})"
            )
        factor = float(match["factor"] or 1.0) * (-1.0 if match["sign"] == "-" else 1.0)
        terms.append((factor, match["letter"]))
        position = match.end()
    if not terms:
        raise DescriptionError("a length is an empty text; give a number or a sum of named lengths")
    return tuple(terms)


def rotated_letters(rotation: Array, letters: Letters) -> Letters:
    """Return the letters of `R p` for the letters of p; factors that vanish are left out."""
    return tuple(
        tuple(
            (float(rotation[row, column] * factor), letter)
            for column in range(3)
            for factor, letter in letters[column]
            if rotation[row, column] != 0.0
        )
        for row in range(3)
    )


def added_letters(first: Letters, second: Letters) -> Letters:
    """Return the letters of the sum of two translations, equal letters gathered."""
    result = []
    for one, two in zip(first, second, strict=True):
        gathered: dict[str, float] = {}
        for factor, letter in (*one, *two):
            gathered[letter] = gathered.get(letter, 0.0) + factor
        result.append(
            tuple((factor, letter) for letter, factor in gathered.items() if factor != 0.0)
        )
    return tuple(result)


def length_values(letters: Letters, lengths: Mapping[str, float]) -> Array:
    """Return the translation [m] that the letters stand for, shape (3,)."""
    return np.array(
        [sum((factor * lengths[letter] for factor, letter in terms), 0.0) for terms in letters]
    )
