from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from pinocchio_oracle import random_robot
from reload_oracle import as_if_identified, drive_torques, mujoco_torques, two_armed

from asbuilt.description import DriveValues, LinkInertia, RobotModel, bundled_robot, load_robot
from asbuilt.dynamics import inverse_dynamics
from asbuilt.errors import InertiaError
from asbuilt.writers.models.as_built import draw_sample_states
from asbuilt.writers.models.mjcf import export_mjcf, write_mjcf

BUNDLED = ("kuka-iiwa7-r800", "ur10e", "franka-panda", "scara", "two-link")
STRANGERS = ("lbrstack_med7.urdf", "kuka_lwr4.urdf", "ur10.urdf", "xarm7.urdf", "mjcf_iiwa14.xml")


def check_reloads(model: RobotModel) -> None:
    q, qd, qdd = draw_sample_states(model, 30)
    qd = np.where(np.abs(qd) < 0.1, 0.1, qd)
    expected = inverse_dynamics(model, q, qd, qdd) + drive_torques(model, qd, qdd, offset=False)
    found = mujoco_torques(export_mjcf(model), model.joint_names, q, qd, qdd)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9)


@pytest.mark.parametrize("name", BUNDLED)
def test_bundled_robots(name: str) -> None:
    check_reloads(as_if_identified(bundled_robot(name), 3))


@pytest.mark.parametrize("name", STRANGERS)
def test_descriptions_of_strangers(shared: Path, name: str) -> None:
    check_reloads(as_if_identified(load_robot(shared / "models" / name), 4))


@pytest.mark.parametrize("seed", range(4))
def test_random_trees_under_tilted_gravity(seed: int) -> None:
    check_reloads(as_if_identified(random_robot(np.random.default_rng(seed), 7), seed))


def test_two_arms() -> None:
    check_reloads(as_if_identified(two_armed(), 4))


def test_motor_torques_accelerate_as_forward_dynamics_says() -> None:
    model = as_if_identified(bundled_robot("ur10e"), 3)
    model = replace(
        model,
        joints=tuple(
            replace(joint, drive=replace(joint.drive, coulomb=None)) for joint in model.joints
        ),
    )
    compiled = mujoco.MjModel.from_xml_string(export_mjcf(model))
    data = mujoco.MjData(compiled)
    q, qd, qdd = draw_sample_states(model, 5)
    torque = inverse_dynamics(model, q, qd, qdd) + drive_torques(model, qd, qdd, offset=True)
    limits = np.array([joint.limits.torque for joint in model.joints])
    assert compiled.nu == 6
    for k in np.flatnonzero(np.all(np.abs(torque) < limits, axis=1)):
        data.qpos[:], data.qvel[:], data.ctrl[:] = q[k], qd[k], torque[k]
        mujoco.mj_forward(compiled, data)
        np.testing.assert_allclose(data.qacc, qdd[k], atol=1e-8)


def test_own_reader_gives_the_robot_back(tmp_path: Path) -> None:
    model = as_if_identified(bundled_robot("scara"), 5)
    path, notes = write_mjcf(tmp_path / "robot.xml", model)
    read = load_robot(path)
    q, qd, qdd = draw_sample_states(model, 10)
    np.testing.assert_allclose(
        inverse_dynamics(read, q, qd, qdd), inverse_dynamics(model, q, qd, qdd), atol=1e-10
    )
    for joint, there in zip(model.joints, read.joints, strict=True):
        assert there.drive == joint.drive
        assert there.limits.torque == joint.limits.torque
    assert "offsets of the drives are the bias of the actuators" in notes[0]
    assert "offsets of the drives are the bias" in path.read_text(encoding="utf-8")


def test_hostile_names_and_notes_stay_text(example: Any) -> None:
    check_reloads(replace(as_if_identified(example.model, 1), notes=("a ---> b --",)))


def test_impossible_models_are_refused() -> None:
    model = bundled_robot("two-link")
    impossible = LinkInertia.from_com(-1.0, np.zeros(3), np.eye(3))
    with pytest.raises(InertiaError, match=r"link 2: mass is -1 kg"):
        export_mjcf(
            replace(model, links=(model.links[0], replace(model.links[1], inertia=impossible)))
        )
    pushing = replace(model.joints[0], drive=DriveValues(armature=-0.1))
    with pytest.raises(InertiaError, match=r"joint 1: armature is -0\.1"):
        export_mjcf(replace(model, joints=(pushing, model.joints[1])))
