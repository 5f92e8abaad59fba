"""Fields of option classes: their text, range and parser stated once, read by every interface."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field, fields
from typing import Any

from asbuilt.errors import UsageError


@dataclass(frozen=True, slots=True)
class Range:
    """Bound the numbers that a field may hold; NaN is in no range.

    Parameters
    ----------
    lower, upper
        The least and the largest number; `lower` itself is left out if `above`.
    unit
        Of both, for messages.
    """

    lower: float
    upper: float
    unit: str = ""
    above: bool = False

    def holds(self, value: Any) -> bool:
        """Return whether a value is a number of the range; True and False are none."""
        if isinstance(value, bool) or not isinstance(value, int | float):
            return False
        return self.lower <= value <= self.upper and not (self.above and value == self.lower)

    def __str__(self) -> str:
        least = "above" if self.above else "from"
        return f"{least} {self.lower:g} to {self.upper:g} {self.unit}".rstrip()


def option(default: Any, metavar: str, help: str, **further: Any) -> Any:
    """Return a field with its default, the name of its value, and its text.

    `further` are `range`, `choices`, `parse`, from text, `names` of a registry, `also`, more
    spellings, and what the command line gives its parser as `typer`.
    """
    return switch(default, help, metavar=metavar, **further)


def switch(default: Any, help: str, **further: Any) -> Any:
    """Return a field that is on or off, with its text."""
    return field(default=default, metadata={"help": help} | further)


def check_choice(name: str, value: Any, known: Collection[Any], **fields: Any) -> None:
    """Raise `UsageError` unless a value is among the known ones."""
    if value not in known:
        raise UsageError(
            f"{name} {value!r} is not one of {', '.join(known)}",
            value=value,
            available=[*known],
            **fields,
        )


def check_ranges(options: Any) -> None:
    """Raise `UsageError` unless every field with a `range` in its metadata holds numbers of it.

    None and texts, which stand for a choice, are passed over; of a tuple, every number counts.

    >>> from asbuilt import DesignOptions
    >>> DesignOptions(duration=float("nan"))
    Traceback (most recent call last):
    ...
    asbuilt.errors.UsageError: duration is nan; it must be a number from 0.01 to 3600 s
    """
    for item in fields(options):
        allowed = item.metadata.get("range")
        given = getattr(options, item.name)
        if allowed is None or given is None or isinstance(given, str):
            continue
        for value in given if isinstance(given, tuple) else (given,):
            if not allowed.holds(value):
                raise make_range_error(item.name, value, allowed)


def make_range_error(name: str, value: Any, allowed: Range) -> UsageError:
    """Return the error of a number beyond its range."""
    shown = f"{value:g}" if isinstance(value, float) else str(value)[:60]
    return UsageError(
        f"{name} is {shown}; it must be a number {allowed}",
        field=name,
        value=value if abs(value) < 1e300 else shown,
        lower=allowed.lower,
        upper=allowed.upper,
    )
