"""Translations whose lengths have symbols, so that base parameters can be written with symbols."""

from __future__ import annotations

import re
from collections.abc import Mapping

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.model import Symbols
from asbuilt.errors import DescriptionError

NO_SYMBOLS: Symbols = ((), (), ())
"""The symbols of a translation that is zero."""

_NUMBER = r"(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?"
_TERM = re.compile(
    rf"\s*(?P<sign>[+-])?\s*(?:(?P<factor>{_NUMBER})\s*\*\s*)?(?P<symbol>[A-Za-z_]\w*)\s*"
)


def drop_empty_symbols(symbols: Symbols | None) -> Symbols | None:
    """Return the symbols, or None where there is not one."""
    return symbols if symbols is not None and any(symbols) else None


def parse_length(text: str, lengths: Mapping[str, float]) -> tuple[tuple[float, str], ...]:
    """Return the sum of (factor, symbol) that a text such as `"L1 - 0.5*L2"` stands for.

    Raises `DescriptionError` where the text is no such sum or a symbol is not among `lengths`.
    """
    terms: list[tuple[float, str]] = []
    position = 0
    while position < len(text):
        match = _TERM.match(text, position)
        if match is None or (terms and match["sign"] is None):
            raise DescriptionError(
                f"the length {text!r} is not a sum of named lengths such as 'L1' or '-0.5*L1 + L2'"
            )
        if match["symbol"] not in lengths:
            known = ", ".join(sorted(lengths)) or "none"
            raise DescriptionError(
                f"the length {text!r} uses {match['symbol']!r}, which is not among the named"
                f" lengths ({known})"
            )
        factor = float(match["factor"] or 1.0) * (-1.0 if match["sign"] == "-" else 1.0)
        terms.append((factor, match["symbol"]))
        position = match.end()
    if not terms:
        raise DescriptionError("a length is an empty text; give a number or a sum of named lengths")
    return tuple(terms)


def rotate_symbols(rotation: Array, symbols: Symbols) -> Symbols:
    """Return the symbols of `R p` for the symbols of p; factors that vanish are left out."""
    return tuple(
        tuple(
            (float(rotation[row, column] * factor), symbol)
            for column in range(3)
            for factor, symbol in symbols[column]
            if rotation[row, column] != 0.0
        )
        for row in range(3)
    )


def add_symbols(first: Symbols, second: Symbols) -> Symbols:
    """Return the symbols of the sum of two translations, equal symbols gathered."""
    result = []
    for one, two in zip(first, second, strict=True):
        gathered: dict[str, float] = {}
        for factor, symbol in (*one, *two):
            gathered[symbol] = gathered.get(symbol, 0.0) + factor
        result.append(
            tuple((factor, symbol) for symbol, factor in gathered.items() if factor != 0.0)
        )
    return tuple(result)


def evaluate_lengths(symbols: Symbols, lengths: Mapping[str, float]) -> Array:
    """Return the translation [m] that the symbols stand for, shape (3,)."""
    return np.array(
        [sum((factor * lengths[symbol] for factor, symbol in terms), 0.0) for terms in symbols]
    )
