"""What the command line knows of a command before it is imported."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Entry:
    """Describe a command without importing it.

    Parameters
    ----------
    module
        Module below `asbuilt` that has the function of the same name; it imports what computes
        after it has read robots and recordings, so that bad input is refused early.
    summary
        First line of its help, at most 66 characters.
    examples
        Arguments of two calls.
    call
        Public function of `asbuilt` that does the same.
    compiles
        Whether it calls compiled dynamics.
    bare
        Options that may stand without their value.
    surplus
        What to do with one argument too many, in place of reading the help.
    """

    module: str
    summary: str
    examples: tuple[str, str]
    call: str
    compiles: bool = True
    bare: tuple[str, ...] = ()
    surplus: str = ""


Entries = Mapping[str, Mapping[str, Entry]]
"""Commands by group, or by the command whose commands they are."""
