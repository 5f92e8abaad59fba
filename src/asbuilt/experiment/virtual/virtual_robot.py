"""A virtual robot on MuJoCo.

Commanded like a real one, moving like a real one, logged like a real one.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from typing import Any, Literal

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.inertia import LinkInertia
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.drives.selection import DriveSet
from asbuilt.dynamics.drives.torque import described_drive
from asbuilt.dynamics.parameters import parameter_names
from asbuilt.errors import UsageError
from asbuilt.excitation.limits import MotionBounds
from asbuilt.excitation.motions.motion import Motion, Trajectory, read_only
from asbuilt.experiment.recording import Recording
from asbuilt.experiment.virtual.data_logger import DataLogger
from asbuilt.experiment.virtual.drive_train import DriveTrain, PositionController
from asbuilt.experiment.virtual.physics import Physics
from asbuilt.experiment.virtual.sensors import PERFECT_SENSORS, SensorNoise, per_joint
from asbuilt.experiment.virtual.simulation import (
    InstalledRobot,
    Seed,
    SimulatedRecording,
    torque_and_inertia,
    with_body,
)
from asbuilt.experiment.virtual.tracking import TrackedMotion, track

MeasuredTorque = Literal["sensor", "motor", "current"]

FULL_DRIVE = "armature,viscous,coulomb,offset"
LINK_DRIVE = "viscous,coulomb,offset"
PRESETS = ("ideal", "lab", "factory")
LONGEST_STEP = 1e-3
"""Longest step of the integrator [s]."""


@dataclass(frozen=True, eq=False, kw_only=True)
class VirtualRobot:
    """Describe a robot as it stands there.

    What is on it (`model`), what its controller believes (`described`), drives, sensors, logger.

    `torque` says what is logged: what the "motor" gives, its "current" times the nominal constant,
    or a "sensor" behind the gear, which feels neither the rotor's inertia nor the friction in front
    of it; `behind` is the share of the friction that it does feel. Built by `preset` and changed
    with `dataclasses.replace`.

    Examples
    --------
    >>> from asbuilt.description.catalogue import bundled_robot
    >>> from asbuilt.excitation.motions.random_motion import random_fourier
    >>> model = bundled_robot("ur10e")
    >>> robot = VirtualRobot.preset("lab", model, rng=1)
    >>> simulated = robot.record(random_fourier(model, rng=2, duration=2.0), rng=3)
    >>> simulated.recording.torque_source, simulated.drive.keys
    ('sensor', ('viscous', 'coulomb', 'offset'))
    """

    model: RobotModel
    described: RobotModel
    train: DriveTrain = field(default_factory=DriveTrain)
    controller: PositionController = field(default_factory=PositionController)
    sensors: SensorNoise = PERFECT_SENSORS
    logger: DataLogger = field(default_factory=DataLogger)
    torque: MeasuredTorque = "motor"
    behind: float = 1.0
    name: str = "custom"

    def __post_init__(self) -> None:
        if self.model.joint_names != self.described.joint_names:
            raise UsageError(
                f"{self.model.name} and its description {self.described.name} do not have the same"
                " joints"
            )
        if self.torque not in ("sensor", "motor", "current"):
            raise UsageError(f"torque {self.torque!r} is not one of sensor, motor, current")
        if not 0.0 <= self.behind <= 1.0:
            raise UsageError(
                f"the share of friction behind the sensor goes from 0 to 1, got {self.behind}"
            )
        for entry in fields(DriveTrain):
            if entry.name not in ("warming", "warming_time"):
                self.train.of(entry.name, self.model.n_joints)
        self.sensors.check(self.model.n_joints)

    @classmethod
    def preset(
        cls,
        name: str,
        model: RobotModel,
        rng: Seed = None,
        *,
        tool: LinkInertia | None = None,
        at: str | None = None,
    ) -> VirtualRobot:
        """Return a robot of the description as one meets it in theory, in a laboratory, or in a
        factory.

        `ideal`: the description and nothing else, perfect sensors that also log accelerations, a
        controller that knows all. `lab`: mass distributions 3 % off; joint torque sensors (noise
        0.1 %, bias 0.1 %, ripple 0.1 % of the torque range), 2^19 counts per turn, 30 % of the
        friction behind the sensor; rotors, viscous and dry friction of the usual size. `factory`:
        mass distributions 8 % off, a base tilted by about 0.3 degrees; motor currents (noise 1 %,
        gain error 3 %, ripple 0.5 %); 2^16 counts; Stribeck friction, backlash of about 0.5 arc
        minutes, a gear that loses 10 % of its friction as it warms up in 5 minutes, time stamps
        that jitter by 50 us, 0.5 % of the samples lost; 250 Hz. Percentages are of the torque
        range; values are drawn from `rng`.

        `tool` is welded to the link or frame `at`, by default the last link; the controller does
        not know of it.

        Raises
        ------
        UsageError
            If there is no such preset, or no such link or frame.
        """
        if name not in PRESETS:
            raise UsageError(f"there is no virtual robot {name!r}; there are {', '.join(PRESETS)}")
        generator = np.random.default_rng(rng)
        robot = {"ideal": _ideal, "lab": _lab, "factory": _factory}[name](model, generator)
        return robot if tool is None else robot.with_tool(tool, at)

    def with_tool(self, tool: LinkInertia, at: str | None = None) -> VirtualRobot:
        """Return the robot with a body welded to the link or frame `at` (default: the last link),
        given in its axes.
        """
        return replace(self, model=with_body(self.model, tool, at))

    def logging(self, rate: float | None) -> VirtualRobot:
        """Return the robot with a logger at `rate` [Hz]; None leaves it as it is."""
        return self if rate is None else replace(self, logger=replace(self.logger, rate=rate))

    @property
    def drive(self) -> DriveSet:
        """The drive terms that the logged torque contains.

        Of an `ideal` robot those that its description gives or that are not zero.
        """
        felt = DriveSet.parse(LINK_DRIVE if self.torque == "sensor" else FULL_DRIVE)
        if self.name != "ideal":
            return felt
        n, described = self.model.n_joints, described_drive(self.described)[0].keys
        acting = {key for key in felt.keys if np.any(self.train.of(key, n))}
        if np.any(np.asarray(self.sensors.torque_bias)):
            acting.add("offset")
        return DriveSet.parse(
            ",".join(key for key in felt.keys if key in described or key in acting) or "none"
        )

    @property
    def truth(self) -> Array:
        """Standard parameters of links and drives as the logged torque contains them, cold, without
        gain errors; shape (n_standard,).

        A sensor's bias is part of the offset.
        """
        n = self.model.n_joints
        share = self.behind if self.torque == "sensor" else 1.0
        values = {
            key: self.train.of(key, n) * (1.0 if key == "armature" else share)
            for key in self.drive.keys
        }
        if "offset" in values:
            values["offset"] = values["offset"] + per_joint(
                self.sensors.torque_bias, n, "torque_bias", signed=True
            )
        drives = np.stack(list(values.values()), axis=1).ravel() if values else np.empty(0)
        return read_only(np.concatenate([self.model.parameters, drives]))

    def record(
        self, motion: Motion, rng: Seed = None, *, progress: Callable[[float], None] | None = None
    ) -> SimulatedRecording:
        """Command the motion, let the robot follow it in the engine and log it.

        The same `rng` gives the same recording.

        Raises
        ------
        UsageError
            If the motion has another number of joints than the robot.
        MotionError
            If the controller loses the robot.
        """
        if motion.n_joints != self.model.n_joints:
            names = ", ".join(self.model.joint_names)
            raise UsageError(
                f"the motion moves {motion.n_joints} joints, {self.model.name} has"
                f" {self.model.n_joints}: {names}"
            )
        generator = np.random.default_rng(rng)
        moved, command = self.follow(motion, progress=progress)
        torque = {
            "motor": moved.motor,
            "current": moved.motor,
            "sensor": moved.rigid + self.behind * moved.friction,
        }[self.torque]
        at_motor = Trajectory(
            moved.t, self.train.motor_position(moved.q, moved.motor), moved.qd, moved.qdd
        )
        seed = f"seed {rng}" if isinstance(rng, int | np.integer) else "no stated seed"
        note = (
            f"virtual robot {self.name!r} on MuJoCo, {seed}: {motion.parametrisation} motion of"
            f" {motion.duration:g} s at {self.logger.rate:g} Hz, torque from the {self.torque},"
            f" largest tracking error {np.abs(moved.q - command.q).max():.2g}"
        )
        logged = self.logger.logged(
            self.model, self.sensors, at_motor, torque, command.q, generator
        )
        recording = Recording(
            t=logged.t,
            q=logged.q,
            tau=logged.tau,
            qd=logged.qd,
            qdd=logged.qdd,
            joint_names=self.model.joint_names,
            source=f"virtual robot {self.model.name}, {self.name}",
            torque_source=self.torque,
            notes=(note,),
            extra={"q_command": logged.q_command},
        )
        return SimulatedRecording(
            recording,
            self.truth,
            parameter_names(self.model, self.drive),
            self.model,
            self.drive,
            settings=self.settings,
        )

    def follow(
        self, motion: Motion, *, progress: Callable[[float], None] | None = None
    ) -> tuple[TrackedMotion, Trajectory]:
        """Return what the robot really does at the controller's ticks, and what it was told to do."""
        model, train, controller = self.model, self.train, self.controller
        n = model.n_joints
        ticks = self.logger.rate * np.ceil(controller.rate / self.logger.rate - 1e-9)
        command = motion.sample(ticks)
        substeps = max(1, int(np.ceil(1.0 / (LONGEST_STEP * ticks) - 1e-9)))
        physics = Physics(
            model,
            armature=train.of("armature", n),
            viscous=train.of("viscous", n),
            coulomb=train.of("coulomb", n),
            timestep=1.0 / ticks / substeps,
        )
        gains = controller.gains(self.described, train.of("armature", n), command.q)
        feedforward = controller.feedforward_torque(self.described, train, command)
        limit = np.array([joint.limits.torque for joint in model.joints])
        return (
            track(
                physics,
                train,
                command,
                feedforward,
                gains,
                limit,
                substeps=substeps,
                progress=progress,
            ),
            command,
        )

    @property
    def settings(self) -> Mapping[str, Any]:
        """Everything but the bodies, as plain numbers and texts."""
        return {
            "preset": self.name,
            "torque": self.torque,
            "behind": self.behind,
            "train": asdict(self.train),
            "controller": asdict(self.controller),
            "sensors": asdict(self.sensors),
            "logger": asdict(self.logger),
        }


