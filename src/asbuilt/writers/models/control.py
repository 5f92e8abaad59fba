"""What model files hold of position servos: gains, limits and delay, and what they leave out."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal
from xml.etree.ElementTree import Element

import numpy as np

from asbuilt.description.model import Joint, RobotModel
from asbuilt.dynamics import PositionServo
from asbuilt.identification import IdentificationResult

NO_GAINS = "no position servo was identified: gains are zero, and commands are torques"


def with_gains(robot: RobotModel, servo: PositionServo | None) -> RobotModel:
    """Return the robot with the gains and torque limits of a servo, if there is one."""
    if servo is None:
        return robot
    joints = tuple(
        replace(
            joint,
            drive=replace(joint.drive, kp=kp, kd=kd),
            # The strictest of what servo and description allow.
            limits=replace(joint.limits, torque=min(limit, joint.limits.torque)),
        )
        for joint, kp, kd, limit in zip(
            robot.joints, servo.kp, servo.kd, servo.torque_limit, strict=True
        )
    )
    return replace(robot, joints=joints)


def add_position_actuator(actuator: Element, element: Element, joint: Joint) -> None:
    """Make a position actuator of a motor: `clip(kp (u - q) - kd qd, -limit, limit) - Fo`."""
    kp = joint.drive.kp or 0.0
    kd = joint.drive.kd or 0.0
    offset = joint.drive.offset or 0.0
    # The limit is the servo's, which acts before the joint's.
    limit = joint.limits.torque
    actuator.attrib.pop("ctrlrange", None)
    element.attrib.pop("actuatorfrcrange", None)
    if offset:
        actuator.tag = "general"
        actuator.attrib.update(
            gainprm=repr(kp), biastype="affine", biasprm=f"{-offset!r} {-kp!r} {-kd!r}"
        )
    else:
        actuator.tag = "position"
        actuator.attrib.update(kp=repr(kp), kv=repr(kd))
    if np.isfinite(limit):
        # The bias is part of the force that is limited.
        actuator.set("forcerange", f"{-limit - offset!r} {limit - offset!r}")


def note_missing_gains(
    result: IdentificationResult, kind: Literal["mjcf", "urdf"]
) -> tuple[str, ...]:
    """Return what a model file cannot hold of the servo of a result."""
    lost = kind == "urdf" and result.servo is not None
    gains = ("URDF has no place for the gains of the servo",) if lost else ()
    return (*note_left_out_control(result, kind.upper()), *gains)


def find_command_delay(result: IdentificationResult) -> float:
    """Return the delay of commands [s], not below zero: no simulator has commands early.

    `note_left_out_control` says so.
    """
    return 0.0 if result.servo is None else max(result.servo.delay or 0.0, 0.0)


def note_left_out_control(
    result: IdentificationResult, kind: str, *, delay: bool = False, falling: bool = False
) -> tuple[str, ...]:
    """Return notes on what a format of this name lacks of the servo of a result.

    `delay` and `falling` say whether it holds the delay, and torque limits that fall with speed.
    """
    servo = result.servo
    if servo is None:
        return ()
    # Simulators step in ms, and so do the sentences.
    late = 1e3 * (servo.delay or 0.0)
    losses = {
        f"a delay below zero, {late:.3g} ms: give the simulator each command {-late:.3g} ms"
        " earlier": late < 0.0,
        # A step of first order takes a command for its whole length: half of it early in the mean.
        f"the delay of the servo: give the simulator each command {late:.3g} ms later, and half of"
        " its time step, by which steps of first order act early": late > 0.0 and not delay,
        f"the limit of the goal's acceleration, {min(servo.goal_acceleration):.4g} rad/s^2: pass"
        " commands through it": servo.limits_goal,
        f"the deadband of the servo, {max(servo.deadband):.4g} rad or m: give each command as the"
        " position plus what of the control error is beyond it": np.any(servo.deadband),
        f"the lead of the servo, {1e3 * max(servo.leads):.3g} ms: give each command as the position"
        " plus this times its rate": np.any(servo.leads),
        f"torque limits that fall to zero at {min(servo.no_load_speed):.4g} rad/s or m/s: it has"
        " the limits of a joint at rest": not falling and np.any(servo.falling),
    }
    return tuple(f"{kind} has no place for {what}" for what, lost in losses.items() if lost)
