"""What was chosen on the page, what those files hold, and the options it may give to a command."""

from __future__ import annotations

import difflib
import os
import re
import shlex
import stat
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, fields
from functools import cache
from hashlib import blake2b
from itertools import islice
from pathlib import Path
from typing import Any

from asbuilt import Cure, ReadingOptions, StudyOptions, UsageError
from asbuilt.cli import Filtering, name_option

LONGEST_TEXT = 4096
"""Bytes of a path, as of the system, and of a line of options."""
MOST_LOGS = 1000
"""Recordings that are chosen at once."""
ROLES = ("logs", "validation", "payload")
"""Fields of `Choices` that hold recordings."""
EXPORTS = {
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
    logs, validation, payload
        Paths of recordings: to identify with, to validate on, and with a load to identify.
    reading
        Options of how logs are read, as on a command line.
    options
        Options of `identify`, as on a command line.
    effects
        Value of `--effects`; empty: its default.
    export
        A format of `EXPORTS`.

    Raises
    ------
    UsageError
        If a text is no path, or a line holds what the page does not give to a command.
    """

    robot: str = ""
    logs: tuple[str, ...] = ()
    validation: tuple[str, ...] = ()
    payload: tuple[str, ...] = ()
    reading: str = ""
    options: str = ""
    effects: str = ""
    export: str = "urdf"

    def __post_init__(self) -> None:
        for path in (self.robot, *self.recordings):
            if path.startswith("-"):
                raise UsageError(f"{path!r} looks like an option; write ./{path}")
            _check_text(path)
        if len(self.recordings) > MOST_LOGS:
            raise UsageError(f"more than {MOST_LOGS} recordings are chosen")
        for line in LINES:
            read_options(line, getattr(self, line))
        _check_text(self.effects)
        if self.export not in EXPORTS:
            raise UsageError(
                f"there is no format {self.export!r}", value=self.export, available=[*EXPORTS]
            )

    @property
    def recordings(self) -> tuple[str, ...]:
        """All recordings, whatever they are for."""
        return (*self.logs, *self.validation, *self.payload)

    @classmethod
    def of(cls, given: Mapping[str, Any]) -> dict[str, Any]:
        """Return the fields given, each of its type; raises `UsageError` for anything else."""
        chosen: dict[str, Any] = {}
        for entry in fields(cls):
            if entry.name in given:
                value = given[entry.name]
                several = entry.name in ROLES
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


READ_WHOLE = 256_000_000
"""Bytes of a file that is read for its fingerprint: less than half a second. The system's record
of the last change stands for a longer one: nothing can be written without changing it."""
REFERRING = (".urdf", ".xml", ".mjcf", ".xacro", ".sdf", ".toml")
"""Ends of files that name other files, such as meshes, includes and logs."""
LONGEST_REFERRING = 2_000_000
"""Bytes of a file that people write, as of descriptions that are read."""
MOST_FILES = 20_000
"""Files of a folder, and of one description, that are looked at."""
CHUNK = 1 << 20
_QUOTED = re.compile(r"""["']([^"'\n\0]{1,500})["']""")


class Fingerprints:
    """Read what files hold, each content once.

    Parameters
    ----------
    written
        Folder that is written into, which is no part of a folder that is read.
    """

    def __init__(self, written: Path) -> None:
        self._written = written
        self._held: dict[Path, str] | None = None
        self._contents: dict[tuple[str, int, int, int, int], str] = {}
        self._references: dict[str, tuple[str, ...]] = {}

    @contextmanager
    def hold(self) -> Iterator[None]:
        """Look at each file once inside a `with` statement, which is one moment."""
        before = self._held
        self._held = {} if before is None else before
        try:
            yield
        finally:
            self._held = before

    def of_inputs(self, *paths: str | Path) -> str:
        """Return the fingerprint of files and folders and of the files that they name."""
        mark = blake2b(digest_size=16)
        for path in paths:
            for file in (Path(path), *self._list_referenced(Path(path))):
                mark.update(f"{file}\0{self.of(file)}\0".encode("utf-8", "surrogateescape"))
        return mark.hexdigest()

    def of(self, path: Path) -> str:
        """Return the fingerprint of a file, or of all files of a folder; empty if there is none."""
        held = {} if self._held is None else self._held
        if path not in held:
            held[path] = self._look(path)
        return held[path]

    def _look(self, path: Path) -> str:
        try:
            state = path.stat()
            if stat.S_ISREG(state.st_mode):
                return self._read(path, state)
            if not stat.S_ISDIR(state.st_mode):
                return ""
            mark = blake2b(digest_size=16)
            for file in sorted(islice(self._list_files(path), MOST_FILES)):
                own = self._read(file, file.stat())
                mark.update(f"{file}\0{own}\0".encode("utf-8", "surrogateescape"))
        except (OSError, ValueError):
            return ""
        return mark.hexdigest()

    def _read(self, path: Path, state: os.stat_result) -> str:
        """Return the digest of a file that has not changed since it was read, else read it."""
        times = (state.st_mtime_ns, state.st_ctime_ns)
        known = (str(path), state.st_ino, state.st_size, *times)
        if known not in self._contents:
            mark = blake2b(digest_size=16)
            if state.st_size > READ_WHOLE:
                mark.update(repr(known).encode("utf-8", "surrogateescape"))
            else:
                with path.open("rb") as stream:
                    while piece := stream.read(CHUNK):
                        mark.update(piece)
            self._contents[known] = mark.hexdigest()
        return self._contents[known]

    def _list_referenced(self, path: Path) -> list[Path]:
        """Return the files beside a description or a sheet that it names, and those they name."""
        seen: dict[Path, None] = {}
        waiting = [path]
        while waiting and len(seen) < MOST_FILES:
            for file in self._find_named(waiting.pop()):
                if file not in seen and file != path:
                    seen[file] = None
                    waiting.append(file)
        return list(seen)

    def _find_named(self, path: Path) -> Iterator[Path]:
        """Yield the files that are named between quotes, wherever they lie below the folder."""
        if path.suffix.lower() not in REFERRING or not path.is_file():
            return
        mark = self.of(path)
        if mark not in self._references:
            with path.open("rb") as stream:
                text = stream.read(LONGEST_REFERRING).decode("utf-8", "replace")
            quoted = (name.split("://")[-1] for name in _QUOTED.findall(text))
            self._references[mark] = tuple(dict.fromkeys(quoted))
        names = self._references[mark]
        folder = path.parent
        with suppress(OSError, ValueError):
            folders = [folder, *(folder / name for name in names if (folder / name).is_dir())]
            for name in names:
                # The name of a ROS package stands before the path in it.
                for tail in (name, name.partition("/")[2]):
                    if tail and "." in tail:
                        yield from (place / tail for place in folders if (place / tail).is_file())

    def _list_files(self, folder: Path) -> Iterator[Path]:
        """Yield the files of a folder and of those in it, in no order."""
        for place, folders, names in os.walk(folder):
            folders[:] = [folder for folder in folders if Path(place) / folder != self._written]
            yield from (Path(place) / name for name in names)
