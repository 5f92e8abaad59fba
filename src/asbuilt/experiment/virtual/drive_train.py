"""Drives and position controller of a virtual robot, and its motion along a command."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import ClassVar, Literal, get_args

import numpy as np

from asbuilt.arrays import Array, read_only
from asbuilt.description.model import RobotModel
from asbuilt.dynamics import (
    DriveSet,
    PositionServo,
    gravity_torque,
    inverse_dynamics,
    mass_matrix,
    parameter_names,
)
from asbuilt.errors import MotionError, UsageError
from asbuilt.excitation.motions.motion import Trajectory
from asbuilt.experiment.command.torque import drive_by_command
from asbuilt.experiment.recording import Recording
from asbuilt.experiment.virtual.physics import Physics
from asbuilt.experiment.virtual.sensors import JointFields, PerJoint
from asbuilt.findings import Cure
from asbuilt.ranges import check_choice

FeedForward = Literal["none", "gravity", "full", "exact"]


@dataclass(frozen=True, slots=True, kw_only=True)
class DriveTrain(JointFields):
    """Describe the drives as the physics engine simulates them.

    Every field but `warming` and `warming_time` is one number or one per joint, in units of the
    joint (N m and rad, or N and m).

    Parameters
    ----------
    armature
        Inertia of the rotor at the joint.
    viscous, coulomb
        Viscous and Coulomb friction.
    offset
        Constant torque.
    stiction, stribeck_velocity
        Stribeck friction: `F(v) = coulomb + stiction exp(-(v / stribeck_velocity)^2)`.
    backlash, engagement
        Play of the gear at the joint: the encoder on the motor is ahead of the link by half of it
        at positive torque and behind at negative, smoothly over `engagement` (torque).
    warming, warming_time
        Fraction of all friction lost as the gear warms up, `1 - warming (1 - exp(-t /
        warming_time))` at time t [s].

    Raises
    ------
    UsageError
        If a value is outside its range.
    """

    signed: ClassVar[tuple[str, ...]] = ("offset",)

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
        positive = {name: getattr(self, name) for name in ("stribeck_velocity", "engagement")}
        if not 0.0 <= self.warming < 1.0 or not self.warming_time > 0.0:
            raise UsageError(
                "warming must be from 0 to below 1 and warming_time positive, got"
                f" {self.warming} and {self.warming_time}",
                value=(self.warming, self.warming_time),
            )
        for name, value in positive.items():
            if np.any(np.asarray(value) <= 0.0):
                raise UsageError(f"{name} must be positive, got {value}", value=value, lower=0.0)

    def friction_law(self, n: int) -> Callable[[Array], Array]:
        """Return `F(v) = coulomb + stiction exp(-(v / stribeck_velocity)^2)` of n joints."""
        coulomb = self.of("coulomb", n)
        stiction = self.of("stiction", n)
        velocity = self.of("stribeck_velocity", n)
        return lambda v: coulomb + stiction * np.exp(-((v / velocity) ** 2))

    def warmth(self, t: Array) -> Array:
        """Return the factor of friction at times t [s]."""
        return 1.0 - self.warming * (1.0 - np.exp(-t / self.warming_time))

    def motor_position(self, q: Array, tau: Array) -> Array:
        """Return what the motor encoder measures at link positions q and torques tau (..., n)."""
        n = q.shape[-1]
        return q + 0.5 * self.of("backlash", n) * np.tanh(tau / self.of("engagement", n))


@dataclass(frozen=True, slots=True, eq=False)
class TermDrives:
    """Hold drive terms and their values (n columns_per_joint,), joint by joint."""

    drive: DriveSet
    values: Array

    def __post_init__(self) -> None:
        object.__setattr__(self, "values", read_only(self.values))

    def check(self, model: RobotModel) -> None:
        """Raise `UsageError` unless there is a value for every drive parameter of the robot."""
        expected = self.drive.columns_per_joint * model.n_joints
        if self.values.shape != (expected,):
            raise UsageError(
                f"{model.name} with drive terms {self.drive} has {expected} drive parameters, got"
                f" shape {self.values.shape}",
                value=self.values.shape,
                expected=expected,
            )
        if not np.all(np.isfinite(self.values)):
            k = 10 * model.n_links + int(np.argmin(np.isfinite(self.values)))
            name = parameter_names(model, self.drive)[k]
            raise UsageError(
                f"drive parameter {name} of {model.name} has no value in the description",
                cure=Cure("give the values of the drive terms"),
                parameter=name,
            )


@dataclass(frozen=True, slots=True, kw_only=True)
class PositionController:
    """Describe the position controller, a computed-torque law.

    `tau = feed-forward + M (w^2 (q_command - q) + 2 damping w (qd_command - qd))`.

    M is the mass matrix of the description at the command, armature included, and `w = 2 pi
    bandwidth` [Hz]. The feed-forward is the torque of the described bodies: "none", their
    "gravity", "full", or "exact", which adds rotors and friction as they are. The torque is held
    between two ticks of `rate` [Hz], rounded up to a multiple of the logger's, and limited to the
    joint's torque limit.

    Raises
    ------
    UsageError
        If a value is outside its range.
    """

    logs_torque: ClassVar[bool] = True
    preset_text: ClassVar[str] = "choose another preset"
    fastest: ClassVar[float] = 0.0

    bandwidth: float = 12.0
    damping: float = 1.0
    feedforward: FeedForward = "full"
    rate: float = 1000.0

    def __post_init__(self) -> None:
        positive = {name: getattr(self, name) for name in ("bandwidth", "damping", "rate")}
        for name, value in positive.items():
            if not (np.isfinite(value) and value > 0):
                raise UsageError(
                    f"{name} of the controller must be a positive number, got {value}",
                    value=value,
                    lower=0.0,
                )
        check_choice("feedforward", self.feedforward, get_args(FeedForward))
        if self.bandwidth > self.rate / 20:
            raise UsageError(
                f"the bandwidth of a controller of {self.rate:g} Hz must be at most a twentieth,"
                f" {self.rate / 20:g} Hz, got {self.bandwidth:g} Hz",
                value=self.bandwidth,
                upper=self.rate / 20,
            )

    def log(self, recording: Recording, command: Array, model: RobotModel) -> Recording:
        """Return the recording as it is, of a torque."""
        return recording

    def target(self, command: Trajectory, rate: float) -> Trajectory:
        """Return what the controller follows: the command at its ticks."""
        return command

    def gains(self, described: RobotModel, armature: Array, q: Array) -> tuple[Array, float]:
        """Return stiffness (N, n, n) at positions (N, n), and damping over stiffness [s]."""
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
        armature, viscous, coulomb, offset = (
            train.of(name, command.n_joints)
            for name in ("armature", "viscous", "coulomb", "offset")
        )
        friction = viscous * command.qd + coulomb * np.sign(command.qd) + offset
        return bodies + armature * command.qdd + friction


@dataclass(frozen=True, slots=True, kw_only=True)
class JointServo(JointFields):
    """Describe a servo, `tau = clip(kp (command(t - delay) - q) - kd qd, -limit, limit)`.

    The command is held between two samples of the log, the torque between two ticks of `rate`. The
    limit is the joint's.

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

    logs_torque: ClassVar[bool] = False
    preset_text: ClassVar[str] = "choose the preset servo"
    # Highest frequency that a random motion for it should have [Hz], as the links are light.
    fastest: ClassVar[float] = 1.0

    kp: PerJoint
    kd: PerJoint = 0.0
    delay: float = 0.0
    rate: float = 1000.0

    def __post_init__(self) -> None:
        if not (np.all(np.asarray(self.kp) > 0.0) and np.all(np.asarray(self.kd) >= 0.0)):
            raise UsageError(
                f"kp of a servo must be positive and kd not negative, got {self.kp} and {self.kd}",
                value=(self.kp, self.kd),
                lower=0.0,
            )
        if not (np.isfinite(self.delay) and self.delay >= 0.0):
            raise UsageError(f"delay must not be negative, got {self.delay}", value=self.delay)
        if not (np.isfinite(self.rate) and self.rate > 0.0):
            raise UsageError(f"rate must be positive, got {self.rate}", value=self.rate)

    def log(self, recording: Recording, command: Array, model: RobotModel) -> Recording:
        """Return the recording with the command (N, n) in place of the torque."""
        bare = replace(recording, tau=np.zeros(command.shape), command=command)
        return drive_by_command(bare, self.law(model))

    def target(self, command: Trajectory, rate: float) -> Trajectory:
        """Return the command at the ticks as it arrives: held, delayed, without its velocity.

        `rate` is the rate of the samples [Hz], of which the ticks are a multiple.
        """
        every = round(1.0 / rate / (command.t[1] - command.t[0]))
        # Share of a period by which the time of a tick may be off by rounding.
        sample = np.floor((command.t - self.delay) * rate + 1e-6).astype(int)
        held = command.q[every * np.maximum(sample, 0)]
        return Trajectory(command.t, held, np.zeros(held.shape), np.zeros(held.shape))

    def gains(self, described: RobotModel, armature: Array, q: Array) -> tuple[Array, Array]:
        """Return stiffness (N, n, n) at positions (N, n), and damping over stiffness (n,) [s]."""
        kp, kd = (self.of(name, q.shape[1]) for name in ("kp", "kd"))
        return np.broadcast_to(np.diag(kp), (len(q), *np.diag(kp).shape)), kd / kp

    def feedforward_torque(
        self, described: RobotModel, train: DriveTrain, command: Trajectory
    ) -> Array:
        """Return zero torques (N, n): a servo expects nothing."""
        return np.zeros(command.q.shape)

    def law(self, model: RobotModel) -> PositionServo:
        """Return the servo as a log states it: gains and limits, and a delay that is unknown."""
        kp, kd = (self.of(name, model.n_joints) for name in ("kp", "kd"))
        limits = tuple(joint.limits.torque for joint in model.joints)
        return PositionServo(kp=tuple(kp.tolist()), kd=tuple(kd.tolist()), torque_limit=limits)


CONTROLLERS: Mapping[str, type[PositionController | JointServo]] = {
    "controller": PositionController,
    "servo": JointServo,
}
"""What may follow a motion, of which a robot has one, by the name of its settings."""


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
                q[k] = position
                qd[k] = velocity
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
