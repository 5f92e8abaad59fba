"""Exceptions with message, cure and fields, each a child of the builtin it specialises."""

from __future__ import annotations

import re
from typing import Any

from asbuilt.findings import Cure

LONG_WORD = re.compile(r"\S{300,}")
"""Such as a name of 5000 characters from a damaged file, which an error quotes."""


class AsbuiltError(Exception):
    """Any error that asbuilt raises on purpose.

    Parameters
    ----------
    message
        What is wrong, with the value, and what was expected; for people.
    cure
        What to do, as data; its text follows the message.
    fields
        Values for programs, such as `joint="A3"`, `value=7.1`, `lower=-2.9`, `file="log.csv"`;
        they are attributes of the error too.
    """

    def __init__(self, message: str = "", *, cure: Cure | None = None, **fields: Any) -> None:
        message = without_long_words(message)
        super().__init__(message)
        self.message = message
        self.cure = cure
        self.fields = fields

    def __getattr__(self, name: str) -> Any:
        fields = self.__dict__.get("fields", {})
        if name in fields:
            return fields[name]
        raise AttributeError(f"{type(self).__name__} has no field {name!r}; it has {[*fields]}")

    def __str__(self) -> str:
        return f"{self.message}; {self.cure.in_python}" if self.cure else self.message

    def __reduce__(self) -> tuple[Any, ...]:
        return (_restore, (type(self), self.message, self.cure, self.fields))


def without_long_words(text: str) -> str:
    """Return a message with the beginning of each word that no robot, file or joint is called."""
    return LONG_WORD.sub(lambda word: f"{word[0][:60]}...", text)


def _restore(kind: type[AsbuiltError], message: str, cure: Any, fields: Any) -> AsbuiltError:
    error = kind.__new__(kind)
    AsbuiltError.__init__(error, message, cure=cure, **fields)
    return error


class DescriptionError(AsbuiltError, ValueError):
    """A robot description cannot be read or makes no sense."""


class InertiaError(DescriptionError):
    """Inertial parameters are physically inconsistent."""


class RecordingError(AsbuiltError, ValueError):
    """A recording cannot be read or does not fit the robot."""


class MotionError(AsbuiltError, ValueError):
    """A motion is ill-posed or violates a limit."""


class IdentifiabilityError(AsbuiltError, ValueError):
    """The data or the robot's structure do not determine what was asked for."""


class ResultError(AsbuiltError, ValueError):
    """A stored result cannot be read, or does not belong to the robot at hand."""


class UsageError(AsbuiltError, ValueError):
    """An option or argument is wrong."""


class MissingExtraError(AsbuiltError, ImportError):
    """An optional dependency is not installed."""

    def __init__(self, package: str, extra: str, purpose: str) -> None:
        needed = " ".join(_list_packages(extra)) or package
        super().__init__(
            f"{purpose} needs the package {package}, which is not installed",
            cure=Cure(f"run pip install {needed}, or pip install 'asbuilt[{extra}]'"),
            package=package,
            extra=extra,
        )


def _list_packages(extra: str) -> list[str]:
    """Return the distributions of an extra of asbuilt, as its metadata lists them."""
    from importlib import metadata  # noqa: PLC0415 - slow, rarely needed

    try:
        required = metadata.requires("asbuilt") or []
    except metadata.PackageNotFoundError:
        return []
    marked = re.compile(rf"""([\w.-]+).*extra == ["']{extra}["']""")
    return [found[1] for found in map(marked.match, required) if found]
