"""One way in for every robot description, and the robots that come with asbuilt."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from functools import lru_cache
from importlib import import_module
from importlib.resources import files
from importlib.util import find_spec
from pathlib import Path
from pkgutil import iter_modules

from asbuilt.description.formats.description_format import (
    DESCRIPTION_FORMATS,
    format_of,
    list_suffixes,
)
from asbuilt.description.formats.xml import LARGEST_DESCRIPTION, close_match, find_outermost_tag
from asbuilt.description.model import Contact, RobotModel
from asbuilt.description.structure.parts import BaseKind
from asbuilt.errors import DescriptionError, MissingExtraError, UsageError
from asbuilt.findings import Cure
from asbuilt.ranges import option, switch
from asbuilt.untrusted import (
    allow_xacro_python,
    describe_problem,
    name_file_in_errors,
    read_bytes,
    shorten_path,
)

PATHS = ("URDF_PATH", "MJCF_PATH", "XACRO_PATH")


def find_published_description(name: str) -> Path:
    """Return the file of a robot that the package robot_descriptions knows, downloaded if needed.

    Parameters
    ----------
    name
        Module of robot_descriptions, such as `panda_description` or `ur10e_mj_description`.

    Raises
    ------
    MissingExtraError
        If robot_descriptions is not installed.
    DescriptionError
        If it has no such robot, or cannot be downloaded.
    """
    package = find_spec("robot_descriptions")
    if package is None:
        raise MissingExtraError("robot_descriptions", "robots", f"the published robot {name}")
    known = [module.name for module in iter_modules(package.submodule_search_locations)]
    if name not in known:
        raise DescriptionError(
            f"robot_descriptions has no robot {name!r}{close_match(name, known)}", value=name
        )
    try:
        module = import_module(f"robot_descriptions.{name}")
    except Exception as error:  # whatever Git and the network raise
        raise DescriptionError(
            f"{name} cannot be downloaded by robot_descriptions ({type(error).__name__}: {error})",
            cure=Cure("check the connection, or give the path of a description"),
            value=name,
        ) from error
    found = next((getattr(module, each) for each in PATHS if hasattr(module, each)), None)
    if found is None:
        raise DescriptionError(f"{name} of robot_descriptions has no URDF or MJCF", value=name)
    return Path(found)


HELD_BASE = "hold a free joint of the robot at its pose (a robot hung in the air)"
CONTACTS = "links or frames that touch the ground; NAME:flat a sole, NAME:METRES a ball"


@dataclass(frozen=True, slots=True, kw_only=True)
class BaseOptions:
    """How the base of a robot stands, as `load_robot` takes it.

    `fixed_base` holds a free joint of the description, `free_base` has it stand on no fixed root,
    `contacts` are where it may touch the ground.
    """

    fixed_base: bool = switch(False, HELD_BASE)
    free_base: bool = switch(False, "the robot stands on no fixed root: legs, drones, satellites")
    contacts: str | None = option(None, "FRAME,...", CONTACTS)

    def load_robot(self, name_or_path: RobotModel | str | os.PathLike[str]) -> RobotModel:
        """Return the robot that a name or a path describes, on this base."""
        return load_robot(
            name_or_path,
            fixed_base=self.fixed_base,
            base="free" if self.free_base else "fixed",
            contacts=self.contacts or "",
        )


def load_robot(
    name_or_path: RobotModel | str | os.PathLike[str],
    *,
    fixed_base: bool = False,
    base: BaseKind = "fixed",
    contacts: str = "",
    trust_xacro: bool = False,
) -> RobotModel:
    """Load a bundled robot by name, or a description by path.

    Parameters
    ----------
    name_or_path
        Name of a bundled robot, or of one of the package `robot_descriptions` such as
        `panda_description`, or a file: TOML, URDF, MJCF, SDF, xacro, a DH and mass table (CSV), or
        a format that another distribution registers. XML is recognised by content. A robot that
        is loaded already keeps its base.
    fixed_base
        Whether a free joint is held at its pose, as of a robot hung in the air.
    base
        "free" or "planar" if the first body stands on joints without a drive.
    contacts
        Links or frames of such a robot that may touch the ground, as in `FL_FOOT,FR_FOOT`, `:flat`
        after a sole and `:RADIUS` [m] after a ball, which touches below its centre.
    trust_xacro
        Whether a xacro file may run any Python that its expressions hold; else they are evaluated
        on a list of arithmetic, properties and `math`, and include only files next to it.

    Returns
    -------
    RobotModel
        The robot.

    Raises
    ------
    DescriptionError
        If there is neither such a robot nor such a file, or the file makes no sense.
    UsageError
        If the base is asked to stand otherwise than the description or the robot can.

    Examples
    --------
    >>> load_robot("two-link").joint_names
    ('joint_1', 'joint_2')
    """
    if fixed_base and base != "fixed":
        raise UsageError(f"fixed_base holds the base, and base={base!r} lets it move; give one")
    if isinstance(name_or_path, RobotModel):
        found = name_or_path
        _check_loaded_base(found, base)
    else:
        with allow_xacro_python(trust_xacro):
            found = _load(os.fspath(name_or_path), fixed_base, base)
    if fixed_base and found.n_floating:
        raise UsageError(
            f"the base of {found.name} floats, and fixed_base holds it only while a URDF or MJCF"
            " file is read",
            cure=Cure("give the path of such a file", settings={"fixed_base": True}),
        )
    if not contacts:
        return found
    if not found.n_floating:
        raise UsageError(
            f"{found.name} stands on a fixed root, where contacts {contacts} have no effect",
            cure=Cure("let its base float", settings={"free_base": True}),
        )
    return replace(found, contacts=Contact.parse(contacts))


def _check_loaded_base(model: RobotModel, base: BaseKind) -> None:
    """Raise where the base of a robot that is loaded already should float, and does not."""
    if base != "fixed" and not model.n_floating:
        raise UsageError(
            f"{model.name} is loaded already, on a fixed root, so that base={base!r} has no effect",
            cure=Cure("give the path of its description, which is then read on such a base"),
        )


def _load(text: str, fixed_base: bool, base: BaseKind) -> RobotModel:
    if text in robot_names():
        return _check_base(bundled_robot(text), base)
    path = Path(text)
    try:
        exists = bool(text) and path.exists()
        is_folder = exists and path.is_dir()
    except (OSError, ValueError) as error:
        raise DescriptionError(
            f"{shorten_path(text)} cannot be read: {describe_problem(error)}"
        ) from None
    if exists and not is_folder:
        return _read(path, fixed_base, base)
    suffixes = ", ".join(list_suffixes())
    bundled = ", ".join(robot_names())
    if is_folder:
        raise DescriptionError(
            f"{text} is a folder; give a description file ({suffixes}) or a bundled robot"
            f" ({bundled})"
        )
    if text.isidentifier() and text.endswith("_description"):
        return _read(find_published_description(text), fixed_base, base)
    if path.suffix.lower() in list_suffixes():
        raise DescriptionError(
            f"there is no file {text}; give the path of a description ({suffixes})", file=text
        )
    raise DescriptionError(
        f"there is no bundled robot and no file {text!r}{suggest_robot(text)}; bundled are"
        f" {bundled}; a"
        f" file may be {suffixes}"
    )


def _read(path: Path, fixed_base: bool, base: BaseKind) -> RobotModel:
    content = read_bytes(path, "description", DescriptionError, LARGEST_DESCRIPTION)
    found = format_of(path, content)
    if found is None and find_outermost_tag(content):
        found = DESCRIPTION_FORMATS["urdf"]
    if found is None:
        titles = ", ".join(each.title for each in DESCRIPTION_FORMATS.values())
        raise DescriptionError(
            f"{path} is not a robot description in a known format; formats are {titles}",
            file=str(path),
        )
    with name_file_in_errors(path):
        if found.on_bases:
            return found.read(path, fixed_base=fixed_base, base=base)
        return _check_base(found.read(path), base)


def _check_base(model: RobotModel, base: BaseKind) -> RobotModel:
    """Return a robot as read; raise where its base should float and its description fixes it."""
    if base == "fixed":
        return model
    raise DescriptionError(
        f"{model.name}: this description has a fixed root link {model.root_link!r}, whose mass it"
        " does not give, so that it cannot float",
        cure=Cure("give a URDF, or an MJCF with a <freejoint/>"),
    )


_FOLDER = files("asbuilt.description") / "robots"


def robot_names() -> tuple[str, ...]:
    """Return the names of the bundled robots, sorted."""
    return tuple(
        sorted(
            entry.name.removesuffix(".toml")
            for entry in _FOLDER.iterdir()
            if entry.name.endswith(".toml")
        )
    )


@lru_cache(maxsize=16)
def bundled_robot(name: str) -> RobotModel:
    """Return a bundled robot, read once: what is remembered for a robot is then found again.

    Raises `DescriptionError` with the names there are and the nearest one.

    >>> bundled_robot("kuka-iiwa7-r800").n_joints
    7
    """
    from asbuilt.description.formats.toml import robot_from_toml  # noqa: PLC0415 - light start

    if name not in robot_names():
        raise DescriptionError(
            f"there is no bundled robot {name!r}{suggest_robot(name)}; bundled are"
            f" {', '.join(robot_names())}"
        )
    return robot_from_toml(
        (_FOLDER / f"{name}.toml").read_text(encoding="utf-8"),
        source=f"bundled robot {name}",
        close=False,
    )


def suggest_robot(name: str) -> str:
    """Return `" (did you mean 'puma-560'?)"` for the nearest bundled robot, or an empty text."""
    return close_match(name.lower().replace("_", "-"), robot_names(), cutoff=0.4)