def _ideal(model: RobotModel, rng: np.random.Generator) -> VirtualRobot:
    drive, values = described_drive(model)
    further = [key for key in drive.keys if key not in FULL_DRIVE.split(",")]
    if further:
        raise UsageError(
            f"the drives of {model.name} have {', '.join(further)}, which the engine does not know;"
            " simulate with --engine inverse-dynamics, which has all terms"
        )
    columns = np.reshape(values, (model.n_joints, -1)).T
    stated = {key: _numbers(column) for key, column in zip(drive.keys, columns, strict=True)}
    armature, viscous, coulomb, offset = (
        stated.get(key, 0.0) for key in DriveSet.parse(FULL_DRIVE).keys
    )
    train = DriveTrain(armature=armature, viscous=viscous, coulomb=coulomb, offset=offset)
    return VirtualRobot(
        model=model,
        described=model,
        train=train,
        controller=PositionController(feedforward="exact"),
        logger=DataLogger(accelerations=True),
        name="ideal",
    )


def _lab(model: RobotModel, rng: np.random.Generator) -> VirtualRobot:
    torque, _ = torque_and_inertia(model, rng)
    train = _drive_train(model, rng)
    sensors = SensorNoise(
        encoder_counts=_counts(model, 2**19),
        torque_noise=_numbers(1e-3 * torque),
        torque_bias=_numbers(1e-3 * torque * rng.normal(size=model.n_joints)),
        torque_ripple=_numbers(1e-3 * torque),
        torque_resolution=_numbers(1e-4 * torque),
    )
    built = InstalledRobot(model).with_perturbed_links(0.03, rng).model
    sensors = replace(sensors, ripple_phase=_numbers(rng.uniform(0.0, 2 * np.pi, model.n_joints)))
    return VirtualRobot(
        model=built,
        described=model,
        train=train,
        sensors=sensors,
        torque="sensor",
        behind=0.3,
        name="lab",
    )


