"""Robots with joints that follow others, by construction of each body and joint."""

from __future__ import annotations

import numpy as np

from asbuilt.description import (
    DriveValues,
    Joint,
    JointLimits,
    Link,
    LinkInertia,
    Mimic,
    RobotModel,
    placement,
    rotation_from_rpy,
)

BOUNDS = {
    "a1": JointLimits(-2.5, 2.5, 2.0, 5.0),
    "a2": JointLimits(-1.2, 1.2, 2.0, 5.0),
    "a3": JointLimits(-1.2, 1.0, 2.0, 5.0),
    "a6": JointLimits(-3.0, 3.0, 3.0, 8.0),
    "f1": JointLimits(-0.2, 0.3, 0.5, 2.0),
}


def palletizer() -> RobotModel:
    """Return an arm whose hand is kept level by a follower, with two fingers, one a follower.

    A driven joint hangs on a follower; one finger follows another that follows the first.
    """
    rng = np.random.default_rng(0)
    joints = [
        _joint("a1", -1, (0.0, 0.0, 0.0), (0.0, 0.0, 0.3)),
        _joint("a2", 0, (np.pi / 2, 0.0, 0.0), (0.1, 0.0, 0.1)),
        _joint("a3", 1, (0.0, 0.0, 0.0), (0.5, 0.0, 0.0)),
        _joint("level", 2, (0.0, 0.0, 0.0), (0.5, 0.0, 0.0), Mimic({"a3": -1.0}, 0.1)),
        _joint("a6", 3, (-np.pi / 2, 0.0, 0.0), (0.1, 0.0, 0.0)),
        _joint("f1", 4, (0.3, 0.2, 0.1), (0.0, 0.02, 0.1), kind="prismatic"),
        _joint("f2", 4, (0.1, 0.2, 0.1), (0.0, -0.02, 0.1), Mimic({"f1": -1.0}, 0.01), "prismatic"),
        _joint("f3", 4, (0.1, -0.2, 0.3), (0.0, 0.0, 0.1), Mimic({"f2": 2.0}, 0.02)),
    ]
    bodies = [
        LinkInertia.from_com(
            rng.uniform(0.3, 1.0), 0.05 * rng.normal(size=3), np.diag(rng.uniform(1, 2, 3)) * 1e-2
        )
        for _ in joints
    ]
    links = tuple(Link(f"l_{j.name}", body) for j, body in zip(joints, bodies, strict=True))
    return RobotModel("palletizer", tuple(joints), links)


def _joint(
    name: str,
    parent: int,
    rpy: tuple[float, ...],
    xyz: tuple[float, ...],
    mimic: Mimic | None = None,
    kind: str = "revolute",
) -> Joint:
    return Joint(
        name,
        kind,  # type: ignore[arg-type]
        parent,
        placement(rotation_from_rpy(list(rpy)), xyz),
        np.eye(4),
        BOUNDS.get(name, JointLimits()),
        DriveValues(armature=0.1, viscous=1.0, coulomb=1.0) if mimic is None else DriveValues(),
        mimic=mimic,
    )
