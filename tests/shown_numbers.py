"""Compare what a page shows with what a program prints: words exactly, numbers about."""

from __future__ import annotations

import re

NUMBER = re.compile(r"(?<![\w.])[-+]?\d[\d.]*(?:e[-+]?\d+)?")
RULE = re.compile(r"-{3,}")


def masked(text: str) -> list[str]:
    """Return the words of a text, numbers replaced by `#` and rules removed."""
    return NUMBER.sub("#", RULE.sub(" ", text)).split()


def numbers(text: str) -> list[str]:
    """Return the numbers of a text as they are written."""
    return [each.rstrip(".") for each in NUMBER.findall(RULE.sub(" ", text))]


def missing(expected: str, printed: str, tolerance: float) -> str:
    """Return the first part of a page, between ellipses, that a print lacks, or an empty string.

    Parameters
    ----------
    tolerance
        Relative difference of numbers; two units of the last digit shown are allowed, too.
    """
    words = masked(printed)
    counts = [word.count("#") for word in words]
    found = numbers(printed)
    place = 0
    for part in re.split(r"\.\.\.$", expected, flags=re.MULTILINE):
        wanted, shown = masked(part), numbers(part)
        starts = (k for k in range(place, len(words) + 1) if words[k : k + len(wanted)] == wanted)
        for start in starts:
            first = sum(counts[:start])
            own = found[first : first + len(shown)]
            if all(_alike(a, b, tolerance) for a, b in zip(shown, own, strict=True)):
                place = start + len(wanted)
                break
        else:
            return part
    return ""


def _alike(shown: str, printed: str, tolerance: float) -> bool:
    one, other = float(shown), float(printed)
    digits = len(shown.partition("e")[0].partition(".")[2])
    last = 10.0**-digits * (10.0 ** int(shown.partition("e")[2] or 0))
    return abs(one - other) <= tolerance * max(abs(one), abs(other)) + 2.0 * last
