"""The exceptions of asbuilt; each also inherits the builtin it specialises, and its message carries values and a way out."""

from __future__ import annotations


class AsbuiltError(Exception):
    """Any error that asbuilt raises on purpose; its message is meant for the user, whole."""


class DescriptionError(AsbuiltError, ValueError):
    """A robot description cannot be read or makes no sense."""


class InertiaError(DescriptionError):
    """Inertial parameters are impossible for a rigid body."""


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
        super().__init__(
            f"{purpose} needs the package {package}, which is not installed: pip install"
            f" 'asbuilt[{extra}]'"
        )
