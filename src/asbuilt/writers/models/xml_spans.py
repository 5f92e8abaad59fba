"""Byte positions of the elements and attributes of an XML file, to edit some and keep the rest."""

from __future__ import annotations

import codecs
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any
from xml.etree.ElementTree import ParseError

from defusedxml import DefusedXmlException
from defusedxml.ElementTree import DefusedXMLParser

from asbuilt.errors import DescriptionError

# Raw names with prefix, which expat replaces by namespaces.
_NAME = re.compile(rb"<([^\s/>]+)")
_ATTRIBUTE = re.compile(rb"\s+([^\s=/>]+)\s*=\s*(\"[^\"]*\"|'[^']*')")
_TAG_END = re.compile(rb"\s*(/?)>")
_DECLARED = re.compile(rb"""^<\?xml[^>]*?encoding\s*=\s*["']([A-Za-z0-9._-]+)["']""")


@dataclass(eq=False)
class Span:
    """Hold one element: tag without namespace, attributes, and positions in bytes of UTF-8.

    `start` is at the `<`, `inner` behind the `>` of the start tag, `close` at the `</` (None if the
    tag closes itself), `stop` behind the element. `values` has the span of each attribute value
    without its quotes, `named` is behind the last attribute.
    """

    tag: str
    attributes: Mapping[str, str]
    raw_name: str
    start: int
    named: int
    inner: int
    values: Mapping[str, tuple[int, int]]
    close: int | None = None
    stop: int = 0
    children: list[Span] = field(default_factory=list)

    def all(self, tag: str) -> Iterator[Span]:
        """Yield the children with this tag."""
        return (child for child in self.children if child.tag == tag)

    def first(self, tag: str) -> Span | None:
        """Return the first child with this tag."""
        return next(self.all(tag), None)

    def named_as(self, tag: str) -> str:
        # Elements that are added take the prefix of their neighbours.
        """Return `tag` with the namespace prefix of this element, if it has one."""
        prefix, colon, _ = self.raw_name.rpartition(":")
        return prefix + colon + tag


@dataclass(frozen=True, slots=True)
class Edit:
    """Put `text` in place of the bytes from `start` to `stop`."""

    start: int
    stop: int
    text: str


@dataclass(frozen=True, eq=False)
class XmlFile:
    """Hold an XML file with the position of every element."""

    text: bytes
    encoding: str
    root: Span

    @classmethod
    def of(cls, content: bytes, source: str) -> XmlFile:
        """Locate every element; raises `DescriptionError` if the file cannot be edited."""
        # Expat counts bytes of UTF-8, so that the file is edited as such.
        encoding = _detect_encoding(content)
        try:
            decoded = content.decode(encoding)
            # What does not encode to the same bytes would change all the file.
            faithful = decoded.encode(encoding) == content
        except (UnicodeError, LookupError) as error:
            raise DescriptionError(
                f"{source}: the XML cannot be decoded as {encoding}: {error}"
            ) from None
        if not faithful:
            raise DescriptionError(
                f"{source}: the encoding {encoding} does not give the file's own bytes back; save"
                " the file as UTF-8"
            )
        text = decoded.encode()
        spotter = _Spotter(text)
        # Documents may declare a type, but no entities.
        parser = DefusedXMLParser(target=spotter, encoding="utf-8", forbid_dtd=False)
        # The target needs the parser for positions, and the parser the target.
        spotter.parser = parser.parser
        try:
            parser.feed(text)
            parser.close()
        except (DefusedXmlException, ParseError) as error:
            raise DescriptionError(f"{source}: the XML cannot be edited: {error}") from None
        # XML has one root, else the parser has refused it.
        return cls(text, encoding, spotter.roots[0])

    def edited(self, edits: Iterable[Edit]) -> bytes:
        """Return the file with the edits made, which must not overlap."""
        pieces = []
        at = 0
        # Insertions before replacements at the same place.
        for edit in sorted(edits, key=lambda edit: (edit.start, edit.stop)):
            if edit.start < at:
                raise ValueError(f"two edits overlap at byte {edit.start}")
            pieces += [self.text[at : edit.start], edit.text.encode()]
            at = edit.stop
        # In the encoding of the original, as its declaration says.
        return b"".join([*pieces, self.text[at:]]).decode().encode(self.encoding)

    def blanks_before(self, element: Span) -> str:
        """Return the white space in front of an element, back to what precedes it."""
        before = self.text[: element.start]
        return before[len(before.rstrip(b" \t\r\n")) :].decode()

    def appended(self, parent: Span, markup: str) -> Edit:
        """Return the edit that adds an element behind the last child, indented like it."""
        if not parent.children:
            # Without children there is no indentation to copy.
            return self.prepended(parent, markup)
        last = parent.children[-1]
        return Edit(last.stop, last.stop, self.blanks_before(last) + markup)

    def prepended(self, parent: Span, markup: str) -> Edit:
        """Return the edit that adds an element in front of the first child, indented like it.

        Opens an element that closes itself.
        """
        if parent.children:
            first = parent.children[0]
            return Edit(first.start, first.start, markup + self.blanks_before(first))
        # The line break in front of the parent, with its indentation.
        line = re.findall(r"\r?\n[^\n]*\Z|\Z", self.blanks_before(parent))[0]
        inside = line + "  " if line else ""
        # An element that closes itself is opened: its "/>" is replaced.
        if parent.close is not None:
            return Edit(parent.inner, parent.inner, inside + markup)
        return Edit(parent.named, parent.stop, f">{inside}{markup}{line}</{parent.raw_name}>")


