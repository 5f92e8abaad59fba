"""A robot of the same type as built: the numbers of its links and drives, without its geometry.

A sibling is closer to a robot than its CAD. Its numbers take the place of the description's,
so that whatever is regularised toward CAD is regularised toward the sibling.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

import numpy as np

from asbuilt.codec import make_plain
from asbuilt.description.inertia import PARAMETER_NAMES, LinkInertia
from asbuilt.description.model import PLAIN_TERMS, RobotModel
from asbuilt.errors import DescriptionError
from asbuilt.findings import Cure, join_names
from asbuilt.ranges import Range
from asbuilt.untrusted import parse_json, read_text


@dataclass(frozen=True, slots=True)
class Sibling:
    """Hold the numbers of a robot as built.

    Parameters
    ----------
    robot
        Its name.
    links
        Inertial parameters `Ixx Ixy Ixz Iyy Iyz Izz mx my mz m` about the link origin by link.
    drives
        Armature, viscous and Coulomb friction and offset by joint, as far as they are known.
    """

    robot: str
    links: Mapping[str, tuple[float, ...]]
    drives: Mapping[str, Mapping[str, float]]

    @classmethod
    def of(cls, model: RobotModel) -> Sibling:
        """Return the numbers of a robot.

        Examples
        --------
        >>> from asbuilt import load_robot
        >>> model = load_robot("two-link")
        >>> Sibling.of(model).applied(model).parameters.tolist() == model.parameters.tolist()
        True
        """
        links = {link.name: tuple(link.inertia.parameters.tolist()) for link in model.links}
        drives = {
            joint.name: {
                key: value
                for key in PLAIN_TERMS
                if (value := getattr(joint.drive, key)) is not None
            }
            for joint in model.joints
        }
        return cls(model.name, links, drives)

    def applied(self, model: RobotModel) -> RobotModel:
        """Return a robot with these numbers.

        Raises
        ------
        DescriptionError
            If its links or joints have other names, or zeros for a link that has a mass.
        """
        for kind, own, theirs in (
            ("links", model.link_names, self.links),
            ("joints", model.joint_names, self.drives),
        ):
            if set(own) != set(theirs):
                raise DescriptionError(
                    f"the sibling {self.robot} has {kind} {', '.join(theirs)}; {model.name} has"
                    f" {', '.join(own)}",
                    cure=Cure("give the numbers of a robot of the same type and description"),
                )
        empty = [
            link.name for link in model.links if link.has_mass and not any(self.links[link.name])
        ]
        if empty:
            raise DescriptionError(
                f"the sibling {self.robot} has zeros for {join_names(empty)}, which"
                f" {'have' if len(empty) > 1 else 'has'} a mass in {model.name}",
                cure=Cure("give the numbers of a robot that was identified"),
            )
        joints = tuple(
            replace(joint, drive=replace(joint.drive, **cast(Any, self.drives[joint.name])))
            for joint in model.joints
        )
        note = f"links and drives come from the sibling {self.robot} as built, not from CAD"
        parameters = np.concatenate([self.links[name] for name in model.link_names])
        return replace(model.with_parameters(parameters), joints=joints, notes=(*model.notes, note))

    def as_dict(self) -> dict[str, Any]:
        """Return the numbers, ready for JSON."""
        return make_plain(self)  # type: ignore[no-any-return]


def read_sibling(path: str | Path) -> Sibling:
    """Read the numbers of a robot as built from JSON, such as the file of a page of docs/robots.

    Raises
    ------
    DescriptionError
        If the file does not hold them, or a number is none of a body or a passive drive.
    """
    text = read_text(Path(path), "robot as built", DescriptionError)
    cure = Cure("give the JSON file of a robot's page, with links and drives")
    try:
        document = parse_json(text)
        found = document.get("sibling", document)
        robot = str(found["robot"])
        links = found["links"]
        drives = found["drives"]
        return Sibling(
            robot,
            {name: _read_link(name, values) for name, values in links.items()},
            {name: _read_drive(name, values) for name, values in drives.items()},
        )
    except (KeyError, TypeError, ValueError, AttributeError) as problem:
        why = f"it lacks {problem}" if isinstance(problem, KeyError) else str(problem)
        raise DescriptionError(f"{path} has no robot as built: {why}", cure=cure) from problem


MASS = Range(0.0, 1e5, "kg")
"""Masses of links, from none to a hundred times those of the heaviest arm."""
MOMENT = Range(-1e7, 1e7)
"""First moments and moments of inertia of such links within 10 m, in SI units."""
LOSS = Range(0.0, 1e6)
"""Armature and friction, which no passive drive has below zero, in SI units."""
OFFSET = Range(-1e6, 1e6)
"""Torque at rest [N m], of either sign."""


def _read_link(name: str, values: Any) -> tuple[float, ...]:
    """Return the ten inertial parameters of a link that can exist, or whose numbers are all zero.

    Raises `DescriptionError` with link, parameter and value.
    """
    if not isinstance(values, list) or len(values) != len(PARAMETER_NAMES):
        raise DescriptionError(
            f"link {name!r} has no list of ten inertial parameters ({' '.join(PARAMETER_NAMES)})"
        )
    for symbol, value in zip(PARAMETER_NAMES, values, strict=True):
        _require_number(f"{symbol} of link {name!r}", value, MASS if symbol == "m" else MOMENT)
    reason = LinkInertia(np.array(values, dtype=np.float64)).inconsistency()
    if reason is not None:
        raise DescriptionError(f"no body has the numbers of link {name!r}: {reason}")
    return tuple(map(float, values))


def _read_drive(name: str, values: Any) -> dict[str, float]:
    """Return the known values of a drive; raises `DescriptionError` with joint, name and value."""
    if not isinstance(values, dict):
        raise DescriptionError(f"drive {name!r} is no table of {', '.join(PLAIN_TERMS)}")
    found = {key: values[key] for key in PLAIN_TERMS if key in values}
    for key, value in found.items():
        _require_number(f"{key} of drive {name!r}", value, OFFSET if key == "offset" else LOSS)
    return {key: float(value) for key, value in found.items()}


def _require_number(what: str, value: Any, allowed: Range) -> None:
    if not allowed.holds(value):
        raise DescriptionError(f"{what} is {str(value)[:60]}; it must be a number {allowed}")
