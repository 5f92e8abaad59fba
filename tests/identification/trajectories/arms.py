"""Virtual servo arms whose motion another engine computed."""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np

from asbuilt.arrays import Array
from asbuilt.description import DriveValues, RobotModel, bundled_robot
from asbuilt.description.formats.mjcf import read_mjcf
from asbuilt.description.formats.mjcf_text import format_mjcf
from asbuilt.dynamics import PositionServo
from asbuilt.experiment import Recording

DRIVE = DriveValues(armature=0.05, viscous=0.6, coulomb=0.25)
SERVO = PositionServo(kp=(40.0, 25.0), kd=(1.0, 0.5), torque_limit=(20.0, 10.0), delay=0.006)


def servo_arm() -> RobotModel:
    """Return a two-link arm with armature and friction."""
    model = bundled_robot("two-link")
    return replace(model, joints=tuple(replace(joint, drive=DRIVE) for joint in model.joints))


def four_joint_arm(seed: int) -> RobotModel:
    """Return an arm of four random links, with armature and friction at every joint."""
    rng, bodies, at = np.random.default_rng(seed), "", 0.0
    for k, axis in enumerate(("0 0 1", "0 1 0", "0 1 0", "1 0 0")):
        length, (y, z) = rng.uniform(0.12, 0.3), 0.03 * rng.standard_normal(2)
        bodies += (
            f'<body name="link {k}" pos="{at} 0 0"><joint name="joint {k}" axis="{axis}"/>'
            f'<geom type="capsule" size="0.03" fromto="0 0 0 {length} {y} {z}"'
            f' mass="{rng.uniform(0.3, 1.5)}"/>'
        )
        at = length
    model = read_mjcf(f"<mujoco><worldbody>{bodies}{4 * '</body>'}</worldbody></mujoco>")
    joints = (
        replace(
            joint,
            drive=DriveValues(
                armature=rng.uniform(0.02, 0.06),
                viscous=rng.uniform(0.3, 1.0),
                coulomb=rng.uniform(0.1, 0.4),
            ),
        )
        for joint in model.joints
    )
    return replace(model, joints=tuple(joints))


def command(t: Array, seed: int = 0, n: int = 2) -> Array:
    """Return commanded positions of sines and rests, shape (N, n)."""
    rng = np.random.default_rng(seed)
    phases, sizes = rng.uniform(0, 2 * np.pi, (n, 4)), rng.uniform(0.1, 0.3, (n, 4))
    rates = 2 * np.pi * np.array([0.3, 0.7, 1.3, 2.1])
    return np.stack(
        [
            (size * np.sin(rates * t[:, None] + phase)).sum(axis=1)
            for size, phase in zip(sizes, phases, strict=True)
        ],
        axis=1,
    )


def recorded_by_mujoco(
    model: RobotModel,
    servo: PositionServo,
    *,
    duration: float,
    rate: float = 100.0,
    seed: int = 0,
    noise: float = 0.0,
    steps: float = 0.0,
    stribeck: float = 0.0,
    soft: float = 0.002,
    step: float = 1e-3,
) -> Recording:
    """Return a recording of MuJoCo's own position actuators, loaded from MJCF text.

    Goals are moved by the deadband and the lead, and force ranges by the speed, before each step.
    Commands have `steps` [rad] up and down beside their sines. `stribeck` [N m] is what friction
    near rest has more; it fades at 0.1 rad/s. Joints stop in the time `soft` [s] that dry
    friction has in MuJoCo. First-order steps of `step` [s] are those of a command that acts
    `step / 2` earlier.
    """
    actuators = "".join(
        f'<position name="{name}" joint="{name}" kp="{kp}" kv="{kd}"'
        f' forcerange="{-limit} {limit}"/>'
        for name, kp, kd, limit in zip(
            model.joint_names, servo.kp, servo.kd, servo.torque_limit, strict=True
        )
    )
    text = format_mjcf(model, actuators=False, shapes=False).replace(
        "</mujoco>", f"<actuator>{actuators}</actuator></mujoco>"
    )
    text = text.replace('integrator="RK4"', 'integrator="implicitfast"')
    robot = mujoco.MjModel.from_xml_string(text)
    robot.opt.timestep = step
    robot.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_LIMIT
    robot.dof_solref[:], robot.dof_solimp[:, :2] = [soft, 1.0], 0.9999
    robot.jnt_actfrclimited[:] = 0
    data, every = mujoco.MjData(robot), round(1.0 / (rate * step))
    t = np.arange(0.0, duration, 1.0 / rate)
    u = command(t, seed, model.n_joints)
    u += steps * np.sign(np.sin(2.0 * np.pi * 0.9 * t))[:, None]
    late, tick = round((servo.delay or 0.0) / step), round(1e-3 / step)
    data.qpos[:] = u[0]
    q, qd = np.empty_like(u), np.empty_like(u)
    for number in range(len(t) * every):
        if number % every == 0:
            row = number // every
            q[row], qd[row] = data.qpos, data.qvel
        goal, before = (u[max(number - late - back, 0) // every] for back in (0, tick))
        goal = goal + servo.leads * (goal - before) / 1e-3
        data.ctrl[:] = data.qpos + servo.acting(goal - data.qpos)
        if np.any(servo.falling):
            robot.actuator_forcerange[:] = np.stack(servo.bounds(data.qvel), axis=1)
        if stribeck:
            fading = stribeck * np.exp(-((data.qvel / 0.1) ** 2))
            robot.dof_frictionloss[:] = [
                joint.drive.coulomb + more
                for joint, more in zip(model.joints, fading.tolist(), strict=True)
            ]
        mujoco.mj_step(robot, data)
    measured = q + noise * np.random.default_rng(seed).standard_normal(q.shape)
    return Recording(
        t=t,
        q=measured,
        qd=qd,
        tau=np.zeros_like(u),
        command=u,
        servo=servo,
        joint_names=model.joint_names,
        source=f"virtual servo arm {seed}",
        torque_source="command",
    )
