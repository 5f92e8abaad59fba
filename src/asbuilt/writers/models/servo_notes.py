"""What model files and simulators cannot hold of a position servo."""

from __future__ import annotations

import numpy as np

from asbuilt.dynamics.drives.position_servo import PositionServo


def servo_left_out(
    servo: PositionServo | None, kind: str, *, delay: bool = False, falling: bool = False
) -> tuple[str, ...]:
    """Return notes on what a format of this name lacks of a servo.

    `delay` and `falling` say whether it holds the delay, and torque limits that fall with speed.
    """
    if servo is None:
        return ()
    lacks = f"{kind} has no place for"
    notes = []
    if late := servo.delay or 0.0:
        if late < 0.0:
            notes.append(
                f"{lacks} a delay below zero, {1e3 * late:.3g} ms: give the simulator each command"
                f" {-1e3 * late:.3g} ms earlier"
            )
        elif not delay:
            notes.append(
                f"{lacks} the delay of the servo: give the simulator each command"
                f" {1e3 * late:.3g} ms later, and half of its time step, by which steps of first"
                " order act early"
            )
    if servo.limits_goal:
        notes.append(
            f"{lacks} the limit of the goal's acceleration, {min(servo.goal_acceleration):.4g}"
            " rad/s^2: pass commands through it"
        )
    if np.any(servo.deadband):
        notes.append(
            f"{lacks} the deadband of the servo, {max(servo.deadband):.4g} rad or m: give each"
            " command as the position plus what of the control error is beyond it"
        )
    if np.any(servo.leads):
        notes.append(
            f"{lacks} the lead of the servo, {1e3 * max(servo.leads):.3g} ms: give each command as"
            " the position plus this times its rate"
        )
    if not falling and np.any(servo.falling):
        notes.append(
            f"{lacks} torque limits that fall to zero at {min(servo.no_load_speed):.4g} rad/s or"
            " m/s: it has the limits of a joint at rest"
        )
    return tuple(notes)
