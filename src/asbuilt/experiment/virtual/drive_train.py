"""What sits between motor and link, and what holds the robot on its course."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.newton_euler import gravity_torque, inverse_dynamics, mass_matrix
from asbuilt.errors import UsageError
from asbuilt.excitation.motions.motion import Trajectory
from asbuilt.experiment.virtual.sensors import PerJoint, per_joint

FeedForward = Literal["none", "gravity", "full", "exact"]


@dataclass(frozen=True, slots=True, kw_only=True)
class DriveTrain:
    """Describe the drives; every field but `warming` is one number or one per joint, in units of
    the joint (N m and rad, or N and m).

    `armature` is the rotor's inertia at the joint, `viscous` and `coulomb` the friction of the
    running gear, `offset` a constant torque. Below the `stribeck_velocity` dry friction rises by up
    to `stiction`: `F(v) = coulomb + stiction exp(-(v / stribeck_velocity)^2)`. All friction falls
    by the fraction `warming` of its cold value while the gear warms up, `1 - warming (1 - exp(-t /
    warming_time))` with the time [s]. `backlash` is the play of the gear at the joint: the encoder
    on the motor runs ahead of the link by half of it while the torque is positive and lags behind
    while it is negative, with a smooth passage over `engagement` (torque).
    """

    armature: PerJoint = 0.0
    viscous: PerJoint = 0.0
    coulomb: PerJoint = 0.0
    offset: PerJoint = 0.0
    stiction: PerJoint = 0.0
    stribeck_velocity: PerJoint = 0.02
    backlash: PerJoint = 0.0
    engagement: PerJoint = 1.0
    warming: float = 0.0
    warming_time: float = 600.0

    def __post_init__(self) -> None:
        if not 0.0 <= self.warming < 1.0 or not self.warming_time > 0.0:
            raise UsageError(
                "warming is a fraction from 0 to below 1 and warming_time positive seconds, got"
                f" {self.warming} and {self.warming_time}"
            )
        for name in ("stribeck_velocity", "engagement"):
            if np.any(np.asarray(getattr(self, name)) <= 0.0):
                raise UsageError(f"{name} must be positive, got {getattr(self, name)}")

    def of(self, name: str, n: int) -> Array:
        """Return a field for n joints, shape (n,)."""
        return per_joint(getattr(self, name), n, name, signed=name == "offset")

    def warmth(self, t: Array) -> Array:
        """Return by what factor friction is multiplied at times t [s]."""
        return 1.0 - self.warming * (1.0 - np.exp(-t / self.warming_time))

    def motor_position(self, q: Array, tau: Array) -> Array:
        """Return what the encoder on the motor sees of link positions q while torques tau are
        transmitted, shape of q [rad or m].
        """
        n = q.shape[-1]
        return q + 0.5 * self.of("backlash", n) * np.tanh(tau / self.of("engagement", n))


@dataclass(frozen=True, slots=True, kw_only=True)
class PositionController:
    """Describe the controller that makes the robot follow.

    `tau = feed-forward + M (w^2 (q_command - q) + 2 damping w (qd_command - qd))`.

    M is the mass matrix of the description at the command, armature included, and `w = 2 pi
    bandwidth` [Hz], so that every joint answers alike (computed torque). The feed-forward is what
    the *description* says that the bodies take: nothing, their gravity, or all of it; `exact` adds
    what rotors and friction take, as they are. The torque is held between two ticks of `rate` [Hz],
    rounded up to a multiple of the logger's, and limited to what the joint can give.
    """

    bandwidth: float = 12.0
    damping: float = 1.0
    feedforward: FeedForward = "full"
    rate: float = 1000.0

    def __post_init__(self) -> None:
        for name in ("bandwidth", "damping", "rate"):
            if not (np.isfinite(value := getattr(self, name)) and value > 0):
                raise UsageError(f"{name} of the controller must be a positive number, got {value}")
        if self.feedforward not in get_args(FeedForward):
            raise UsageError(
                f"feedforward {self.feedforward!r} is not one of {', '.join(get_args(FeedForward))}"
            )
        if self.bandwidth > self.rate / 20:
            raise UsageError(
                f"a controller of {self.rate:g} Hz cannot have a bandwidth of {self.bandwidth:g}"
                f" Hz; stay below a twentieth, {self.rate / 20:g} Hz"
            )

    def gains(self, described: RobotModel, armature: Array, q: Array) -> tuple[Array, float]:
        """Return stiffness (N, n, n) at positions (N, n), and by what time [s] a velocity error
        counts as a position error.
        """
        pole = 2.0 * np.pi * self.bandwidth
        return (mass_matrix(described, q) + np.diag(armature)) * pole**2, 2.0 * self.damping / pole

    def feedforward_torque(
        self, described: RobotModel, train: DriveTrain, command: Trajectory
    ) -> Array:
        """Return the torque that the controller expects along the command, shape (N, n)."""
        if self.feedforward == "none":
            return np.zeros(command.q.shape)
        if self.feedforward == "gravity":
            return gravity_torque(described, command.q)
        bodies = inverse_dynamics(described, command.q, command.qd, command.qdd)
        if self.feedforward == "full":
            return bodies
        armature, viscous, coulomb = (
            train.of(name, command.n_joints) for name in ("armature", "viscous", "coulomb")
        )
        friction = (
            viscous * command.qd
            + coulomb * np.sign(command.qd)
            + train.of("offset", command.n_joints)
        )
        return bodies + armature * command.qdd + friction
