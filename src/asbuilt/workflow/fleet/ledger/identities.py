"""Identities of robots: what they may be, their folders, and how they are found in paths."""

from __future__ import annotations

from urllib.parse import quote, unquote

from asbuilt.errors import UsageError
from asbuilt.findings import Cure

LONGEST = 60
"""Characters of an identity."""
LONGEST_PATTERN = 250
"""Characters of a pattern that finds identities in paths."""


def checked_id(robot_id: str) -> str:
    """Return the identity of a robot.

    Raises `UsageError` unless it is one line of 1 to 60 printable characters whose folder can be
    made; letters of other scripts take up to nine bytes of its name.
    """
    folder = quote(robot_id, safe=" ", errors="replace")
    if not (robot_id.strip() and robot_id.isprintable() and len(robot_id) <= LONGEST):
        raise UsageError(
            f"the identity of a robot has 1 to {LONGEST} printable characters, got"
            f" {robot_id[: LONGEST + 1]!r}",
            cure=Cure("give a short name or a serial number"),
        )
    # Bytes of a folder's name that every file system takes.
    if len(folder) > 250:
        raise UsageError(f"the identity {robot_id!r} is too long for the name of a folder")
    return robot_id


def folder_of(robot_id: str) -> str:
    """Return the folder of a robot's entries; raises as `checked_id` does."""
    return "logs/" + quote(checked_id(robot_id), safe=" ").replace(".", "%2E")


def robot_of(folder: str) -> str:
    """Return the robot of a folder of entries."""
    return unquote(folder)


def is_folder(name: str) -> bool:
    """Return whether this is the name of a robot's folder."""
    try:
        return folder_of(robot_of(name)) == f"logs/{name}"
    except UsageError:
        return False


def identity_in(pattern: str, path: str) -> str | None:
    """Return what stands at `{id}` where a pattern matches the end of a path; None if it does not.

    A `*` takes as much of a name as it can, `{id}` as little, and both stay within one name. Every
    pair of a place in the pattern and one in the path is tried once, so that the time is bounded
    by the product of the lengths, which backtracking is not.

    >>> identity_in("*_{id}.csv", "logs/run_1_arm.csv")
    'arm'
    """
    before, _, after = pattern.partition("{id}")
    parts = [*before, "first", "rest", *after]
    starts = [0, *(k + 1 for k, letter in enumerate(path) if letter == "/")]
    waiting, tried = [(0, k, 0, 0) for k in reversed(starts)], set()
    while waiting:
        place, at, first, last = waiting.pop()
        if (place, at) in tried:
            continue
        tried.add((place, at))
        if place == len(parts):
            if at == len(path):
                return path[first:last]
            continue
        part, letter = parts[place], path[at : at + 1]
        inside = letter not in ("", "/")
        if part == "first":
            waiting += [(place + 1, at + 1, at, at)] * inside
        elif part == "rest":
            waiting += [(place, at + 1, first, last)] * inside + [(place + 1, at, first, at)]
        elif part == "*":
            waiting += [(place + 1, at, first, last)] + [(place, at + 1, first, last)] * inside
        elif part == letter:
            waiting.append((place + 1, at + 1, first, last))
    return None
