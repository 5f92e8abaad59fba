"""Classes, actuators and several robots of one file, against MuJoCo's own compiled model."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from asbuilt.arrays import Array
from asbuilt.description.formats.mjcf import read_mjcf
from asbuilt.dynamics import inverse_dynamics
from asbuilt.dynamics.drives.position_servo import read_described_servo
from asbuilt.identification.trajectories.mujoco_engine import simulate_windows
from asbuilt.identification.trajectories.simulated_robot import (
    DriveSignal,
    build_robot_as_described,
)
from asbuilt.identification.trajectories.windows import Windows

STEP = 1e-3
SCENE = """
<mujoco model="two arms">
<compiler angle="degree" autolimits="true"/>
<option timestep="0.001" integrator="implicitfast"><flag contact="disable"/></option>
<default>
  <joint damping="0.3" armature="0.02"/>
  <default class="big"><joint axis="0 1 0" damping="0.8" frictionloss="0.2" range="-170 170"
    solreffriction="0.002 1" solimpfriction="0.9999 0.9999 0.001"/>
    <position kp="60" kv="3" forcerange="-15 15"/>
    <default class="wrist"><joint armature="0.005" damping="0.1"/>
      <position kp="20" kv="0.5" forcerange="-4 4"/></default></default>
  <default class="slow"><motor gear="3" ctrlrange="-2 2"/></default>
</default>
<worldbody>
<body name="left" pos="0 0.4 0" childclass="big">
  <joint name="left 1" axis="0 0 1"/>
  <geom type="capsule" size=".03" fromto="0 0 0 0 0 .2" mass="1"/>
  <body name="left forearm" pos="0 0 .2"><joint name="left 2"/>
    <geom type="box" size=".15 .02 .03" pos=".15 0 0" mass=".7"/>
    <body name="left hand" pos=".3 0 0" euler="20 0 0"><joint name="left 3" class="wrist"/>
      <geom type="sphere" size=".04" pos=".05 0 .01" mass=".3"/></body></body></body>
<body name="right" pos="0 -0.4 0" euler="0 0 90">
  <joint name="right 1" axis="1 0 0"/>
  <geom type="capsule" size=".03" fromto="0 0 0 0 .2 .2" mass="2"/>
  <body name="right forearm" pos="0 .2 .2">
    <joint name="right 2" type="slide" axis="0 1 0" range="-1 1"/>
    <geom type="sphere" size=".05" mass=".5"/></body></body>
</worldbody>
<actuator>
  <position name="a" joint="left 1" class="big"/>
  <position name="b" joint="left 2" class="big" kp="45" dampratio="0.7"/>
  <position name="c" joint="left 3" class="wrist" gear="2"/>
  <motor name="d" joint="right 1" class="slow"/>
  <general name="e" joint="right 2" gainprm="300" biasprm="0 -300 -20" biastype="affine"/>
