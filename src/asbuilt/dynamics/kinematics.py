"""Where the links are and how joint rates move them."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from asbuilt.arrays import Array
from asbuilt.description.model import ROOT, RobotModel
from asbuilt.dynamics.batches import shape_joint_samples


def _evaluate_link_poses(model: RobotModel, q: Array) -> Array:
    """Return the pose of each link in its parent link, shape (n_samples, n_joints, 4, 4)."""
    samples, n = q.shape
    motion = np.zeros((samples, n, 4, 4))
    motion[...] = np.eye(4)
    turning = np.array([joint.is_revolute for joint in model.joints])
    c = np.cos(q[:, turning])
    s = np.sin(q[:, turning])
    motion[:, turning, 0, 0] = c
    motion[:, turning, 0, 1] = -s
    motion[:, turning, 1, 0] = s
    motion[:, turning, 1, 1] = c
    motion[:, ~turning, 2, 3] = q[:, ~turning]
    poses: Array = (
        np.array([joint.before for joint in model.joints])
        @ motion
        @ np.array([joint.after for joint in model.joints])
    )
    return poses


def draw_postures(model: RobotModel, rng: np.random.Generator, count: int) -> Array:
    """Return random positions (count, n_joints), of a whole turn for joints of a tree.

    Where not every position has a posture, they are within the limits of the motors, as of
    `draw_postures_within`.
    """
    if find_first_posture(model) is None:
        return rng.uniform(-np.pi, np.pi, (count, model.n_joints))
    lower, upper = (
        np.array([getattr(joint.limits, end) for joint in model.joints])
        for end in ("lower", "upper")
    )
    return draw_postures_within(model, lower, upper, rng, count)


def draw_postures_within(
    model: RobotModel, lower: Array, upper: Array, rng: np.random.Generator, count: int
) -> Array:
    """Return random positions (count, n_joints) that are uniform within bounds, each (n_joints,).

    They are postures that exist, away from singular ones. Raises `DescriptionError` where there
    are none.
    """
    return model.joint_map.draw(lower, upper, rng, count)


def find_first_posture(model: RobotModel) -> Array | None:
    """Return the motors' positions (n_joints,) of the described posture; None where all exist."""
    return model.joint_map.first_posture


def link_poses(model: RobotModel, q: ArrayLike) -> Array:
    """Return the pose of every link in the root frame, shape (n_links, 4, 4).

    For many samples the shape is (n_samples, n_links, 4, 4). The identity is `T_i = T_parent
    before_i motion(q_i) after_i`.
    """
    (qs,) = shape_joint_samples(model, q=q)
    poses = _evaluate_link_poses(model.tree, model.joint_map.motion(qs).q)
    for i, parent in enumerate(model.tree.parents):
        if parent != ROOT:
            poses[:, i] = poses[:, parent] @ poses[:, i]
    return model.joint_map.by_link(poses).reshape(*np.shape(q)[:-1], -1, 4, 4)


def link_jacobians(model: RobotModel, q: ArrayLike) -> Array:
    """Return the Jacobian of every link in link axes, shape (n_links, 6, n_joints).

    For many samples n_samples comes first.

    Rows: angular velocity, then velocity of the link origin, so that `J_i qd` is the twist of link
    i.
    """
    (qs,) = shape_joint_samples(model, q=q)
    moved = model.joint_map.motion(qs)
    motions = _evaluate_link_poses(model.tree, moved.q)
    samples, n = moved.q.shape
    jacobians = np.zeros((samples, n, 6, n))
    for i, (joint, parent) in enumerate(zip(model.tree.joints, model.tree.parents, strict=True)):
        rotation = motions[:, i, :3, :3]
        translation = motions[:, i, :3, 3]
        if parent != ROOT:
            above = np.swapaxes(jacobians[:, parent], 1, 2)
            linear = above[..., 3:] + np.cross(above[..., :3], translation[:, None, :])
            jacobians[:, i, :3] = np.swapaxes(above[..., :3] @ rotation, 1, 2)
            jacobians[:, i, 3:] = np.swapaxes(linear @ rotation, 1, 2)
        axis = joint.after[2, :3]
        if joint.is_revolute:
            jacobians[:, i, :3, i] = axis
            jacobians[:, i, 3:, i] = joint.after[:3, :3].T @ np.cross(
                [0.0, 0.0, 1.0], joint.after[:3, 3]
            )
        else:
            jacobians[:, i, 3:, i] = axis
    by_link = model.joint_map.by_link(moved.columns(jacobians))
    return by_link.reshape(*np.shape(q)[:-1], -1, 6, model.n_joints)
