"""Robots with joints that follow others in every file that asbuilt writes."""

from __future__ import annotations

import ctypes
import json
import subprocess
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
from reload_oracle import as_if_identified

import mujoco_oracle
from asbuilt.description import (
    Joint,
    Link,
    Mimic,
    RobotModel,
    bundled_robot,
    load_robot,
    model_document,
    model_from_document,
)
from asbuilt.description.formats.urdf import read_urdf
from asbuilt.dynamics import (
    DriveSet,
    find_base_parameters,
    gravity_torque,
    inverse_dynamics,
    regressor,
)
from asbuilt.errors import DescriptionError
from asbuilt.experiment.virtual.physics import Physics
from asbuilt.writers.models.c.c_code import generate_c_code, write_c
from asbuilt.writers.models.mjcf import export_mjcf
from asbuilt.writers.models.robot_toml import format_robot_toml
from asbuilt.writers.models.urdf import format_urdf
from asbuilt.writers.models.urdf_edit import edit_urdf
from coupled_robots import palletizer

STATES = np.random.default_rng(3).normal(size=(3, 10, 5))


@pytest.mark.parametrize(
    ("name", "written"),
    [("robot.urdf", format_urdf), ("robot.xml", export_mjcf), ("robot.toml", format_robot_toml)],
)
def test_files_are_read_back_to_the_same_torques(name: str, written, tmp_path: Path) -> None:
    robot = palletizer()
    (tmp_path / name).write_text(written(robot))
    again = load_robot(tmp_path / name)
    assert again.joint_names == robot.joint_names
    assert [joint.mimic for joint in again.followers] == [j.mimic for j in robot.followers]
    np.testing.assert_allclose(
        inverse_dynamics(again, *STATES), inverse_dynamics(robot, *STATES), atol=1e-12
    )


def test_documents_are_read_back() -> None:
    robot = palletizer()
    again = model_from_document(json.loads(json.dumps(model_document(robot))))
    np.testing.assert_array_equal(
        inverse_dynamics(again, *STATES), inverse_dynamics(robot, *STATES)
    )


def test_an_original_urdf_gets_inertias_of_all_links() -> None:
    """And friction of a follower, which counts to its driven joint, is not there twice."""
    robot = palletizer()
    text = format_urdf(robot)
    name = '<joint name="level"'
    at = text.index("</joint>", text.index(name))
    text = text[:at] + '<dynamics damping="0.5" friction="0.2"/>' + text[at:]
    original = read_urdf(text)
    assert original.joints[2].drive.viscous == pytest.approx(1.5)
    built = as_if_identified(original, 3)
    drive = replace(built.joints[2].drive, viscous=2.0, coulomb=3.0)
    built = replace(
        built, joints=(*built.joints[:2], replace(built.joints[2], drive=drive), *built.joints[3:])
    )
    again = read_urdf(edit_urdf(text, built)[0])
    np.testing.assert_allclose(
        inverse_dynamics(again, *STATES), inverse_dynamics(built, *STATES), atol=1e-9
    )
    assert (again.joints[2].drive.viscous, again.joints[2].drive.coulomb) == (2.0, 3.0)


def test_mujoco_moves_followers_as_the_equality_says() -> None:
    """The virtual robot takes the accelerations of the projected dynamics."""
    robot = palletizer()
    physics = Physics(robot)
    q, qd, qdd = STATES
    tau = inverse_dynamics(robot, q, qd, qdd)
    np.testing.assert_allclose(mujoco_oracle.inverse_dynamics(physics, q, qd, qdd), tau, atol=1e-10)
    none = np.zeros_like(q)
    found, _ = physics.accelerations(q, qd, tau, coulomb=none, viscous=none)
    np.testing.assert_allclose(found, qdd, rtol=1e-4, atol=1e-4)
    exported = mujoco.MjModel.from_xml_string(export_mjcf(robot))
    assert (exported.neq, exported.nu) == (3, 5)


