"""XML of unknown origin, parsed without entities or external references.

Every attribute is checked where it is read.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable
from pathlib import Path
from xml.etree.ElementTree import Element, ParseError

from defusedxml import DefusedXmlException
from defusedxml.ElementTree import fromstring

from asbuilt.description.finite import parse_finite_number
from asbuilt.errors import DescriptionError
from asbuilt.ranges import Range
from asbuilt.untrusted import read_bytes

LARGEST_DESCRIPTION = 20_000_000
"""Bytes; a description of a robot without its meshes is hundreds of times smaller."""
DEEPEST_ELEMENT = 250
"""Levels of nesting; a chain of 100 bodies in MJCF has about 100."""
SIZES = Range(0.0, 1e4, "m")
"""Sizes of shapes; some have none in one direction."""
TEXT = "the description"
"""What messages call a description that is given as a text."""
_TAG_OR_COMMENT = re.compile(rb"<(?:!--|(?:\w+:)?([A-Za-z_][\w.-]*))")


def described_text(path_or_text: str | Path | bytes) -> tuple[bytes, str]:
    """Return content and name of a description given as a path or as text.

    The name is for error messages.

    Raises `DescriptionError` for a file that cannot be read or is larger than any description.
    """
    if isinstance(path_or_text, bytes):
        return path_or_text, TEXT
    if isinstance(path_or_text, str) and "<" in path_or_text:
        return path_or_text.encode(), TEXT
    path = Path(path_or_text)
    return read_bytes(path, "description", DescriptionError, LARGEST_DESCRIPTION), str(path)


def find_outermost_tag(content: bytes) -> str:
    """Return the name of the first element of an XML text, comments passed over.

    An empty text where there is none.
    """
    if content.startswith((b"\xff\xfe", b"\xfe\xff")):
        content = content.decode("utf-16", "replace").encode()
    match = _TAG_OR_COMMENT.search(content)
    while match and match[1] is None:
        end = content.find(b"-->", match.end())
        match = _TAG_OR_COMMENT.search(content, end + 3) if end >= 0 else None
    return match[1].decode() if match else ""


def parse_xml(content: bytes, source: str) -> Element:
    """Return the root element.

    Entities, external references and malformed text raise `DescriptionError`.
    """
    try:
        root: Element = fromstring(content)
    except DefusedXmlException as error:
        what = type(error).__name__.removesuffix("Forbidden").lower()
        raise DescriptionError(
            f"{source}: the XML declares or refers to {what} ({error}); a robot description needs"
            " none, and they can hide an attack: remove them"
        ) from None
    except ParseError as error:
        raise DescriptionError(f"{source}: this is not well-formed XML: {error}") from None
    except (ValueError, LookupError) as error:
        raise DescriptionError(f"{source}: the XML cannot be decoded: {error}") from None
    _refuse_depth(root, source)
    for element in root.iter():
        if not isinstance(element.tag, str):
            continue
        namespace, _, tag = element.tag.rpartition("}")
        if "xacro" in namespace:
            raise DescriptionError(
                f"{source}: the file holds <xacro:{tag}>, so it is not expanded yet: run  xacro"
                " FILE > robot.urdf  and load that"
            )
        for attribute, value in element.attrib.items():
            if "${" in value or "$(" in value:
                raise DescriptionError(
                    f"{source}: <{tag}> has {attribute}={value!r}, a xacro expression that is not"
                    " expanded yet: run  xacro FILE > robot.urdf  and load that"
                )
        element.tag = tag
    return root


def _refuse_depth(root: Element, source: str) -> None:
    layer = [root]
    for _ in range(DEEPEST_ELEMENT):
        layer = [child for element in layer for child in element]
        if not layer:
            return
    raise DescriptionError(
        f"{source}: elements are nested too deeply, beyond {DEEPEST_ELEMENT} levels; check that it"
        " is a robot description"
    )


def require_attribute(element: Element, attribute: str, place: str) -> str:
    """Return a required attribute; raises `DescriptionError` with place and attribute."""
    value = element.get(attribute)
    if value is None or not value.strip():
        raise DescriptionError(f"{place}: <{element.tag}> has no {attribute}; add {attribute}=...")
    return value.strip()


def read_number(
    element: Element, attribute: str, place: str, default: float | None = None
) -> float:
    """Return a finite number from an attribute.

    Raises `DescriptionError` where it is missing (without default), no number or not finite.
    """
    if default is not None and element.get(attribute) is None:
        return default
    return parse_finite_number(
        require_attribute(element, attribute, place), f"{place}: {attribute} of <{element.tag}>"
    )


def read_numbers(element: Element, attribute: str, count: int, place: str) -> list[float]:
    """Return `count` finite numbers separated by blanks.

    Raises `DescriptionError` with place and value.
    """
    text = require_attribute(element, attribute, place)
    return parse_numbers(text, count, f"{place}: {attribute} of <{element.tag}>")


def parse_numbers(text: str, count: int, what: str) -> list[float]:
    """Return the `count` finite numbers of a text, separated by blanks."""
    cells = text.split()
    if len(cells) != count:
        raise DescriptionError(f"{what} is {text!r}; expected {count} numbers separated by blanks")
    return [parse_finite_number(cell, what) for cell in cells]


def read_origin(origin: Element | None, place: str) -> tuple[list[float], list[float]]:
    """Return `xyz` and `rpy` of an `<origin>`, zeros where they are not given."""
    xyz, rpy = (
        read_numbers(origin, key, 3, place)
        if origin is not None and origin.get(key) is not None
        else [0.0, 0.0, 0.0]
        for key in ("xyz", "rpy")
    )
    return xyz, rpy


def read_extents(element: Element, attribute: str, count: int, place: str) -> list[float]:
    """Return `count` sizes of a shape [m], separated by blanks.

    Raises `DescriptionError` with place and value unless each is in `SIZES`.
    """
    values = read_numbers(element, attribute, count, place)
    for value in values:
        if not SIZES.holds(value):
            raise DescriptionError(
                f"{place}: {attribute} of <{element.tag}> is {value:g}; it must be a number {SIZES}"
            )
    return values


def close_match(name: str, known: Iterable[str], cutoff: float = 0.6) -> str:
    """Return `" (did you mean 'link_3'?)"` for the nearest known name, or an empty text."""
    matches = difflib.get_close_matches(name, list(known), n=1, cutoff=cutoff)
    return f" (did you mean {matches[0]!r}?)" if matches else ""
