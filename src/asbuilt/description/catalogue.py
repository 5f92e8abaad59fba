"""The robots that come with asbuilt."""

from __future__ import annotations

import difflib
from functools import lru_cache
from importlib.resources import files

from asbuilt.description.model import RobotModel
from asbuilt.errors import DescriptionError

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
    matches = difflib.get_close_matches(
        name.lower().replace("_", "-"), robot_names(), n=1, cutoff=0.4
    )
    return f" (did you mean {matches[0]!r}?)" if matches else ""
