"""The exported position actuators, loaded by MuJoCo, move as asbuilt's own rollouts."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from asbuilt.arrays import Array
from asbuilt.description import DriveValues, RobotModel, bundled_robot
from asbuilt.description.formats.mjcf import read_mjcf
from asbuilt.dynamics import PositionServo
from asbuilt.identification.trajectories.mujoco_engine import simulate_windows
from asbuilt.identification.trajectories.simulated_robot import (
    DriveSignal,
    build_robot_as_described,
)
from asbuilt.identification.trajectories.windows import Windows
from asbuilt.writers.models.mjcf import export_mjcf

STEP = 1e-3


def with_servo(name: str, offset: float, coulomb: float) -> RobotModel:
    model = bundled_robot(name)
    joints = [
        replace(
            joint,
            drive=DriveValues(
                armature=0.1, viscous=0.5, coulomb=coulomb, offset=offset, kp=90.0 + k, kd=4.0 + k
            ),
            limits=replace(joint.limits, torque=40.0 - k, lower=-np.inf, upper=np.inf),
        )
        for k, joint in enumerate(model.joints)
    ]
    return replace(model, joints=tuple(joints))


def servo_of(model: RobotModel) -> PositionServo:
    return PositionServo(
        kp=tuple(joint.drive.kp or 0.0 for joint in model.joints),
        kd=tuple(joint.drive.kd or 0.0 for joint in model.joints),
        torque_limit=tuple(joint.limits.torque for joint in model.joints),
    )


def rolled_out_by_mujoco(text: str, commands: Array, q: Array, qd: Array) -> Array:
    robot = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(robot)
    data.qpos[:], data.qvel[:] = q, qd
    found = [q]
    for command in commands:
        data.ctrl[:] = command
        mujoco.mj_step(robot, data)
        found.append(data.qpos.copy())
    return np.array(found)


@pytest.mark.parametrize(("offset", "coulomb"), [(0.0, 0.0), (0.8, 0.0), (0.8, 0.6)])
@pytest.mark.parametrize("name", ["two-link", "ur10e"])
def test_rolled_out_again_the_motion_is_equal(name: str, offset: float, coulomb: float) -> None:
    model = with_servo(name, offset, coulomb)
    rng, n, samples = np.random.default_rng(3), model.n_joints, 401
    t = STEP * np.arange(samples)
    command = rng.uniform(-1.5, 1.5, n) * np.sin(9.0 * t[:, None] + rng.uniform(0.0, 3.0, n))
    q, qd = rng.uniform(-1.0, 1.0, n), rng.uniform(-0.5, 0.5, n)
    windows = Windows(
        "made up", 0.4, 1.0 / STEP, np.zeros(1), np.zeros((1, samples, n)), q[None], qd[None],
        DriveSignal("command", t, command),
    )  # fmt: skip
    (own,) = simulate_windows(build_robot_as_described(model, servo_of(model)), windows)
    (controls,) = windows.inputs()
    found = rolled_out_by_mujoco(export_mjcf(model), controls, q, qd)
    assert np.ptp(found, axis=0).min() > 0.01
    np.testing.assert_allclose(found, own, rtol=0, atol=1e-9)


def test_torque_limits_act_and_an_offset_is_outside_them() -> None:
    model = with_servo("two-link", 0.8, 0.0)
    robot = mujoco.MjModel.from_xml_string(export_mjcf(model))
    data = mujoco.MjData(robot)
    data.ctrl[:] = 100.0
    mujoco.mj_forward(robot, data)
    np.testing.assert_allclose(data.qfrc_actuator, [40.0 - 0.8, 39.0 - 0.8], rtol=0, atol=1e-12)


@pytest.mark.parametrize("offset", [0.0, -0.7])
def test_gains_offsets_and_limits_are_read_again(offset: float) -> None:
    model = with_servo("ur10e", offset, 0.3)
    again = read_mjcf(export_mjcf(model))
    for joint, before in zip(again.joints, model.joints, strict=True):
        assert (joint.drive.kp, joint.drive.kd) == (before.drive.kp, before.drive.kd)
        assert (joint.drive.offset or 0.0) == before.drive.offset
        assert joint.limits.torque == pytest.approx(before.limits.torque, rel=1e-12)