def _factory(model: RobotModel, rng: np.random.Generator) -> VirtualRobot:
    n = model.n_joints
    torque, _ = torque_and_inertia(model, rng)
    speed = MotionBounds.assumed(model).velocity
    train = replace(
        _drive_train(model, rng),
        stiction=_numbers(0.01 * torque * rng.uniform(0.5, 1.5, n)),
        stribeck_velocity=_numbers(0.02 * speed),
        backlash=tuple(
            1.5e-4 * float(x) if joint.is_revolute else 2e-5
            for joint, x in zip(model.joints, rng.uniform(0.5, 1.5, n), strict=True)
        ),
        engagement=_numbers(0.01 * torque),
        warming=0.1,
        warming_time=300.0,
    )
    sensors = SensorNoise(
        encoder_counts=_counts(model, 2**16),
        torque_noise=_numbers(1e-2 * torque),
        torque_gain=_numbers(1.0 + 0.03 * rng.normal(size=n)),
        torque_ripple=_numbers(5e-3 * torque),
        torque_resolution=_numbers(1e-3 * torque),
    )
    tilt = np.deg2rad(rng.normal(scale=0.3, size=2))
    built = (
        InstalledRobot(model)
        .with_perturbed_links(0.08, rng)
        .tilted(float(tilt[0]), float(tilt[1]))
        .model
    )
    sensors = replace(sensors, ripple_phase=_numbers(rng.uniform(0.0, 2 * np.pi, n)))
    logger = DataLogger(rate=250.0, clock_jitter=5e-5, dropped=0.005)
    controller = PositionController(feedforward="gravity", bandwidth=15.0)
    return VirtualRobot(
        model=built,
        described=model,
        train=train,
        sensors=sensors,
        logger=logger,
        controller=controller,
        torque="current",
        name="factory",
    )


