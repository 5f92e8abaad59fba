"""Published robots: files of the package robot_descriptions, by name."""

from __future__ import annotations

import difflib
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from pkgutil import iter_modules

from asbuilt.errors import DescriptionError, MissingExtraError
from asbuilt.findings import Cure

PATHS = ("URDF_PATH", "MJCF_PATH", "XACRO_PATH")


def published_description(name: str) -> Path:
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
    known = [each.name for each in iter_modules(package.submodule_search_locations)]
    if name not in known:
        near = difflib.get_close_matches(name, known, n=1)
        more = f"; did you mean {near[0]!r}?" if near else ""
        raise DescriptionError(f"robot_descriptions has no robot {name!r}{more}", value=name)
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
