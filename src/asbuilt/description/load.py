"""One way in for every robot description."""

from __future__ import annotations

import os
from collections.abc import Callable
from importlib import import_module
from pathlib import Path

from asbuilt.description.catalogue import bundled_robot, nearest, robot_names
from asbuilt.description.formats.xml import outermost_tag
from asbuilt.description.model import RobotModel
from asbuilt.errors import DescriptionError

SUFFIXES = (".toml", ".csv", ".urdf", ".xml", ".mjcf")


def load_robot(name_or_path: str | os.PathLike[str]) -> RobotModel:
    """Load a bundled robot by name, or a description by path.

    `.toml`, `.csv` (DH and mass table), `.urdf`, `.xml` (MJCF or URDF, by content).

    Raises `DescriptionError` where there is neither such a robot nor such a file, or the file makes
    no sense.

    Examples
    --------
    >>> load_robot("two-link").joint_names
    ('joint_1', 'joint_2')
    """
    text = os.fspath(name_or_path)
    if text in robot_names():
        return bundled_robot(text)
    path = Path(text)
    try:
        exists, is_folder = path.is_file(), path.is_dir() and bool(text)
    except OSError as error:
        shown = text if len(text) < 200 else f"{text[:60]}..."
        raise DescriptionError(f"{shown} cannot be read: {error.strerror}") from None
    if is_folder:
        raise DescriptionError(
            f"{text} is a folder; give a description file ({', '.join(SUFFIXES)}) or a bundled"
            f" robot ({', '.join(robot_names())})"
        )
    if not exists:
        if path.suffix.lower() in (*SUFFIXES, ".xacro"):
            raise DescriptionError(
                f"there is no file {text}; give the path of a description ({', '.join(SUFFIXES)})"
            )
        raise DescriptionError(
            f"there is no bundled robot and no file {text!r}{nearest(text)}; bundled are"
            f" {', '.join(robot_names())}; a file may be {', '.join(SUFFIXES)}"
        )
    return _read(path)


def _read(path: Path) -> RobotModel:
    suffix = path.suffix.lower()
    if suffix == ".toml":
        return _reader("toml", "read_robot_toml")(path)
    if suffix == ".csv":
        return _reader("dh_table", "read_dh_table")(path)
    try:
        content = path.read_bytes()
    except OSError as error:
        raise DescriptionError(f"{path} cannot be read: {error.strerror}") from None
    tag = outermost_tag(content)
    if tag == "mujoco":
        return _reader("mjcf", "read_mjcf")(path)
    if tag:
        return _reader("urdf", "read_urdf")(path)
    raise DescriptionError(
        f"{path} is not a robot description that asbuilt knows; it reads TOML, a DH table (CSV),"
        " URDF and MJCF (XML)"
    )


def _reader(module: str, name: str) -> Callable[[Path], RobotModel]:
    reader: Callable[[Path], RobotModel] = getattr(
        import_module(f"asbuilt.description.formats.{module}"), name
    )
    return reader
