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

from asbuilt.description.model import RobotModel
from asbuilt.errors import DescriptionError
from asbuilt.findings import Cure
from asbuilt.untrusted import parse_json, read_text

DRIVES = ("armature", "viscous", "coulomb", "offset")
"""Drive values that a sibling has."""


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
                key: value for key in DRIVES if (value := getattr(joint.drive, key)) is not None
            }
            for joint in model.joints
        }
        return cls(model.name, links, drives)

    def applied(self, model: RobotModel) -> RobotModel:
        """Return a robot with these numbers.

        Raises
        ------
        DescriptionError
            If its links or joints have other names.
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
        joints = tuple(
            replace(joint, drive=replace(joint.drive, **cast(Any, self.drives[joint.name])))
            for joint in model.joints
        )
        note = f"links and drives come from the sibling {self.robot} as built, not from CAD"
        parameters = np.concatenate([self.links[name] for name in model.link_names])
        return replace(model.with_parameters(parameters), joints=joints, notes=(*model.notes, note))

    def as_dict(self) -> dict[str, Any]:
        """Return the numbers, ready for JSON."""
        return {
            "robot": self.robot,
            "links": {name: list(values) for name, values in self.links.items()},
            "drives": {name: dict(values) for name, values in self.drives.items()},
        }


def read_sibling(path: str | Path) -> Sibling:
    """Read the numbers of a robot as built from JSON, such as the file of a page of docs/robots.

    Raises
    ------
    DescriptionError
        If the file does not hold them.
    """
    text = read_text(Path(path), "robot as built", DescriptionError)
    try:
        document = parse_json(text)
        found = document.get("sibling", document)
        links = {name: tuple(map(float, values)) for name, values in found["links"].items()}
        drives = {
            name: {key: float(values[key]) for key in DRIVES if key in values}
            for name, values in found["drives"].items()
        }
        if any(len(values) != 10 or not np.all(np.isfinite(values)) for values in links.values()):
            raise ValueError("a link has ten finite inertial parameters")
        return Sibling(str(found["robot"]), links, drives)
    except (KeyError, TypeError, ValueError, AttributeError) as problem:
        raise DescriptionError(
            f"{path} has no robot as built: {type(problem).__name__}: {problem}",
            cure=Cure("give the JSON file of a robot's page, with links and drives"),
        ) from problem
