"""Ground: what the feet of a robot stand on in windows of a log, measured and simulated.

Each foot stands on a floor of its own, level and as high as the foot stood in the log about that
time, so that steps, slopes and errors of the leg's lengths lift or drop no foot. The simulation
decides when a foot touches, how it rolls, and when it leaves: contacts that followed the flags of
the log would take from the measurement what a rollout predicts, and could pull.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from asbuilt.arrays import Array, Indices, find_finite_rows
from asbuilt.description import quaternion_from_rotation
from asbuilt.description.model import RobotModel
from asbuilt.description.rotation import find_axes_across, rotation_onto
from asbuilt.description.structure.free_base import AXES
from asbuilt.dynamics.kinematics import link_poses
from asbuilt.errors import UsageError
from asbuilt.experiment.recording import Recording
from asbuilt.experiment.virtual.physics import FRICTION_TIME
from asbuilt.findings import Cure

GROUND_FRICTION = 1.0
"""Coefficient of friction of a floor: own choice."""
GROUND_POINT = 1e-3
"""Radius of the ball that stands for a foot which is a point [m]."""
GROUND_SOLE = 0.1
"""Distance to all sides at which balls stand for a sole [m], whose size no log states."""


@dataclass(frozen=True, slots=True, eq=False)
class Ground:
    """Hold what W windows have under K contacts.

    `heights` (W, K) [m] are how high the frames of contacts are that stand, along the vertical;
    `normals` (K, 3) the vertical in axes of the links that stand.
    """

    heights: Array
    normals: Array

    def some(self, part: slice | Indices) -> Ground:
        """Return what some of the windows have."""
        return replace(self, heights=self.heights[part])

    def places(self, model: RobotModel) -> Array:
        """Return where the floors are, shape (W, K, 3)."""
        below = self.heights - [_choose_radius(contact.radius) for contact in model.contacts]
        return np.asarray(below[..., None] * find_vertical(model))

    def add_to(self, mujoco: Any, spec: Any, model: RobotModel, step: float) -> None:
        """Add balls at the contacts and a floor that can be moved under each to an `MjSpec`.

        The simulation takes steps of `step` [s].
        """
        # As stiff as what stops a joint by dry friction: the heights of feet that stand hold how
        # far the real floor gives way.
        stiff = [max(FRICTION_TIME, 2.0 * step), 1.0]
        level = quaternion_from_rotation(rotation_onto(find_vertical(model)))
        for contact, normal in zip(model.contacts, self.normals, strict=True):
            link, placement = model.placed(contact.frame)
            name = f"ground of {contact.frame}"
            size = _choose_radius(contact.radius)
            floor = spec.worldbody.add_body(name=name, mocap=True)
            shape = {"contype": 0, "conaffinity": 0, "mass": 0.0}
            floor.add_geom(
                name=name, type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 1], quat=level, **shape
            )
            across = GROUND_SOLE * find_axes_across(normal)
            corners = [*across, *-across] if contact.flat else [np.zeros(3)]
            for number, corner in enumerate(corners):
                ball = f"{contact.frame} {number}"
                spec.body(model.link_names[link]).add_geom(
                    name=ball,
                    type=mujoco.mjtGeom.mjGEOM_SPHERE,
                    pos=placement[:3, 3] + corner,
                    size=[size, 0, 0],
                    **shape,
                )
                spec.add_pair(
                    name=ball,
                    geomname1=name,
                    geomname2=ball,
                    condim=3,
                    solref=stiff,
                    friction=[GROUND_FRICTION, GROUND_FRICTION, 0.0, 0.0, 0.0],
                )


def find_vertical(model: RobotModel) -> Array:
    """Return the upward unit vector (3,) in axes of the world."""
    return np.asarray(-model.gravity / max(float(np.linalg.norm(model.gravity)), 1e-9))


def measure_ground(
    model: RobotModel, recording: Recording, starts: Array, horizon: float
) -> Ground | None:
    """Return the ground in windows (W,) of a length [s]; None where nothing touches it.

    A foot that never stands has none within reach. Raises `UsageError` where the base moves in a
    plane, which carries the robot in place of its feet.
    """
    if not model.contacts or recording.contact is None:
        return None
    if model.n_floating != len(AXES):
        raise UsageError(
            f"the base of {model.name} moves in a plane, where no weight presses its contacts on"
            " the ground, so that a rollout cannot simulate them",
            cure=Cure("let the base float, or leave the rollout out"),
        )
    usable = find_finite_rows(recording.t, recording.q)
    t = recording.t[usable]
    up = find_vertical(model)
    poses = link_poses(model, recording.q[usable])
    closed = recording.contact[usable] > 0.5
    heights = np.empty((len(starts), len(model.contacts)))
    normals = []
    for k, contact in enumerate(model.contacts):
        link, placement = model.placed(contact.frame)
        stands = closed[:, k]
        z = (poses[:, link] @ placement)[:, :3, 3] @ up
        turned = np.einsum("sji,j->si", poses[stands, link, :3, :3], up).sum(axis=0)
        normals.append(turned / np.linalg.norm(turned) if stands.any() else up)
        for w, start in enumerate(starts):
            away = np.abs(t[stands] - start - 0.5 * horizon)
            near = away <= max(horizon, float(np.min(away, initial=np.inf)) + 0.5 * horizon)
            heights[w, k] = np.median(z[stands][near]) if stands.any() else np.min(z) - 1e3
    return Ground(heights, np.array(normals))


def _choose_radius(radius: float | None) -> float:
    return max(radius or 0.0, GROUND_POINT)
