"""Files that an MJCF file includes, put in their places as MuJoCo does."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from xml.etree.ElementTree import Element

from asbuilt.description.formats.xml import LARGEST_DESCRIPTION, parse_xml
from asbuilt.errors import DescriptionError
from asbuilt.untrusted import read_bytes

SUFFIXES = (".xml", ".mjcf")
"""Suffixes of files that an MJCF file may include."""


DEEPEST_INCLUDE = 16
"""Files that include one another; scenes include a robot, and robots a gripper."""


def insert_includes(root: Element, source: str) -> None:
    """Replace each `<include>` by what stands below the outermost element of its file.

    A file may be included once (MuJoCo XML reference, include). It lies in the folder of `source`
    or below: a description from elsewhere may not read other files of this computer.

    Raises
    ------
    DescriptionError
        For a file outside the folder, one that cannot be read, one that is included twice, or
        where `source` is a text without a folder.
    """
    first = next(root.iter("include"), None)
    if first is None:
        return
    place = Path(source)
    if not place.is_file():
        raise DescriptionError(
            f"{source}: the text includes {first.get('file')!r} and has no folder to find it in;"
            " give the path of the file, or save the whole model as one file"
            " (mujoco.mj_saveLastXML)"
        )
    folder = place.parent.resolve()
    _Inclusion(source, folder, {place.resolve()}).insert(root, folder)


@dataclass
class _Inclusion:
    """Files included so far by the description `source` in `folder`, and their bytes."""

    source: str
    folder: Path
    seen: set[Path]
    size: int = 0

    def insert(self, element: Element, beside: Path, depth: int = 0) -> None:
        """Expand the includes below an element of a file that lies in the folder `beside`."""
        children: list[Element] = []
        for child in element:
            if child.tag == "include":
                children += self.read(child, beside, depth + 1)
            else:
                self.insert(child, beside, depth)
                children.append(child)
        element[:] = children

    def read(self, include: Element, beside: Path, depth: int) -> list[Element]:
        """Return the elements that an include stands for."""
        path = self.find(include.get("file", ""), beside)
        if path in self.seen or depth > DEEPEST_INCLUDE:
            raise DescriptionError(
                f"{self.source}: {path.name} is included again; a file may be included once"
            )
        self.seen.add(path)
        content = read_bytes(path, "included file", DescriptionError, LARGEST_DESCRIPTION)
        self.size += len(content)
        if self.size > LARGEST_DESCRIPTION:
            raise DescriptionError(
                f"{self.source}: its included files have more than {LARGEST_DESCRIPTION} bytes"
            )
        root = parse_xml(content, str(path))
        self.insert(root, path.parent, depth)
        return [*root]

    def find(self, name: str, beside: Path) -> Path:
        """Return an included file, which lies in the folder of the description."""
        # MuJoCo starts from the folder of the first file; older files from that of their own.
        possible = [(place / name).resolve() for place in (self.folder, beside)]
        path = next((each for each in possible if each.is_file()), possible[0])
        if not path.is_relative_to(self.folder) or path.suffix.lower() not in SUFFIXES:
            raise DescriptionError(
                f"{self.source}: it includes {name!r}, which is no .xml or .mjcf file in the folder"
                " of the description; copy it there, or save the whole model as one file"
                " (mujoco.mj_saveLastXML)"
            )
        if not path.is_file():
            raise DescriptionError(f"{self.source}: it includes {name!r}, which does not exist")
        return path
