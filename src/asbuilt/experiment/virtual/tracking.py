"""Simulation of a controlled robot that follows a command."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from asbuilt.arrays import Array
from asbuilt.errors import MotionError
from asbuilt.excitation.motions.motion import Trajectory
from asbuilt.experiment.virtual.drive_train import DriveTrain
from asbuilt.experiment.virtual.physics import Physics
from asbuilt.findings import Cure


@dataclass(frozen=True, eq=False)
class TrackedMotion(Trajectory):
    """Hold the true motion at the controller's ticks, with torques (N, n).

    `motor` is the drive's torque, `friction` and `armature` the parts of it for friction and for
    the rotor; the rest moves the links. At a tick, where the torque steps, `motor` and `qdd` are
    the means of before and after.
    """

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
    gains: tuple[Array, Array | float],
    torque_limit: Array,
    *,
    substeps: int = 1,
    progress: Callable[[float], None] | None = None,
) -> TrackedMotion:
    """Follow a command whose samples are the controller's ticks, after half a second of rest.

    The engine must have the drive train's armature, viscous and Coulomb friction, and a time step
    of a tick over `substeps`.

    Raises
    ------
    MotionError
        If a joint does not follow the command.
    """
    t = command.t
    n = command.n_joints
    stiffness, lead = gains
    names = ("viscous", "stiction", "offset", "armature", "backlash", "engagement")
    viscous, stiction, offset, armature, backlash, engagement = (train.of(x, n) for x in names)
    law = train.friction_law(n)
    # Duration of the first pose before the recording starts [s].
    settling = round(0.5 / (t[1] - t[0])) if not np.any(command.qd[0]) else 0
    warmth = np.concatenate([np.ones(settling), train.warmth(t)])
    q = np.empty((t.size, n))
    qd = np.empty((t.size, n))
    torque = np.empty((t.size + 1, n))
    physics.start(command.q[0], command.qd[0])
    varies = bool(np.any(stiction > 0)) or train.warming > 0
    half = 0.5 * backlash
    tau = feedforward[0]
    torque[0] = tau
    with physics.quiet():
        for k in range(-settling, t.size):
            i = max(k, 0)
            warm = warmth[k + settling]
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
                physics.rub(warm * law(velocity), warm * viscous)
            physics.advance(tau - offset, substeps)
            if k % 100 == 0:
                _check_distance(physics, position, command.q[i], float(t[i]), torque_limit)
                if progress is not None:
                    progress(i / t.size)
    motor = 0.5 * (torque[:-1] + torque[1:])
    warm_ticks = train.warmth(t)[:, None]
    qdd, friction = physics.accelerations(
        q, qd, motor - offset, coulomb=warm_ticks * law(qd), viscous=warm_ticks * viscous
    )
    return TrackedMotion(t, q, qd, qdd, motor, friction + offset, armature * qdd)


def _check_distance(
    physics: Physics, position: Array, command: Array, t: float, torque_limit: Array
) -> None:
    away = np.nan_to_num(np.abs(position - command), nan=np.inf)
    # Distance from the command [rad or m] at which the simulation is stopped.
    if np.all(away < 1.5):
        return
    worst = int(np.argmax(away))
    raise MotionError(
        f"joint {physics.model.joint_names[worst]!r} does not follow the command at t = {t:.3g} s:"
        f" it is at {position[worst]:.3g} instead of {command[worst]:.3g}; its torque limit is"
        f" {torque_limit[worst]:.4g}",
        cure=Cure("slow the motion down, or change bandwidth or rate of the controller"),
        joint=physics.model.joint_names[worst],
        time=t,
        value=float(position[worst]),
        expected=float(command[worst]),
    )
