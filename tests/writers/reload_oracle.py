"""Torques of a written robot as other programs find them."""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np
import pinocchio as pin

from asbuilt.description import DriveValues, LinkInertia, RobotModel


def pinocchio_torques(
    urdf: str,
    joints: tuple[str, ...],
    gravity: np.ndarray,
    q: np.ndarray,
    qd: np.ndarray,
    qdd: np.ndarray,
) -> np.ndarray:
    """Read a URDF with Pinocchio and return the torques of the named joints, (N, n)."""
    model = pin.buildModelFromXML(urdf)
    model.gravity.linear = np.array(gravity)
    data = model.createData()
    known = [model.joints[list(model.names).index(name)] for name in joints]
    at = [joint.idx_v for joint in known]
    torques = np.empty(q.shape)
    for k in range(len(q)):
        place, rate, change = pin.neutral(model), np.zeros(model.nv), np.zeros(model.nv)
        rate[at], change[at] = qd[k], qdd[k]
        for value, joint in zip(q[k], known, strict=True):
            place[joint.idx_q : joint.idx_q + joint.nq] = (
                [value] if joint.nq == 1 else [np.cos(value), np.sin(value)]
            )
        torques[k] = pin.rnea(model, data, place, rate, change)[at]
    return torques


def mujoco_torques(
    mjcf: str, joints: tuple[str, ...], q: np.ndarray, qd: np.ndarray, qdd: np.ndarray
) -> np.ndarray:
    """Read an MJCF with MuJoCo and return its inverse dynamics, drives included, (N, n)."""
    model = mujoco.MjModel.from_xml_string(mjcf)
    data = mujoco.MjData(model)
    at = [model.joint(name).id for name in joints]
    torques = np.empty(q.shape)
    for k in range(len(q)):
        data.qpos[at], data.qvel[at], data.qacc[at] = q[k], qd[k], qdd[k]
        mujoco.mj_inverse(model, data)
        torques[k] = data.qfrc_inverse[at]
    return torques


def as_if_identified(model: RobotModel, seed: int, *, drives: bool = True) -> RobotModel:
    """Return the robot with another body added to every link and other drives."""
    rng = np.random.default_rng(seed)
    links = []
    for link in model.links:
        added = LinkInertia.from_com(
            rng.uniform(0.2, 2.0), rng.uniform(-0.05, 0.05, 3), np.diag(rng.uniform(0.01, 0.015, 3))
        )
        links.append(replace(link, inertia=link.inertia + added, inertia_known=True, parts=()))
    joints = [
        replace(
            joint,
            drive=DriveValues(
                armature=rng.uniform(0.1, 1.0),
                viscous=rng.uniform(0.1, 2.0),
                coulomb=rng.uniform(0.1, 20.0),
                offset=rng.normal(),
            ),
        )
        for joint in model.joints
    ]
    return replace(model, links=tuple(links), joints=tuple(joints) if drives else model.joints)


def drive_torques(
    model: RobotModel, qd: np.ndarray, qdd: np.ndarray, *, offset: bool
) -> np.ndarray:
    """Return armature, viscous and Coulomb friction, and the offset where asked for, (N, n)."""
    values = [joint.drive for joint in model.joints]
    armature, viscous, coulomb, constant = (
        np.array([getattr(value, key) or 0.0 for value in values])
        for key in ("armature", "viscous", "coulomb", "offset")
    )
    return armature * qdd + viscous * qd + coulomb * np.sign(qd) + offset * constant


def two_armed(seed: int = 5) -> RobotModel:
    """Return a torso that slides and turns, with two arms on it, tilted gravity."""
    from pinocchio_oracle import random_robot

    rng = np.random.default_rng(seed)
    model = random_robot(rng, 8)
    parents = (-1, 0, 1, 2, 3, 1, 5, 6)
    joints = tuple(
        replace(joint, parent=parent) for joint, parent in zip(model.joints, parents, strict=True)
    )
    joints = (
        replace(joints[0], kind="prismatic"),
        *(replace(joint, kind="revolute") for joint in joints[1:]),
    )
    return replace(model, name="two-armed", joints=joints)
