"""Virtual robot: follows a motion, in MuJoCo or exactly, and logs it as a real one does."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Literal, cast

import numpy as np
from numpy.typing import ArrayLike

from asbuilt.arrays import Array, read_only
from asbuilt.description import LinkInertia, RobotModel
from asbuilt.dynamics import (
    DriveSet,
    described_drive,
    drive_torque,
    inverse_dynamics,
    parameter_names,
)
from asbuilt.errors import MotionError, UsageError
from asbuilt.excitation.motions.motion import Motion, Trajectory
from asbuilt.experiment.recording import Recording
from asbuilt.experiment.virtual.drive_train import (
    DriveTrain,
    JointServo,
    PositionController,
    TermDrives,
    TrackedMotion,
    track,
)
from asbuilt.experiment.virtual.physics import Physics
from asbuilt.experiment.virtual.presets import (
    FULL_DRIVE,
    Engine,
    build_preset_parts,
    tilt_base,
    with_body,
)
from asbuilt.experiment.virtual.sensors import (
    PERFECT_SENSORS,
    DataLogger,
    SensorNoise,
)
from asbuilt.findings import Cure
from asbuilt.ranges import check_choice

FEWEST_HARMONICS = 5
"""Harmonics of a random motion of any robot, as `random_fourier` has by itself."""
SensedTorque = Literal["sensor", "motor", "current"]
Seed = np.random.Generator | int | None

_FOLLOW = Cure("choose the preset of another engine")
LONGEST_STEP = 1e-3
"""Longest step of the integrator [s]."""


@dataclass(frozen=True, eq=False, repr=False)
class SimulatedRecording:
    """Hold what a virtual robot logged, and the truth behind it.

    Parameters
    ----------
    recording
        What was logged.
    truth, names
        Standard parameters (n_standard,) of the robot that moved, tool, base tilt and drives
        included, and their names.
    model, drive
        That robot and its drive terms.
    settings
        How it was made, as plain numbers and texts.
    """

    recording: Recording
    truth: Array
    names: tuple[str, ...]
    model: RobotModel
    drive: DriveSet
    settings: Mapping[str, Any] = field(default_factory=dict)

    def __repr__(self) -> str:
        return f"SimulatedRecording({self.recording!r}, drive terms {self.drive})"


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class VirtualRobot:
    """Describe a robot to record: bodies, drives, controller, sensors and logger.

    Build one with `ideal`, `typical` or `preset`, and change it with the methods that start with
    `with_` or with `dataclasses.replace`.

    Parameters
    ----------
    model
        The robot as it is, with everything on it.
    described
        What its controller assumes, by default `model`.
    train
        Its drives: a `DriveTrain` in MuJoCo, or `TermDrives`, any drive terms with their values,
        for a robot that follows exactly.
    controller
        What follows the motion in MuJoCo, and says what is logged of it; None for a robot that
        follows it exactly.
    sensors, logger
        What they do to motion and torque.
    torque
        What is logged in MuJoCo: the torque of the "motor", its "current" times the nominal
        constant, or a "sensor" behind the gear, which measures neither the rotor's inertia nor the
        friction in front of it.
    behind
        Share of the friction that such a sensor measures.
    name
        Name of the preset.

    Raises
    ------
    UsageError
        If parts do not fit together or values are outside their range.

    Examples
    --------
    >>> from asbuilt.description.load import bundled_robot
    >>> from asbuilt.excitation.motions.fourier import random_fourier
    >>> model = bundled_robot("ur10e")
    >>> motion = random_fourier(model, rng=2, duration=2.0)
    >>> robot = VirtualRobot.preset("lab", model, rng=1)
    >>> robot
    VirtualRobot(ur10e: 'lab' on mujoco, drive terms viscous,coulomb,offset, torque from sensor)
    >>> robot.record(motion, rng=3).recording.n_samples
    2001
    >>> simulated = VirtualRobot.typical(model, rng=1).record(motion, rate=100.0, rng=3)
    >>> simulated.recording.n_samples, simulated.truth.shape
    (201, (84,))
    """

    model: RobotModel
    described: RobotModel | None = None
    train: DriveTrain | TermDrives = field(default_factory=DriveTrain)
    controller: PositionController | JointServo | None = field(default_factory=PositionController)
    sensors: SensorNoise = PERFECT_SENSORS
    logger: DataLogger = field(default_factory=DataLogger)
    torque: SensedTorque = "motor"
    behind: float = 1.0
    name: str = "custom"

    def __post_init__(self) -> None:
        self.model.require_root("no ground is simulated on which it could stand")
        if self.described is None:
            object.__setattr__(self, "described", self.model)
        elif self.model.joint_names != self.described.joint_names:
            raise UsageError(
                f"{self.model.name} and its description {self.described.name} do not have the same"
                " joints",
                value=self.model.joint_names,
                expected=self.described.joint_names,
            )
        check_choice("torque", self.torque, ("sensor", "motor", "current"))
        if not 0.0 <= self.behind <= 1.0:
            raise UsageError(
                f"the share of friction behind the sensor must be from 0 to 1, got {self.behind}",
                value=self.behind,
                lower=0.0,
                upper=1.0,
            )
        if isinstance(self.train, TermDrives) != (self.controller is None):
            raise UsageError(
                "a robot that follows exactly has drive terms and no controller, one in MuJoCo a"
                " drive train and a controller"
            )
        self.train.check(self.model)
        self.sensors.check(self.model)

    @classmethod
    def ideal(cls, model: RobotModel) -> VirtualRobot:
        """Return the robot of the description, perfect sensors, following motions exactly."""
        return cls.preset("ideal", model, engine="inverse-dynamics")

    @classmethod
    def typical(cls, model: RobotModel, rng: Seed = None) -> VirtualRobot:
        """Return a robot unlike its description in what usually differs, following exactly.

        A gripper of 3 % of the moving mass at the last link, a base tilt of about 0.3 degrees, mass
        distributions 3 % off, armature (about 15 % of the mean joint inertia), viscous, Coulomb and
        offset friction (1.5, 2 and 0.5 % of the torque range, the viscous one at the velocity
        limit) and the further drive terms of the description; 2^16 encoder counts per turn or
        10^5 per metre, torque noise 0.1 %, bias 0.1 % and resolution 0.01 % of the torque range.
        Everything is drawn from `rng`.
        """
        return cls.preset("lab", model, rng, engine="inverse-dynamics")

    @classmethod
    def preset(
        cls,
        name: str,
        model: RobotModel,
        rng: Seed = None,
        *,
        tool: LinkInertia | None = None,
        at: str | None = None,
        engine: Engine = "mujoco",
    ) -> VirtualRobot:
        """Return a robot as in theory, in a laboratory, or in a factory.

        `ideal`: the description, perfect sensors that also log accelerations, a controller with an
        exact feed-forward. `lab`: mass distributions 3 % off; joint torque sensors (noise 0.1 %,
        bias 0.1 %, ripple 0.1 % of the torque range), 2^19 counts per turn, 30 % of the friction
        behind the sensor; rotors, viscous and Coulomb friction of the usual size. `factory`: mass
        distributions 8 % off, a base tilt of about 0.3 degrees; motor currents (noise 1 %, gain
        error 3 %, ripple 0.5 %); 2^16 counts; Stribeck friction, backlash of about 0.5 arc
        minutes, a gear that loses 10 % of its friction as it warms up in 5 minutes, time stamps
        that jitter by 50 us, 0.5 % of the samples lost; 250 Hz. Percentages are of the torque
        range.

        `servo`: mass distributions 8 % off, armature and friction 25 % off the described ones;
        position servos with the gains of the description, 10 ms late; positions of 2^14 counts and
        commands at 200 Hz, and no torque.

        Parameters
        ----------
        name
            `"ideal"`, `"lab"` or, in MuJoCo, `"factory"` or `"servo"`.
        model
            The description.
        rng
            Seed or generator of everything that is drawn.
        tool, at
            Body welded to a link or frame, by default the last link; the controller ignores it.
        engine
            `"mujoco"`, or `"inverse-dynamics"` for a robot that follows exactly: `ideal` and, as
            `lab`, `typical`.

        Raises
        ------
        UsageError
            If there is no such preset, engine, link or frame.
        """
        robot = cls(**build_preset_parts(name, model, engine, np.random.default_rng(rng)))
        return robot if tool is None else robot.with_tool(tool, at)

    def with_tool(self, tool: LinkInertia, at: str | None = None) -> VirtualRobot:
        """Return the robot with a body welded to a link or frame, by default the last link."""
        return replace(self, model=with_body(self.model, tool, at))

    def tilted(self, roll: float, pitch: float) -> VirtualRobot:
        """Return the robot with its base tilted by small angles [rad] about x, then y."""
        return replace(self, model=tilt_base(self.model, roll, pitch))

    def with_drive(self, drive: DriveSet, values: ArrayLike) -> VirtualRobot:
        """Return the robot, following exactly, with drive values (n columns_per_joint,)."""
        return replace(self, train=TermDrives(drive, read_only(values)), controller=None)

    def with_noise(self, sensors: SensorNoise) -> VirtualRobot:
        """Return the robot with other sensors."""
        return replace(self, sensors=sensors)

    def logging(self, rate: float | None) -> VirtualRobot:
        """Return the robot with a logger at `rate` [Hz]; None leaves it as it is."""
        return self if rate is None else replace(self, logger=replace(self.logger, rate=rate))

    @property
    def engine(self) -> Engine:
        """What computes the motion."""
        return "inverse-dynamics" if self.controller is None else "mujoco"

    def count_harmonics(self, duration: float) -> int:
        """Return how many harmonics a random motion of a duration [s] needs to show this robot."""
        fastest = 0.0 if self.controller is None else self.controller.fastest
        return max(FEWEST_HARMONICS, round(fastest * duration))

    @property
    def torque_source(self) -> SensedTorque:
        """What measured the torque that is logged."""
        if isinstance(self.train, TermDrives):
            return "motor" if "armature" in self.train.drive.keys else "sensor"
        return self.torque

    @property
    def drive(self) -> DriveSet:
        """Drive terms that the logged torque contains.

        Of an `ideal` robot in MuJoCo those that its description gives or that are not zero.
        """
        if isinstance(self.train, TermDrives):
            return self.train.drive
        sensed = self.torque == "sensor"  # behind the gear, where the rotor is not
        measured = DriveSet.parse("viscous,coulomb,offset" if sensed else FULL_DRIVE)
        if self.name != "ideal":
            return measured
        n = self.model.n_joints
        described = described_drive(self._described)[0].keys
        acting = {key for key in measured.keys if np.any(self.train.of(key, n))}
        if np.any(np.asarray(self.sensors.torque_bias)):
            acting.add("offset")
        return DriveSet.parse(
            ",".join(key for key in measured.keys if key in described or key in acting) or "none"
        )

    @property
    def drive_values(self) -> Array:
        """Drive parameters that the logged torque contains, shape (n columns_per_joint,)."""
        return self.truth[len(self.model.parameters) :]

    @property
    def truth(self) -> Array:
        """Standard parameters of links and drives, shape (n_standard,).

        Drive parameters are those that the logged torque contains, cold, without gain errors; in
        MuJoCo a sensor's bias is part of the offset.
        """
        if isinstance(self.train, TermDrives):
            return read_only(np.concatenate([self.model.parameters, self.train.values]))
        n = self.model.n_joints
        share = self.behind if self.torque == "sensor" else 1.0
        values = {
            key: self.train.of(key, n) * (1.0 if key == "armature" else share)
            for key in self.drive.keys
        }
        if "offset" in values:
            values["offset"] = values["offset"] + self.sensors.of("torque_bias", n)
        drives = np.stack(list(values.values()), axis=1).ravel() if values else np.empty(0)
        return read_only(np.concatenate([self.model.parameters, drives]))

    def record(
        self,
        motion: Motion,
        rng: Seed = None,
        *,
        rate: float | None = None,
        progress: Callable[[float], None] | None = None,
    ) -> SimulatedRecording:
        """Follow a motion and log it; the same `rng` gives the same recording.

        Parameters
        ----------
        motion
            The command.
        rng
            Seed or generator of sensor noise and logger.
        rate
            Sampling rate of the log [Hz], by default the logger's.
        progress
            Called with the fraction done, in MuJoCo.

        Raises
        ------
        UsageError
            If the motion has another number of joints than the robot.
        MotionError
            If a joint does not follow the command.
        """
        if rate is not None:
            return self.logging(rate).record(motion, rng, progress=progress)
        model = self.model
        if motion.n_joints != model.n_joints:
            raise UsageError(
                f"the motion moves {motion.n_joints} joints, {model.name} has {model.n_joints}:"
                f" {', '.join(model.joint_names)}",
                value=motion.n_joints,
                expected=model.n_joints,
            )
        if motion.duration * self.logger.rate < 1.0:
            raise MotionError(
                f"the motion takes {motion.duration:g} s, in which a log at {self.logger.rate:g} Hz"
                " has no two samples",
                cure=Cure("give a longer motion, or a higher rate"),
                value=motion.duration,
            )
        generator = np.random.default_rng(rng)
        exact = self.controller is None
        move = self._follow_exactly if exact else self._follow_command
        seen, torque, command, note = move(motion, rng, progress)
        logged = self.logger.logged(model, self.sensors, seen, torque, command, generator)
        engine = "" if exact else f", {self.name}"
        commanded = logged.pop("q_command")
        recording = Recording(
            **cast(Any, logged),
            joint_names=model.joint_names,
            source=f"{'simulation of' if exact else 'virtual robot'} {model.name}{engine}",
            torque_source=self.torque_source,
            notes=(note,),
            extra={} if exact else {"q_command": commanded},
        )
        if self.controller is not None:
            recording = self.controller.log(recording, commanded, model)
        names = parameter_names(model, self.drive)
        return SimulatedRecording(
            recording, self.truth, names, model, self.drive, settings=self.settings
        )

    def exact_torque(self, q: Array, qd: Array, qdd: Array) -> Array:
        """Return the torque of a robot that follows exactly, without sensors, shape (N, n)."""
        if not isinstance(self.train, TermDrives):
            raise UsageError("a robot in MuJoCo has no exact torque", cure=_FOLLOW)
        rigid = inverse_dynamics(self.model, q, qd, qdd)
        drive = self.train.drive
        values = self.train.values
        shares = self.model.motor_shares
        return rigid + drive_torque(drive, values, q, qd, qdd, load=rigid, shares=shares)

    def follow(
        self, motion: Motion, *, progress: Callable[[float], None] | None = None
    ) -> tuple[TrackedMotion, Trajectory]:
        """Return the true motion at the controller's ticks and the command, in MuJoCo."""
        model = self.model
        train = self.train
        controller = self.controller
        if controller is None or isinstance(train, TermDrives):
            raise UsageError("a robot without a controller follows motions exactly", cure=_FOLLOW)
        n = model.n_joints
        ticks = self.logger.rate * np.ceil(controller.rate / self.logger.rate - 1e-9)
        command = motion.sample(ticks)
        target = controller.target(command, self.logger.rate)
        substeps = max(1, int(np.ceil(1.0 / (LONGEST_STEP * ticks) - 1e-9)))
        physics = Physics(
            model,
            armature=train.of("armature", n),
            viscous=train.of("viscous", n),
            coulomb=train.of("coulomb", n),
            timestep=1.0 / ticks / substeps,
            springs=True,
        )
        return track(
            physics,
            train,
            target,
            controller.feedforward_torque(self._described, train, target),
            controller.gains(self._described, train.of("armature", n), target.q),
            np.array([joint.limits.torque for joint in model.joints]),
            substeps=substeps,
            progress=progress,
        ), command

    @property
    def settings(self) -> Mapping[str, Any]:
        """Everything but the bodies, as plain numbers and texts."""
        if self.controller is None:
            return {"sensors": asdict(self.sensors)}
        return {
            "preset": self.name,
            "torque": self.torque,
            "behind": self.behind,
            "train": asdict(self.train),
            "controller": asdict(self.controller),
            "sensors": asdict(self.sensors),
            "logger": asdict(self.logger),
        }

    def __repr__(self) -> str:
        return (
            f"VirtualRobot({self.model.name}: {self.name!r} on {self.engine}, drive terms"
            f" {self.drive}, torque from {self.torque_source})"
        )

    @property
    def _described(self) -> RobotModel:
        return self.described or self.model

    def _follow_exactly(
        self, motion: Motion, rng: Seed, progress: Callable[[float], None] | None
    ) -> tuple[Trajectory, Array, Array, str]:
        """Return motion, torque, command and a note of a robot that follows exactly."""
        sampled = motion.sample(self.logger.rate)
        perfect = self.sensors == PERFECT_SENSORS
        how = "noise-free" if perfect else f"with sensor noise, {_describe_seed(rng)}"
        note = (
            f"simulated {how}: {motion.parametrisation} motion of {motion.duration:g} s at"
            f" {self.logger.rate:g} Hz, drive terms {self.drive}"
        )
        return sampled, self.exact_torque(sampled.q, sampled.qd, sampled.qdd), sampled.q, note

    def _follow_command(
        self, motion: Motion, rng: Seed, progress: Callable[[float], None] | None
    ) -> tuple[Trajectory, Array, Array, str]:
        """Return motion at the motor, torque, command and a note of a robot in MuJoCo."""
        assert isinstance(self.train, DriveTrain)
        moved, command = self.follow(motion, progress=progress)
        sensed = self.torque == "sensor"
        torque = moved.rigid + self.behind * moved.friction if sensed else moved.motor
        motor = self.train.motor_position(moved.q, moved.motor)
        assert self.controller is not None
        source = f"torque from the {self.torque}" if self.controller.logs_torque else "no torque"
        note = (
            f"virtual robot {self.name!r} on MuJoCo, {_describe_seed(rng)}:"
            f" {motion.parametrisation}"
            f" motion of {motion.duration:g} s at {self.logger.rate:g} Hz, {source}, largest"
            f" tracking error {np.abs(moved.q - command.q).max():.2g}"
        )
        return Trajectory(moved.t, motor, moved.qd, moved.qdd), torque, command.q, note


def _describe_seed(rng: Seed) -> str:
    return f"seed {rng}" if isinstance(rng, int | np.integer) else "no stated seed"
