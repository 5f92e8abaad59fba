"""The formats of robot descriptions, each registered by the file that reads it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from asbuilt.description.model import RobotModel
from asbuilt.registry import Registry


@dataclass(frozen=True, slots=True)
class DescriptionFormat:
    """Describe a format of robot descriptions.

    Parameters
    ----------
    title
        Name for messages, such as "URDF".
    suffixes
        Suffixes of its files, in lower case with the dot.
    read
        Function that reads a file; raises `DescriptionError` if it makes no sense.
    recognises
        Function that recognises the content of a file, for suffixes that several formats have;
        None where the suffix decides.
    on_bases
        Whether `read` takes `fixed_base`, to hold a free joint at its pose, and `base`, on which
        the first body stands; other formats give that body no mass.
    """

    title: str
    suffixes: tuple[str, ...]
    read: Callable[..., RobotModel]
    recognises: Callable[[bytes], bool] | None = None
    on_bases: bool = False


DESCRIPTION_FORMATS: Registry[DescriptionFormat] = Registry(
    "description format", "asbuilt.description.formats", "asbuilt.description_formats"
)
"""All formats; other distributions add theirs by an entry point of group
`asbuilt.description_formats` that names the module.
"""


def list_suffixes() -> tuple[str, ...]:
    """Return the suffixes of all formats, sorted."""
    return tuple(
        sorted({suffix for each in DESCRIPTION_FORMATS.values() for suffix in each.suffixes})
    )


def format_of(path: Path, content: bytes) -> DescriptionFormat | None:
    """Return the format of a file, by its suffix if that decides, else by content."""
    by_suffix = [
        each for each in DESCRIPTION_FORMATS.values() if path.suffix.lower() in each.suffixes
    ]
    certain = [each for each in by_suffix if each.recognises is None]
    by_content = (
        each
        for each in DESCRIPTION_FORMATS.values()
        if each.recognises is not None and each.recognises(content)
    )
    return certain[0] if certain else next(by_content, None)
