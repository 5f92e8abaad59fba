"""Pinocchio models built from ours, joint by joint, and random robots to compare them on."""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from asbuilt.description import ROOT, Joint, Link, LinkInertia, RobotModel

PINOCCHIO_ORDER = np.array([9, 6, 7, 8, 0, 1, 3, 2, 4, 5])
"""Pinocchio's dynamic parameters, m mx my mz Ixx Ixy Iyy Ixz Iyz Izz, as positions in ours."""


def pinocchio_model(model: RobotModel) -> pin.Model:
    """Build the same robot in Pinocchio.

    Joint i+1 there is joint i here, its frame being our joint frame after the motion.
    """
    built = pin.Model()
    built.gravity.linear = np.array(model.gravity)
    for i, joint in enumerate(model.joints):
        before = pin.SE3(np.array(joint.before))
        if joint.parent == ROOT:
            parent, placement = 0, before
        else:
            parent, placement = (
                joint.parent + 1,
                pin.SE3(np.array(model.joints[joint.parent].after)) * before,
            )
        kind = pin.JointModelRZ() if joint.is_revolute else pin.JointModelPZ()
        number = built.addJoint(parent, kind, placement, joint.name)
        assert number == i + 1
        body = pin.Inertia.FromDynamicParameters(model.links[i].inertia.parameters[PINOCCHIO_ORDER])
        built.appendBodyToJoint(number, body, pin.SE3(np.array(joint.after)))
    return built


def placement(rotation: np.ndarray, translation: np.ndarray) -> np.ndarray:
    """Return a 4 x 4 pose."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, translation
    return pose


def random_rotation(rng: np.random.Generator) -> np.ndarray:
    """Draw a rotation uniformly."""
    x, y, z, w = (v / 1.0 for v in rng.normal(size=4))
    return pin.Quaternion(
        np.array([x, y, z, w]) / np.sqrt(x * x + y * y + z * z + w * w)
    ).toRotationMatrix()


def rotation_about_x(angle: float) -> np.ndarray:
    """Return the rotation about x."""
    return pin.rpy.rpyToMatrix(angle, 0.0, 0.0)


def random_inertia(rng: np.random.Generator) -> LinkInertia:
    """Draw a rigid body made of point masses, hence physically consistent."""
    masses, points = rng.uniform(0.1, 1.0, 6), rng.normal(scale=0.2, size=(6, 3))
    tensor = sum(
        m * (p @ p * np.eye(3) - np.outer(p, p)) for m, p in zip(masses, points, strict=True)
    )
    return LinkInertia.from_origin(float(masses.sum()), masses @ points, tensor)


def random_robot(
    rng: np.random.Generator, n_joints: int, *, chain: bool = False, style: str = "general"
) -> RobotModel:
    """Draw a tree (or chain) of revolute and prismatic joints under gravity of any direction.

    `style` is "general" (any placement on both sides), "distal" (placements after the joint, turned
    about x) or "proximal" (before it).
    """
    joints, links = [], []
    for i in range(n_joints):
        parent = i - 1 if chain else int(rng.integers(ROOT, i))
        sides = {"general": (True, True), "distal": (False, True), "proximal": (True, False)}[style]
        turns = [
            (
                random_rotation(rng)
                if style == "general"
                else rotation_about_x(rng.choice([0.0, np.pi / 2, rng.uniform(-3, 3)]))
            )
            for _ in sides
        ]
        before, after = (
            placement(turn, rng.normal(scale=0.5, size=3)) if used else np.eye(4)
            for used, turn in zip(sides, turns, strict=True)
        )
        kind = "revolute" if rng.uniform() < 0.7 else "prismatic"
        joints.append(
            Joint(name=f"joint{i + 1}", kind=kind, parent=parent, before=before, after=after)
        )
        links.append(Link(name=f"link{i + 1}", inertia=random_inertia(rng)))
    return RobotModel(
        name="random",
        joints=tuple(joints),
        links=tuple(links),
        gravity=rng.normal(scale=7.0, size=3),
    )
