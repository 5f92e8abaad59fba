"""Where the links are and how joint rates move them."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from asbuilt.arrays import Array
from asbuilt.description.model import ROOT, RobotModel
from asbuilt.dynamics.batches import joint_samples


def _motions(model: RobotModel, q: Array) -> Array:
    """Return the pose of each link in its parent link, shape (n_samples, n_joints, 4, 4)."""
    samples, n = q.shape
    motion = np.zeros((samples, n, 4, 4))
    motion[...] = np.eye(4)
    turning = np.array([joint.is_revolute for joint in model.joints])
    c, s = np.cos(q[:, turning]), np.sin(q[:, turning])
    (
        motion[:, turning, 0, 0],
        motion[:, turning, 0, 1],
        motion[:, turning, 1, 0],
        motion[:, turning, 1, 1],
    ) = (
        c,
        -s,
        s,
        c,
    )
    motion[:, ~turning, 2, 3] = q[:, ~turning]
    poses: Array = (
        np.array([joint.before for joint in model.joints])
        @ motion
        @ np.array([joint.after for joint in model.joints])
    )
    return poses


def link_poses(model: RobotModel, q: ArrayLike) -> Array:
    """Return the pose of every link in the root frame, shape (n_links, 4, 4).

    For many samples the shape is (n_samples, n_links, 4, 4). The identity is `T_i = T_parent
    before_i motion(q_i) after_i`.
    """
    (qs,) = joint_samples(model, q=q)
    if (coupling := model.coupling) is not None:
        of_tree = link_poses(model.tree, coupling.positions(qs))
        return of_tree[:, np.argsort(coupling.order)].reshape(*np.shape(q)[:-1], -1, 4, 4)
    poses = _motions(model, qs)
    for i, parent in enumerate(model.parents):
        if parent != ROOT:
            poses[:, i] = poses[:, parent] @ poses[:, i]
    return poses.reshape(*np.shape(q), 4, 4)


def link_jacobians(model: RobotModel, q: ArrayLike) -> Array:
    """Return the Jacobian of every link in link axes, shape (n_links, 6, n_joints).

    For many samples n_samples comes first.

    Rows: angular velocity, then velocity of the link origin, so that `J_i qd` is the twist of link
    i.
    """
    (qs,) = joint_samples(model, q=q)
    if (coupling := model.coupling) is not None:
        of_tree = link_jacobians(model.tree, coupling.positions(qs)) @ coupling.matrix
        return of_tree[:, np.argsort(coupling.order)].reshape(
            *np.shape(q)[:-1], -1, 6, model.n_joints
        )
    samples, n = qs.shape
    motions = _motions(model, qs)
    jacobians = np.zeros((samples, n, 6, n))
    for i, (joint, parent) in enumerate(zip(model.joints, model.parents, strict=True)):
        rotation, translation = motions[:, i, :3, :3], motions[:, i, :3, 3]
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
    return jacobians.reshape(*np.shape(q), 6, n)
