"""What was chosen on the page, and the options that the page may give to a command."""

from __future__ import annotations

import difflib
import os
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cache
from pathlib import Path
from typing import Any

from asbuilt import Cure, ReadingOptions, StudyOptions, UsageError
from asbuilt.cli import Filtering, name_option

LONGEST_TEXT = 4096
"""Bytes of a path, as of the system, and of a line of options."""
MOST_LOGS = 1000
"""Recordings that are chosen at once."""
FORMATS = {
    "urdf": ("URDF", "--urdf", "robot_as_built.urdf"),
    "mjcf": ("MJCF (MuJoCo)", "--mjcf", "robot_as_built.xml"),
    "toml": ("robot file of asbuilt", "--toml", "robot_as_built.toml"),
    "c": ("C99 code", "--c", "robot_as_built"),
    "isaac-lab": ("Isaac Lab", "--to", "actuators.py"),
    "usd": ("USD overlay", "--to", "overlay.usda"),
    "mjlab": ("mjlab", "--to", "mjlab.py"),
    "ros2-control": ("ros2_control", "--to", "ros2_control.yaml"),
}
"""Name, option and file of each format of `export`; the page writes into its folder alone."""
LINES: dict[str, tuple[type[Any], ...]] = {
    "reading": (ReadingOptions,),
    "options": (StudyOptions, Filtering),
}
"""Classes whose options each line may hold. None of them runs code or writes a file: those that
do, such as `--trust-xacro`, `--scheduler`, `--mcap` and `--out`, belong to the terminal."""


@dataclass(frozen=True, slots=True)
class Choices:
    """Hold what was chosen by mouse.

    Parameters
    ----------
    robot
        A bundled robot or the path of a description; empty: none yet.
    logs, validation
        Paths of recordings: to identify with, and to validate on.
    reading
        Options of how logs are read, as on a command line.
    options
        Options of `identify`, as on a command line.
    effects
        Value of `--effects`; empty: its default.
    export
        A format of `FORMATS`.

    Raises
    ------
    UsageError
        If a text is no path, or a line holds what the page does not give to a command.
    """

    robot: str = ""
    logs: tuple[str, ...] = ()
    validation: tuple[str, ...] = ()
    reading: str = ""
    options: str = ""
    effects: str = ""
    export: str = "urdf"

    def __post_init__(self) -> None:
        for path in (self.robot, *self.logs, *self.validation):
            if path.startswith("-"):
                raise UsageError(f"{path!r} looks like an option; write ./{path}")
            _check_text(path)
        if len(self.logs) + len(self.validation) > MOST_LOGS:
            raise UsageError(f"more than {MOST_LOGS} recordings are chosen")
        for line in LINES:
            read_options(line, getattr(self, line))
        _check_text(self.effects)
        if self.export not in FORMATS:
            raise UsageError(
                f"there is no format {self.export!r}", value=self.export, available=[*FORMATS]
            )

    @classmethod
    def of(cls, given: Mapping[str, Any]) -> dict[str, Any]:
        """Return the fields given, each of its type; raises `UsageError` for anything else."""
        chosen: dict[str, Any] = {}
        for entry in fields(cls):
            if entry.name in given:
                value = given[entry.name]
                several = entry.name in ("logs", "validation")
                texts = value if several else [value]
                if not isinstance(texts, list) or not all(isinstance(text, str) for text in texts):
                    raise UsageError(f"{entry.name} takes text")
                chosen[entry.name] = tuple(texts) if several else value
        return chosen


def _check_text(text: str) -> None:
    """Raise `UsageError` for a text that no path or word of a command line can be."""
    try:
        size = len(os.fsencode(text))
    except UnicodeError:
        size = LONGEST_TEXT + 1
    if size > LONGEST_TEXT or "\0" in text:
        raise UsageError(f"{text[:40]!r} ... is no path: it is too long, or holds what none can")


@cache
def list_options(line: str) -> dict[str, bool]:
    """Return the options that a line may hold, and whether each is a flag."""
    return {
        option: isinstance(entry.default, bool)
        for group in LINES[line]
        for entry in fields(group)
        if "help" in entry.metadata
        for option in (name_option(entry.name), *entry.metadata.get("also", ()))
    }


@cache
def list_field_options(line: str) -> dict[str, str]:
    """Return the option of each field of the classes of a line, with which a finding is cured."""
    return {entry.name: name_option(entry.name) for group in LINES[line] for entry in fields(group)}


def read_options(line: str, text: str) -> dict[str, str | bool]:
    """Return the options of a line with their values, True for a flag.

    Raises
    ------
    UsageError
        If a quote is open, a value is missing, or a word is no option of the line.

    Examples
    --------
    >>> read_options("reading", "--rate 100 --flip-torque")
    {'--rate': '100', '--flip-torque': True}
    """
    _check_text(text)
    known = list_options(line)
    found: dict[str, str | bool] = {}
    words = iter(split_words(text))
    for word in words:
        option, given, value = word.partition("=")
        if option not in known:
            raise _make_unknown_error(option, known)
        if known[option]:
            found[option] = True
            continue
        following = value if given else next(words, None)
        if following is None:
            raise UsageError(f"{option} needs a value", option=option)
        found[option] = following
    return found


def _make_unknown_error(word: str, known: Mapping[str, bool]) -> UsageError:
    if not word.startswith("-"):
        return UsageError(f"{word[:40]!r} is no option, such as {next(iter(known))} VALUE")
    near = difflib.get_close_matches(word, known, n=1)
    cure = f"did you mean {near[0]}?" if near else "give it to the command in a terminal"
    return UsageError(
        f"{word[:40]} is none of the options that the page gives to a command", cure=Cure(cure)
    )


def set_option(line: str, text: str, option: str, value: str | bool) -> str:
    """Return a line in which an option has a value: True for a flag, False or empty for none.

    >>> set_option("reading", "--rate 100 --flip-torque", "--rate", "200")
    '--rate 200 --flip-torque'
    """
    options = read_options(line, text)
    if option not in list_options(line):
        raise _make_unknown_error(option, list_options(line))
    options[option] = value
    words = (
        [name] if given is True else [name, str(given)]
        for name, given in options.items()
        if given not in (False, "")
    )
    return shlex.join(word for pair in words for word in pair)


def split_words(options: str) -> Sequence[str]:
    """Return the words of a part of a command line."""
    try:
        return shlex.split(options)
    except ValueError as problem:
        raise UsageError(
            f"the options {options[:200]!r} cannot be read: {problem}",
            cure=Cure("close every quote"),
        ) from None


def is_same_robot(one: str, other: str) -> bool:
    """Return whether two choices name one robot, as a file that was mended keeps its name."""
    return Path(one).name == Path(other).name