def _drive_train(model: RobotModel, rng: np.random.Generator) -> DriveTrain:
    """Return drives of the usual size for the torque range of each joint.

    A rotor that the whole range speeds up by 200 rad/s^2 (or 200 m/s^2); 1.5 % viscous friction at
    top speed, 2 % Coulomb, 0.5 % offset.
    """
    torque, _ = torque_and_inertia(model, rng)
    spread = rng.uniform(0.5, 1.5, size=(4, model.n_joints))
    signs = rng.choice([-1.0, 1.0], size=model.n_joints)
    speed = MotionBounds.assumed(model).velocity
    values = (
        np.stack([0.005 * torque, 0.015 * torque / speed, 0.02 * torque, 0.005 * torque * signs])
        * spread
    )
    armature, viscous, coulomb, offset = (_numbers(row) for row in values)
    return DriveTrain(armature=armature, viscous=viscous, coulomb=coulomb, offset=offset)


def _counts(model: RobotModel, per_turn: int) -> tuple[float, ...]:
    """Return encoder counts per turn, or per metre for sliding joints."""
    return tuple(float(per_turn) if joint.is_revolute else 2.0 * per_turn for joint in model.joints)


def _numbers(values: Array) -> tuple[float, ...]:
    return tuple(float(value) for value in values)