def list_attribute_edits(element: Span, values: Mapping[str, str]) -> list[Edit]:
    """Return the edits that give attributes new values, quotes kept.

    Absent ones are added behind the last, a value already there is left.
    """
    edits = []
    added = ""
    for name, value in values.items():
        # Behind the last attribute, in the order given.
        if name not in element.values:
            added += f' {name}="{value}"'
        # Equal values keep their bytes.
        elif element.attributes.get(name) != value:
            edits.append(Edit(*element.values[name], value))
    return [*edits, Edit(element.named, element.named, added)] if added else edits


def comment_text(text: str) -> str:
    """Return a text as a comment of XML holds it: on one line, no two hyphens next to each other.

    >>> comment_text("of a ---> b --")
    ' of a - - -> b - - '
    """
    return f" {re.sub('-(?=-)', '- ', ' '.join(text.split()))} "


class _Spotter:
    """Record the position of each tag, as the target of an expat parser."""

    def __init__(self, text: bytes) -> None:
        self.text = text
        self.parser: Any = None
        self.open: list[Span] = []
        self.roots: list[Span] = []

    def start(self, tag: str, attributes: dict[str, str]) -> None:
        # Expat is at the "<" when it calls.
        start = self.parser.CurrentByteIndex
        name = _NAME.match(self.text, start)
        assert name is not None
        at = name.end()
        values = {}
        while attribute := _ATTRIBUTE.match(self.text, at):
            # Without the quotes, whichever they are.
            values[attribute[1].decode()] = (attribute.start(2) + 1, attribute.end(2) - 1)
            at = attribute.end()
        end = _TAG_END.match(self.text, at)
        assert end is not None
        # Until its end is met a span ends behind its start tag.
        span = Span(
            tag.rpartition("}")[2],
            attributes,
            name[1].decode(),
            start,
            at,
            end.end(),
            values,
            close=None if end[1] else end.end(),
            stop=end.end(),
        )
        # The open element is the parent.
        (self.open[-1].children if self.open else self.roots).append(span)
        self.open.append(span)

    def end(self, tag: str) -> None:
        span = self.open.pop()
        # At "</": the end tag may hold blanks before its ">".
        if span.close is not None:
            span.close = self.parser.CurrentByteIndex
            span.stop = self.text.index(b">", span.close) + 1


def _detect_encoding(content: bytes) -> str:
    # A byte order mark counts before the declaration.
    for mark, encoding in (
        (codecs.BOM_UTF16_LE, "utf-16-le"),
        (codecs.BOM_UTF16_BE, "utf-16-be"),
        (codecs.BOM_UTF8, "utf-8"),
    ):
        if content.startswith(mark):
            return encoding
    declared = _DECLARED.match(content)
    # XML without a declaration is UTF-8.
    return declared[1].decode().lower() if declared else "utf-8"
