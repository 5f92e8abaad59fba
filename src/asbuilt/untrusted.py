"""Files of unknown origin: the one door through which they are read, with limits."""

from __future__ import annotations

import json
import math
import os
import re
import stat
import sys
import tomllib
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, suppress
from contextvars import ContextVar
from pathlib import Path
from types import MappingProxyType
from typing import Any, TypeVar

from asbuilt.errors import AsbuiltError
from asbuilt.findings import Cure

T = TypeVar("T")
TEXT_LIMIT = 2_000_000
"""Bytes of a file that people write; the longest bundled robot has 10 kB."""
TABLE_LIMIT = 200_000_000
"""Bytes of a table or stored result that is read into memory."""
LARGEST_NUMBER = 1e75
"""Largest number of a stored file, whose fourth power is one too; that of a float itself stands for
no limit."""
DEEPEST = 64
"""Levels of nesting; files of robots, sheets and results have fewer than 10."""
MOST_DIGITS = 20
"""Digits of an integer with its sign: 64 bits."""

_INPUTS: ContextVar[set[tuple[int, int]] | None] = ContextVar("files that were read", default=None)
"""Device and number of each file that the running command has read."""
_TRUSTED: ContextVar[bool] = ContextVar("whether xacro files may run any Python", default=False)
_XACRO_ARGUMENTS: ContextVar[Mapping[str, str]] = ContextVar(
    "arguments of xacro files", default=MappingProxyType({})
)
"""Values that take the place of the defaults of `<xacro:arg>`."""


@contextmanager
def hold_value(variable: ContextVar[T], value: T) -> Iterator[None]:
    """Give a variable of the context a value for the time of a `with` statement."""
    token = variable.set(value)
    try:
        yield
    finally:
        variable.reset(token)


def allow_xacro_python(trusted: bool = True) -> AbstractContextManager[None]:
    """Let xacro files run any Python that their expressions hold, if `trusted`."""
    return hold_value(_TRUSTED, trusted or _TRUSTED.get())


def set_xacro_arguments(arguments: Mapping[str, str]) -> AbstractContextManager[None]:
    """Expand xacro files with these arguments, beside those that are set already."""
    return hold_value(_XACRO_ARGUMENTS, {**_XACRO_ARGUMENTS.get(), **arguments})


def list_xacro_arguments() -> dict[str, str]:
    """Return the arguments with which xacro files are expanded."""
    return dict(_XACRO_ARGUMENTS.get())


def protect_inputs() -> AbstractContextManager[None]:
    """Remember every file that is read, so that none of them is replaced."""
    return hold_value(_INPUTS, set())


def note_input(path: Path) -> None:
    """Remember a file that is read by another way than this module."""
    with suppress(OSError, ValueError):
        _note_input(path.stat())


def is_input(path: Path) -> bool:
    """Return whether a file has been read inside `protect_inputs`, whatever its name."""
    try:
        state = path.stat()
    except (OSError, ValueError):
        return False
    return (state.st_dev, state.st_ino) in (_INPUTS.get() or ())


def _note_input(state: os.stat_result) -> None:
    inputs = _INPUTS.get()
    if inputs is not None:
        inputs.add((state.st_dev, state.st_ino))


def is_xacro_trusted() -> bool:
    """Return whether xacro files may run any Python."""
    return _TRUSTED.get()


def check_regular(path: Path, what: str, kind: type[AsbuiltError], limit: float) -> None:
    """Raise an error unless a file exists, is a regular file, and has at most `limit` bytes.

    Parameters
    ----------
    path
        The file. Devices, pipes and sockets never end, and are refused unopened.
    what
        What it should be, such as `"recording sheet"`.
    kind
        Class of the error.
    limit
        Largest size [bytes].
    """
    try:
        state = path.stat()
    except FileNotFoundError:
        raise kind(
            f"{what} {shorten_path(path)} cannot be read: it does not exist", file=str(path)
        ) from None
    except (OSError, ValueError) as problem:
        raise kind(
            f"{what} {shorten_path(path)} cannot be read: {describe_problem(problem)}",
            file=str(path),
        ) from None
    if not stat.S_ISREG(state.st_mode):
        raise kind(
            f"{what} {path} cannot be read: it is not a regular file",
            cure=Cure("give the path of a regular file"),
            file=str(path),
        )
    if state.st_size > limit:
        raise kind(
            f"{what} {path} has {state.st_size / 1e6:.0f} MB; at most {limit / 1e6:.0f} MB are"
            " read",
            cure=Cure("check that it is the right file, or split it"),
            file=str(path),
            value=state.st_size,
            upper=limit,
        )
    _note_input(state)


