"""Position servo of a virtual robot: it follows held commands, and its log has no torque."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.drives.position_servo import PositionServo
from asbuilt.errors import UsageError
from asbuilt.excitation.motions.motion import Trajectory
from asbuilt.experiment.virtual.drive_train import DriveTrain
from asbuilt.experiment.virtual.sensors import PerJoint, per_joint


@dataclass(frozen=True, slots=True, kw_only=True)
class JointServo:
    """Describe a servo, `tau = clip(kp (command(t - delay) - q) - kd qd, -limit, limit)`.

    The command is held between two samples of the log, the torque between two ticks of `rate`. The
    limit is that of the joint.

    Parameters
    ----------
    kp, kd
        Stiffness [N m/rad or N/m] and damping [N m s/rad or N s/m], one number or one per joint.
    delay
        Time by which the torque follows the command [s].
    rate
        Rate of the servo [Hz].

    Raises
    ------
    UsageError
        If a value is outside its range.
    """

    kp: PerJoint
    kd: PerJoint = 0.0
    delay: float = 0.0
    rate: float = 1000.0

    def __post_init__(self) -> None:
        if not np.all(np.asarray(self.kp) > 0.0) or not np.all(np.asarray(self.kd) >= 0.0):
            raise UsageError(
                f"kp of a servo must be positive and kd not negative, got {self.kp} and {self.kd}",
                value=(self.kp, self.kd),
                lower=0.0,
            )
        if not (np.isfinite(self.delay) and self.delay >= 0.0):
            raise UsageError(f"delay must not be negative, got {self.delay}", value=self.delay)
        if not (np.isfinite(self.rate) and self.rate > 0.0):
            raise UsageError(f"rate must be positive, got {self.rate}", value=self.rate)

    def target(self, command: Trajectory, rate: float) -> Trajectory:
        """Return the command at the ticks as it arrives: held, delayed, without its velocity.

        `rate` is that of the samples [Hz], of which the ticks are a multiple.
        """
        every = round(1.0 / rate / (command.t[1] - command.t[0]))
        # Share of a period by which the time of a tick may be off by rounding.
        sample = np.floor((command.t - self.delay) * rate + 1e-6).astype(int)
        held = command.q[every * np.maximum(sample, 0)]
        return Trajectory(command.t, held, np.zeros(held.shape), np.zeros(held.shape))

    def gains(self, described: RobotModel, armature: Array, q: Array) -> tuple[Array, Array]:
        """Return stiffness (N, n, n) at positions (N, n), and damping over stiffness (n,) [s]."""
        kp, kd = (per_joint(x, q.shape[1], name) for x, name in ((self.kp, "kp"), (self.kd, "kd")))
        return np.broadcast_to(np.diag(kp), (len(q), *np.diag(kp).shape)), kd / kp

    def feedforward_torque(
        self, described: RobotModel, train: DriveTrain, command: Trajectory
    ) -> Array:
        """Return zero torques (N, n): a servo expects nothing."""
        return np.zeros(command.q.shape)

    def law(self, model: RobotModel) -> PositionServo:
        """Return the servo as a log states it: gains and limits, and a delay that is unknown."""
        kp, kd = (per_joint(x, model.n_joints, "kp") for x in (self.kp, self.kd))
        limits = tuple(joint.limits.torque for joint in model.joints)
        return PositionServo(kp=tuple(kp.tolist()), kd=tuple(kd.tolist()), torque_limit=limits)
