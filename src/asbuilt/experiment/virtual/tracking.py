"""A controlled robot that follows a command in the physics engine."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from asbuilt.arrays import Array
from asbuilt.errors import MotionError
from asbuilt.excitation.motions.motion import Trajectory
from asbuilt.experiment.virtual.drive_train import DriveTrain
from asbuilt.experiment.virtual.physics import Physics

SETTLING = 0.5
"""Time for which the robot holds its first pose before the recording starts [s]."""
ASTRAY = 1.5
"""Distance from the command [rad or m] at which the controller has lost the robot."""


@dataclass(frozen=True, slots=True, eq=False)
class TrackedMotion:
    """Hold what the robot really did at the controller's ticks.

    `t` (N,), link states `q, qd, qdd` and torques (N, n).

    `motor` is the drive's torque, `friction` the part of it that friction takes, `armature` the
    part that speeds up the rotor; the rest moves the links. At a tick, where the torque steps,
    `motor` and `qdd` are the means of before and after.
    """

    t: Array
    q: Array
    qd: Array
    qdd: Array
    motor: Array
    friction: Array
    armature: Array

    @property
    def rigid(self) -> Array:
        """Torque of the rigid bodies, shape (N, n)."""
        return self.motor - self.friction - self.armature


def track(
    physics: Physics,
    train: DriveTrain,
    command: Trajectory,
    feedforward: Array,
    gains: tuple[Array, float],
    torque_limit: Array,
    *,
    substeps: int = 1,
    progress: Callable[[float], None] | None = None,
) -> TrackedMotion:
    """Follow a command whose samples are the controller's ticks, after holding the first pose for
    half a second.

    The engine must have been built with the drive train's armature, viscous and Coulomb friction
    and a time step of a tick over `substeps`.

    Raises
    ------
    MotionError
        If the controller loses the robot.
    """
    t, n = command.t, command.n_joints
    stiffness, lead = gains
    names = (
        "viscous",
        "coulomb",
        "stiction",
        "stribeck_velocity",
        "offset",
        "armature",
        "backlash",
        "engagement",
    )
    viscous, coulomb, stiction, stribeck, offset, armature, backlash, engagement = (
        train.of(name, n) for name in names
    )
    settling = round(SETTLING / (t[1] - t[0])) if not np.any(command.qd[0]) else 0
    warmth = np.concatenate([np.ones(settling), train.warmth(t)])
    q, qd, torque = np.empty((t.size, n)), np.empty((t.size, n)), np.empty((t.size + 1, n))
    physics.start(command.q[0], command.qd[0])
    varies, half = bool(np.any(stiction > 0)) or train.warming > 0, 0.5 * backlash
    tau = feedforward[0]
    torque[0] = tau
    with physics.quiet():
        for k in range(-settling, t.size):
            i, warm = max(k, 0), warmth[k + settling]
            position, velocity = physics.state
            if k >= 0:
                q[k], qd[k] = position, velocity
            seen = position + half * np.tanh(tau / engagement) if half.any() else position
            tau = feedforward[i] + stiffness[i] @ (
                command.q[i] - seen + lead * (command.qd[i] - velocity)
            )
            tau = np.minimum(np.maximum(tau, -torque_limit), torque_limit)
            torque[i + (k >= 0)] = tau
            if varies:
                physics.rub(
                    warm * (coulomb + stiction * np.exp(-((velocity / stribeck) ** 2))),
                    warm * viscous,
                )
            physics.advance(tau - offset, substeps)
            if k % 100 == 0:
                _check_course(physics, position, command.q[i], float(t[i]), torque_limit)
                if progress is not None:
                    progress(i / t.size)
    motor = 0.5 * (torque[:-1] + torque[1:])
    qdd, friction = _accelerations(physics, train, t, q, qd, motor - offset)
    return TrackedMotion(t, q, qd, qdd, motor, friction + offset, armature * qdd)


def _accelerations(
    physics: Physics, train: DriveTrain, t: Array, q: Array, qd: Array, tau: Array
) -> tuple[Array, Array]:
    """Return accelerations and friction at every tick, with the friction law of that moment."""
    n = q.shape[1]
    warmth = train.warmth(t)[:, None]
    stribeck = train.of("stiction", n) * np.exp(-((qd / train.of("stribeck_velocity", n)) ** 2))
    level, damping = warmth * (train.of("coulomb", n) + stribeck), warmth * train.of("viscous", n)
    return physics.accelerations(q, qd, tau, coulomb=level, viscous=damping)


def _check_course(
    physics: Physics, position: Array, command: Array, t: float, torque_limit: Array
) -> None:
    away = np.nan_to_num(np.abs(position - command), nan=np.inf)
    if np.all(away < ASTRAY):
        return
    worst = int(np.argmax(away))
    raise MotionError(
        f"the controller loses joint {physics.model.joint_names[worst]!r} at t = {t:.3g} s: it is"
        f" at {position[worst]:.3g} instead of {command[worst]:.3g}, with a torque limit of"
        f" {torque_limit[worst]:.4g}; slow the motion down, or give the controller another"
        " bandwidth or rate"
    )