def read_bytes(path: Path, what: str, kind: type[AsbuiltError], limit: float = TEXT_LIMIT) -> bytes:
    """Return the content of a regular file of at most `limit` bytes.

    Raises
    ------
    AsbuiltError
        Of class `kind`, as `check_regular` does, or if the file cannot be read.
    """
    check_regular(path, what, kind, limit)
    try:
        # A pipe that took the place of the file since would block an ordinary opening.
        descriptor = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0))
        with os.fdopen(descriptor, "rb") as stream:
            return stream.read(int(limit))
    except OSError as problem:
        raise kind(
            f"{what} {path} cannot be read: {describe_problem(problem)}", file=str(path)
        ) from None


@contextmanager
def name_file_in_errors(path: str | os.PathLike[str]) -> Iterator[None]:
    """Let every error name the file whose content is at fault."""
    try:
        yield
    except AsbuiltError as problem:
        if os.fspath(path) not in problem.message:
            problem.message = f"{path}: {problem.message}"
            problem.args = (problem.message,)
        raise


def read_text(path: Path, what: str, kind: type[AsbuiltError], limit: float = TEXT_LIMIT) -> str:
    """Return the text of a regular file in UTF-8, with or without a byte order mark.

    Raises
    ------
    AsbuiltError
        Of class `kind`, as `read_bytes` does, or if the file is not UTF-8.
    """
    content = read_bytes(path, what, kind, limit)
    try:
        return content.decode("utf-8-sig").replace("\r\n", "\n")
    except UnicodeDecodeError as problem:
        raise kind(
            f"{what} {path} cannot be read as text: {describe_problem(problem)}",
            cure=Cure("save it as UTF-8"),
            file=str(path),
        ) from None


def parse_toml(text: str) -> dict[str, Any]:
    """Return the content of a TOML text.

    Raises
    ------
    ValueError
        With the reason, also if it is nested deeper than `DEEPEST` or holds numbers that are too
        long.
    """
    compact = text.translate({ord(" "): None, ord("\t"): None})
    for token in re.finditer(r"[^\s#=,{}\[\]]+", compact):
        if token[0].count(".") > DEEPEST and ".." not in token[0]:
            raise ValueError(f"a key has more than {DEEPEST} parts")
    try:
        content = tomllib.loads(text)
    except RecursionError:
        content = None
    if content is None or measure_depth(content) > DEEPEST:
        raise ValueError(f"it is nested deeper than {DEEPEST} levels")
    return content


def parse_json(text: str | bytes) -> Any:
    """Return the content of a JSON text.

    Raises
    ------
    ValueError
        With the reason, also if it is nested deeper than `DEEPEST` or holds a number that is not
        finite or beyond `LARGEST_NUMBER`.
    """
    try:
        content = json.loads(
            text, parse_constant=_parse_number, parse_float=_parse_number, parse_int=_parse_integer
        )
    except RecursionError:
        content = None
    if content is None or measure_depth(content) > DEEPEST:
        raise ValueError(f"it is empty, or nested deeper than {DEEPEST} levels")
    return content


def _parse_number(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"it holds the number {text[:20]}, which is not finite")
    if abs(value) > LARGEST_NUMBER and abs(value) != sys.float_info.max:
        raise ValueError(f"it holds the number {text[:20]}; at most {LARGEST_NUMBER:g} is read")
    return value


def _parse_integer(text: str) -> int:
    if len(text) > MOST_DIGITS:
        raise ValueError(f"it holds the number {text[:20]}...; at most {MOST_DIGITS} digits")
    return int(text)


def measure_depth(content: Any) -> int:
    """Return the levels of nesting of dictionaries and lists.

    >>> measure_depth({"a": [1, {"b": 2}]})
    3
    """
    level = 0
    layer = [content]
    while layer := [each for each in layer if isinstance(each, dict | list)]:
        level += 1
        if level > DEEPEST:
            return level
        layer = [
            item for each in layer for item in (each.values() if isinstance(each, dict) else each)
        ]
    return level


def describe_problem(problem: BaseException) -> str:
    """Return why something failed in one short line, without the path, which the caller gives."""
    text = getattr(problem, "strerror", None) or str(problem).strip()
    return shorten_line(str(text)) or type(problem).__name__


def shorten_line(text: str, most: int = 200) -> str:
    """Return a text on one line, cut if it is very long."""
    line = " ".join(text.split())
    return line if len(line) <= most else f"{line[:most]}..."


def shorten_path(path: Path | str) -> str:
    """Return a path for a message, cut if it is very long."""
    text = str(path)
    return text if len(text) < 200 else f"{text[:60]}..."
