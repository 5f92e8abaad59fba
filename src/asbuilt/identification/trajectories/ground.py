"""Ground under the feet of a simulated robot.

Each foot stands on a floor of its own, level and as high as the foot stood in the log about that
time, so that steps, slopes and errors of the leg's lengths lift or drop no foot. The simulation
decides when a foot touches, how it rolls, and when it leaves: contacts that followed the flags of
the log would take from the measurement what a rollout predicts, and could pull.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description import RobotModel, quaternion_from_rotation
from asbuilt.description.structure.free_base import AXES
from asbuilt.dynamics.kinematics import link_poses
from asbuilt.errors import UsageError
from asbuilt.experiment.recording import Recording
from asbuilt.experiment.virtual.physics import STIFFNESS
from asbuilt.findings import Cure

# Say how a floor and the feet on it are simulated: own choices.
#
# A floor is as stiff as what stops a joint by dry friction, since the heights of feet that stand
# hold how far the real one gives way, and its coefficient of friction is `GROUND_FRICTION`. A foot
# that is a point is a ball of the radius `GROUND_POINT` [m]. A sole, whose size no log states and
# whose moments no limit, stands on balls at `GROUND_SOLE` [m] to all sides.

GROUND_FRICTION = 1.0
GROUND_POINT = 1e-3
GROUND_SOLE = 0.1


@dataclass(frozen=True, slots=True, eq=False)
class Ground:
    """Hold what W windows have under K contacts.

    `heights` (W, K) [m] are how high the frames of contacts are that stand, along the vertical;
    `normals` (K, 3) the vertical in axes of the links that stand.
    """

    heights: Array
    normals: Array

    def places(self, model: RobotModel) -> Array:
        """Return where the floors are, shape (W, K, 3)."""
        below = self.heights - [_choose_radius(contact.radius) for contact in model.contacts]
        return np.asarray(below[..., None] * find_vertical(model))


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
    usable = np.all(np.isfinite(recording.q), axis=1) & np.isfinite(recording.t)
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


def add_ground(mujoco: Any, spec: Any, model: RobotModel, ground: Ground, step: float) -> None:
    """Add balls at the contacts, and a floor that can be moved under each, to a MuJoCo `MjSpec`.

    The simulation takes steps of `step` [s].
    """
    stiff = [max(STIFFNESS.friction_time, 2.0 * step), 1.0]
    level = quaternion_from_rotation(_complete_axes(find_vertical(model)))
    for contact, normal in zip(model.contacts, ground.normals, strict=True):
        link, placement = model.placed(contact.frame)
        name = f"ground of {contact.frame}"
        size = _choose_radius(contact.radius)
        floor = spec.worldbody.add_body(name=name, mocap=True)
        shape = {"contype": 0, "conaffinity": 0, "mass": 0.0}
        floor.add_geom(
            name=name, type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 1], quat=level, **shape
        )
        across = GROUND_SOLE * _complete_axes(normal)[:, :2].T
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


def _choose_radius(radius: float | None) -> float:
    return max(radius or 0.0, GROUND_POINT)


def _complete_axes(z: Array) -> Array:
    """Return a rotation (3, 3) whose last column is a unit vector."""
    x = np.cross(np.eye(3)[int(np.argmin(np.abs(z)))], z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], axis=1)