</actuator>
</mujoco>
"""


def compiled(text: str = SCENE) -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(text)


def test_torques_of_both_arms_are_mujocos() -> None:
    model, scene = read_mjcf(SCENE), compiled()
    assert model.joint_names == ("left 1", "left 2", "left 3", "right 1", "right 2")
    assert [model.parents[k] for k in (0, 3)] == [-1, -1]
    armature, viscous = (
        np.array([getattr(joint.drive, name) for joint in model.joints])
        for name in ("armature", "viscous")
    )
    scene.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    data = mujoco.MjData(scene)
    states = np.random.default_rng(1).uniform(-1.0, 1.0, (3, 40, 5))
    ours = inverse_dynamics(model, *states) + armature * states[2] + viscous * states[1]
    for k, (q, qd, qdd) in enumerate(zip(*states, strict=True)):
        data.qpos[:], data.qvel[:], data.qacc[:] = q, qd, qdd
        mujoco.mj_inverse(scene, data)
        np.testing.assert_allclose(data.qfrc_inverse, ours[k], rtol=0, atol=1e-11)


def test_classes_reach_joints_and_actuators() -> None:
    model, scene = read_mjcf(SCENE), compiled()
    drives = {joint.name: joint.drive for joint in model.joints}
    assert (drives["left 1"].armature, drives["left 1"].viscous) == (0.02, 0.8)
    assert (drives["left 3"].armature, drives["left 3"].coulomb) == (0.005, 0.2)
    assert (drives["right 1"].viscous, drives["right 1"].coulomb) == (0.3, None)
    assert (drives["left 1"].kp, drives["left 1"].kd) == (60.0, 3.0)
    assert (drives["left 3"].kp, drives["left 3"].kd) == (80.0, 2.0)
    assert drives["left 2"].kp == 45.0
    assert drives["left 2"].kd == -scene.actuator_biasprm[1, 2] > 1.0
    assert (drives["right 2"].kp, drives["right 2"].kd) == (300.0, 20.0)
    assert drives["right 1"].kp is None


def test_torque_limits_are_what_mujoco_reaches() -> None:
    model, scene = read_mjcf(SCENE), compiled()
    data = mujoco.MjData(scene)
    data.ctrl[:] = 1e3
    mujoco.mj_forward(scene, data)
    limits = np.array([joint.limits.torque for joint in model.joints])
    np.testing.assert_allclose(data.qfrc_actuator[:4], limits[:4])
    assert np.isinf(limits[4])


def test_the_servo_moves_the_arm_as_mujocos_actuators_do() -> None:
    text = SCENE.replace(
        '<motor name="d" joint="right 1" class="slow"/>',
        '<position name="d" joint="right 1" kp="80" kv="6"/>',
    )
    model, scene = read_mjcf(text), compiled(text)
    servo = read_described_servo(model)
    assert servo is not None
    t = STEP * np.arange(401)
    command = np.sin(7.0 * t[:, None] + np.arange(5)) * np.array([0.6, 0.5, 0.7, 0.4, 0.2])
    start = np.array([0.2, -0.3, 0.5, 0.1, 0.05])
    windows = Windows(
        "made up", 0.4, 1.0 / STEP, np.zeros(1), np.zeros((1, 401, 5)), start[None],
        np.zeros((1, 5)), DriveSignal("command", t, command),
    )  # fmt: skip
    (own,) = simulate_windows(build_robot_as_described(model, servo), windows)
    (controls,) = windows.inputs()
    data, found = mujoco.MjData(scene), list[Array]()
    data.qpos[:] = start
    found.append(data.qpos.copy())
    gear = scene.actuator_gear[:, 0]
    for control in controls:
        data.ctrl[:] = control * gear
        mujoco.mj_step(scene, data)
        found.append(data.qpos.copy())
    np.testing.assert_allclose(np.array(found), own, rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    ("actuator", "said"),
    [
        ('<velocity name="v" joint="right 1" kv="3"/>', "actuators v are left out"),
        ('<position name="p" joint="right 1" kp="3" timeconst="0.1"/>', "actuators p are taken"),
        (
            '<position name="p" joint="right 1" kp="3"/><motor name="m" joint="right 1"/>',
            "actuators p, m act on one joint",
        ),
    ],
)
def test_actuators_that_a_model_does_not_hold_are_noted(actuator: str, said: str) -> None:
    text = SCENE.replace('<motor name="d" joint="right 1" class="slow"/>', actuator)
    assert any(said in note for note in read_mjcf(text).notes)
    assert not any("actuators" in note for note in read_mjcf(SCENE).notes)


@pytest.mark.parametrize(
    ("actuator", "gains"),
    [
        ('<position class="big" joint="left 1" inheritrange="1"/>', (60.0, 3.0, 15.0)),
        ('<position jointinparent="left 1" kp="10" kv="1"/>', (10.0, 1.0, np.inf)),
        ('<position joint="left 1" kp="10" gear="-3" forcerange="-2 1"/>', (90.0, 0.0, 6.0)),
        (
            '<general joint="left 1" gainprm="20" biastype="affine" biasprm="0 -20 -1"'
            ' forcerange="-3 3"/>',
            (20.0, 1.0, 3.0),
        ),
    ],
)
def test_gains_are_those_of_mujocos_forces(actuator: str, gains: tuple[float, ...]) -> None:
    text = SCENE[: SCENE.index("<actuator>")] + f"<actuator>{actuator}</actuator></mujoco>"
    joint, scene = read_mjcf(text).joints[0], compiled(text)
    assert (joint.drive.kp, joint.drive.kd, joint.limits.torque) == gains
    data = mujoco.MjData(scene)

    def torque(control: float, position: float, speed: float) -> float:
        data.ctrl[:], data.qpos[0], data.qvel[0] = control, position, speed
        mujoco.mj_forward(scene, data)
        return float(data.qfrc_actuator[0])

    found = (-1e3 * torque(0, 1e-3, 0), -1e3 * torque(0, 0, 1e-3))
    np.testing.assert_allclose(found, gains[:2], atol=1e-9)
    if np.isfinite(gains[2]):
        assert max(abs(torque(sign * 1e4, 0, 0)) for sign in (1, -1)) == pytest.approx(gains[2])


@pytest.mark.parametrize("bias", ["0.5 0 -1", "0 0 0", "-0.4 -2 -1"])
def test_a_range_of_force_holds_for_the_whole_force(bias: str) -> None:
    actuator = (
        f'<general joint="left 1" gear="10" gainprm="2" biastype="affine" biasprm="{bias}"'
        ' forcerange="-3 3"/>'
    )
    text = SCENE[: SCENE.index("<actuator>")] + f"<actuator>{actuator}</actuator></mujoco>"
    scene = compiled(text)
    data = mujoco.MjData(scene)
    reached = []
    for control in (-1e4, 1e4):
        data.ctrl[:] = control
        mujoco.mj_forward(scene, data)
        reached.append(abs(float(data.qfrc_actuator[0])))
    assert read_mjcf(text).joints[0].limits.torque == pytest.approx(max(reached))


def test_rotor_and_friction_of_a_motor_are_those_of_mujoco() -> None:
    actuators = (
        '<motor joint="left 1" gear="20" armature="1e-4" damping="2e-3"/>'
        '<dcmotor name="dc" joint="right 1" gear="50" motorconst="0.05 0.05" resistance="1.5"'
        ' inductance="0.001 0" cogging="0.01 7 0.3" lugre="100 1 .1 .12 .01" saturation="2"'
        ' thermal="1 100 0 .004 25 25" armature="1e-5" input="pos vel" controller="3 0 .1 0 0 12"/>'
    )
    text = SCENE[: SCENE.index("<actuator>")] + f"<actuator>{actuators}</actuator></mujoco>"
    model, scene = read_mjcf(text), compiled(text)
    data = mujoco.MjData(scene)
    scene.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    rng = np.random.default_rng(2)
    armature = np.array([joint.drive.armature for joint in model.joints])
    for _ in range(5):
        q, a = rng.uniform(-1.0, 1.0, (2, 5))
        data.qpos[:], data.qvel[:], data.qacc[:] = q, 0.0, a
        mujoco.mj_inverse(scene, data)
        ours = inverse_dynamics(model, q[None], np.zeros((1, 5)), a[None])[0] + armature * a
        np.testing.assert_allclose(data.qfrc_inverse, ours, atol=1e-10)
    assert model.joints[0].drive.viscous == pytest.approx(0.8 + 2e-3 * 20**2)
    assert model.joints[3].limits.torque == pytest.approx(100.0)
    (note,) = [note for note in model.notes if "dcmotor dc" in note]
    for what in ("back-EMF", "inductance", "cogging of 0.01", "LuGre", "heating", "controller"):
        assert what in note