@pytest.mark.parametrize(
    "described", [palletizer(), bundled_robot("dvrk-psm")], ids=lambda m: m.name
)
def test_c_code(described: RobotModel, tmp_path: Path) -> None:
    robot = as_if_identified(described, 4)
    n = robot.n_joints
    states = np.random.default_rng(12).normal(size=(3, 6, n))
    source, _ = write_c(tmp_path / "robot.c", robot)
    library = tmp_path / "robot.so"
    flags = ("-std=c99", "-Wall", "-Wextra", "-Werror", "-O0", "-shared", "-fPIC")
    subprocess.run(["gcc", *flags, str(source), "-o", str(library), "-lm"], check=True)
    functions, prefix = ctypes.CDLL(str(library)), generate_c_code(robot).prefix

    def called(name: str, size: int, *inputs: np.ndarray) -> np.ndarray:
        out = np.full(size, np.nan)
        pointer = ctypes.POINTER(ctypes.c_double)
        given = [np.ascontiguousarray(x).ctypes.data_as(pointer) for x in (*inputs, out)]
        getattr(functions, f"{prefix}_{name}")(*given)
        return out

    drive = DriveSet.parse("armature,viscous,coulomb,offset")
    base = find_base_parameters(robot, drive)
    chi = np.concatenate([robot.parameters, drive_values(robot)])
    for state in zip(*states, strict=True):
        tau = regressor(robot, *state, drive) @ chi
        np.testing.assert_allclose(called("inverse_dynamics", n, *state), tau, atol=1e-9)
        np.testing.assert_allclose(
            called("gravity_torque", n, state[0]), gravity_torque(robot, state[0]), atol=1e-10
        )
        Y = called("regressor", n * base.n_base, *state).reshape(n, -1)
        expected = regressor(robot, *state, drive)[:, base.columns]
        np.testing.assert_allclose(Y, expected, atol=1e-9)


def drive_values(robot: RobotModel) -> np.ndarray:
    return np.array(
        [
            getattr(joint.drive, name) or 0.0
            for joint in robot.joints
            for name in ("armature", "viscous", "coulomb", "offset")
        ]
    )


def test_locking_a_driven_joint_locks_its_followers() -> None:
    robot = palletizer()
    locked = robot.locked({"a3": 0.3})
    assert locked.locked_joints == pytest.approx({"a3": 0.3, "level": -0.2})
    assert [joint.name for joint in locked.followers] == ["f2", "f3"]
    free = [0, 1, 3, 4]
    q, qd, qdd = (np.array(x) for x in STATES)
    q[:, 2], qd[:, 2], qdd[:, 2] = 0.3, 0.0, 0.0
    np.testing.assert_allclose(
        inverse_dynamics(locked, q[:, free], qd[:, free], qdd[:, free]),
        inverse_dynamics(robot, q, qd, qdd)[:, free],
        atol=1e-11,
    )


def test_circles_and_motors_of_followers_are_refused() -> None:
    robot = palletizer()
    arm: list[Joint] = list(robot.tree.joints)
    links: tuple[Link, ...] = robot.tree.links
    names = [joint.name for joint in arm]
    level, lift = names.index("level"), names.index("a3")
    arm[level] = replace(arm[level], mimic=Mimic({"a3": 1.0}))
    T = np.eye(len(arm))
    T[lift, level] = 0.5
    with pytest.raises(DescriptionError, match="follows another and has no motor"):
        RobotModel("coupled", tuple(arm), links, motor_coupling=T)
    T[lift, level], T[lift, 0] = 0.0, 0.5
    coupled = RobotModel("coupled", tuple(arm), links, motor_coupling=T)
    assert coupled.motor_coupling is not None
    assert coupled.motor_coupling.shape == (7, 7)
    arm[lift] = replace(arm[lift], mimic=Mimic({"level": 1.0}))
    with pytest.raises(DescriptionError, match="mimics itself"):
        RobotModel("circle", tuple(arm), links)
