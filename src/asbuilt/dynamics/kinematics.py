"""Where the links are and how joint rates move them."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from asbuilt.arrays import Array
from asbuilt.description.model import ROOT, RobotModel
from asbuilt.dynamics.batches import shape_joint_samples
from asbuilt.errors import DescriptionError

TRIALS = 20
"""Batches of random postures after which a mechanism counts as one without room to move."""
REGULAR = 0.02
"""Distance to a singular posture from which on rates of passive joints are of usual size."""


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

    Where loops place joints, they are within the limits of the motors, away from singular postures,
    and in the assembly mode of the description. Raises `DescriptionError` where there are none.
    """
    n = model.n_joints
    closure = model.closure
    if closure is None:
        return rng.uniform(-np.pi, np.pi, (count, n))
    lower, upper = (
        np.array([getattr(joint.limits, end) for joint in model.joints])
        for end in ("lower", "upper")
    )
    return draw_postures_within(model, lower, upper, rng, count)


def draw_postures_within(
    model: RobotModel, lower: Array, upper: Array, rng: np.random.Generator, count: int
) -> Array:
    """Return random positions (count, n_joints) that are uniform within bounds, each (n_joints,).

    Where loops place joints, they are those at which the loops close, away from singular postures:
    limits of a motor often reach farther. Raises `DescriptionError` where there are none.
    """
    n = model.n_joints
    closure = model.closure
    if closure is None:
        return rng.uniform(lower, upper, (count, n))
    home = closure.home[:n]
    reach = np.pi * closure.scale[:n]
    lower = np.maximum(lower, home - reach)
    upper = np.minimum(upper, home + reach)
    found = np.empty((0, n))
    for trial in range(TRIALS):
        width = 1.0 - trial / TRIALS  # nearer to the first posture, the longer it takes
        q = home + width * (rng.uniform(lower, upper, (count, n)) - home)
        at = closure.postures(q)
        found = np.vstack([found, q[at.closed & (at.distance > REGULAR)]])
        if len(found) >= count:
            return found[:count]
    raise DescriptionError(
        f"{model.name}: of {TRIALS * count} random postures of the motors the loops close at"
        f" {len(found)}; give limits within which they do"
    )


def find_first_posture(model: RobotModel) -> Array | None:
    """Return the motors' positions (n_joints,) of the described posture; None without loops."""
    return None if model.closure is None else model.closure.home[: model.n_joints]


def link_poses(model: RobotModel, q: ArrayLike) -> Array:
    """Return the pose of every link in the root frame, shape (n_links, 4, 4).

    For many samples the shape is (n_samples, n_links, 4, 4). The identity is `T_i = T_parent
    before_i motion(q_i) after_i`.
    """
    (qs,) = shape_joint_samples(model, q=q)
    if (coupling := model.coupling) is not None:
        of_tree = link_poses(model.tree, coupling.motion(qs).q)
        return of_tree[:, np.argsort(coupling.order)].reshape(*np.shape(q)[:-1], -1, 4, 4)
    poses = _evaluate_link_poses(model, qs)
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
    (qs,) = shape_joint_samples(model, q=q)
    if (coupling := model.coupling) is not None:
        moved = coupling.motion(qs)
        of_tree = link_jacobians(model.tree, moved.q) @ (
            moved.shares if moved.shares.ndim == 2 else moved.shares[:, None]
        )
        return of_tree[:, np.argsort(coupling.order)].reshape(
            *np.shape(q)[:-1], -1, 6, model.n_joints
        )
    samples, n = qs.shape
    motions = _evaluate_link_poses(model, qs)
    jacobians = np.zeros((samples, n, 6, n))
    for i, (joint, parent) in enumerate(zip(model.joints, model.parents, strict=True)):
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
    return jacobians.reshape(*np.shape(q), 6, n)
