"""A virtual robot: what the arm on the shop floor would have logged along a motion."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from asbuilt.arrays import Array
from asbuilt.description.inertia import LinkInertia
from asbuilt.description.model import ROOT, RobotModel
from asbuilt.description.rotation import rotation_from_rpy
from asbuilt.dynamics.drives.selection import NO_DRIVE, DriveSet
from asbuilt.dynamics.drives.torque import described_drive, drive_torque
from asbuilt.dynamics.newton_euler import inverse_dynamics, mass_matrix
from asbuilt.dynamics.parameters import parameter_names, parameter_values
from asbuilt.errors import UsageError
from asbuilt.excitation.limits import MotionBounds
from asbuilt.excitation.motions.motion import Motion, read_only
from asbuilt.experiment.recording import Recording
from asbuilt.experiment.virtual.sensors import PERFECT_SENSORS, SensorNoise

Seed = np.random.Generator | int | None


@dataclass(frozen=True, eq=False)
class SimulatedRecording:
    """Hold what a virtual robot logged, and the truth behind it.

    `truth` (n_standard,) are the parameters `names` of the robot that moved, tool, mounting and
    drives included; `model` and `drive` are that robot's.
    """

    recording: Recording
    truth: Array
    names: tuple[str, ...]
    model: RobotModel
    drive: DriveSet
    settings: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class InstalledRobot:
    """Describe the robot as it stands on the floor.

    `model` with everything on it, its drives and its sensors.

    `drive_values` (n columns_per_joint,) belong to `drive`, joint by joint. Built from a
    description by `ideal` or `typical` and changed with the methods that start with `with_`; each
    returns another robot.

    Examples
    --------
    >>> from asbuilt.description.catalogue import bundled_robot
    >>> from asbuilt.excitation.motions.random_motion import random_fourier
    >>> model = bundled_robot("kuka-iiwa7-r800")
    >>> robot = InstalledRobot.typical(model, rng=1)
    >>> simulated = robot.record(random_fourier(model, rng=2, duration=2.0), rate=100, rng=3)
    >>> simulated.recording.n_samples, simulated.truth.shape, robot.drive.keys
    (201, (98,), ('armature', 'viscous', 'coulomb', 'offset'))
    """

    model: RobotModel
    drive: DriveSet = NO_DRIVE
    drive_values: Array | tuple[float, ...] = ()
    noise: SensorNoise = PERFECT_SENSORS

    def __post_init__(self) -> None:
        values = read_only(self.drive_values)
        expected = self.drive.columns_per_joint * self.model.n_joints
        if values.shape != (expected,):
            raise UsageError(
                f"{self.model.name} with drive terms {self.drive} has {expected} drive parameters,"
                f" got shape {values.shape}"
            )
        if not np.all(np.isfinite(values)):
            name = parameter_names(self.model, self.drive)[
                10 * self.model.n_joints + int(np.argmin(np.isfinite(values)))
            ]
            raise UsageError(
                f"drive parameter {name} of {self.model.name} has no value; the description is"
                " silent: give drive_values"
            )
        object.__setattr__(self, "drive_values", values)

    @classmethod
    def ideal(cls, model: RobotModel) -> InstalledRobot:
        """Return the robot of the description, with the drive values that it gives and perfect
        sensors.
        """
        drive, values = described_drive(model)
        return cls(model, drive, values)

    @classmethod
    def typical(cls, model: RobotModel, rng: Seed = None) -> InstalledRobot:
        """Return the robot as one finds it.

        Other than its description in everything that usually differs.

        A gripper of 3 % of the moving mass at the last link, the base tilted by about 0.3 degrees,
        mass distributions off by about 3 %, armature (about 15 % of the mean joint inertia),
        viscous, Coulomb and offset friction (1.5, 2 and 0.5 % of the torque range, the viscous one
        at the velocity limit), beside further drive terms of the description, such as those of
        coupled motors, as they stand; and sensors: 2^16 counts per turn or 10^5 per metre, torque
        noise 0.1 %, bias 0.1 % and resolution 0.01 % of the torque range. Everything is drawn from
        `rng`.
        """
        generator = np.random.default_rng(rng)
        n = model.n_joints
        bounds = MotionBounds.assumed(model)
        torque, inertia = torque_and_inertia(model, generator)
        spread = generator.uniform(0.5, 1.5, size=(4, n))
        signs = generator.choice([-1.0, 1.0], size=n)
        values = (
            np.stack(
                [
                    0.15 * inertia,
                    0.015 * torque / bounds.velocity,
                    0.02 * torque,
                    0.005 * torque * signs,
                ]
            )
            * spread
        )
        noise = SensorNoise(
            encoder_counts=tuple(2.0**16 if joint.is_revolute else 1e5 for joint in model.joints),
            torque_noise=tuple((1e-3 * torque).tolist()),
            torque_bias=tuple((1e-3 * torque * generator.normal(size=n)).tolist()),
            torque_resolution=tuple((1e-4 * torque).tolist()),
        )
        mass = 0.03 * sum(link.inertia.mass for link in model.links)
        gripper = LinkInertia.from_com(
            mass,
            np.array([0.0, 0.0, 0.06]) + generator.normal(scale=0.02, size=3),
            np.diag([1.0, 1.0, 0.5]) * mass * 0.05**2,
        )
        robot = cls(
            model,
            *_beside_described(model, DriveSet.parse("armature,viscous,coulomb,offset"), values.T),
            noise,
        )
        tilt = np.deg2rad(generator.normal(scale=0.3, size=2))
        return (
            robot.with_perturbed_links(0.03, generator)
            .with_tool(gripper)
            .tilted(float(tilt[0]), float(tilt[1]))
        )

    def with_tool(self, tool: LinkInertia, at: str | None = None) -> InstalledRobot:
        """Return the robot with a body welded to a link or frame `at`, given in its axes.

        To the last link where none is named.

        Raises
        ------
        UsageError
            If the robot has no moving link or frame of that name.
        """
        return replace(self, model=with_body(self.model, tool, at))

    def with_perturbed_links(self, fraction: float, rng: Seed = None) -> InstalledRobot:
        """Return the robot with other mass distributions.

        Every link stretched, sheared, shifted and made heavier by about `fraction`.

        The pseudo-inertia becomes `s A J A^T` with `s = exp(fraction N)`, `A = [[1 + fraction N /
        2, fraction r N / 2], [0, 1]]`, r the radius of gyration; a consistent link stays
        consistent, since congruence keeps J positive definite (Wensing et al. 2018).
        """
        generator = np.random.default_rng(rng)
        links = []
        for link in self.model.links:
            J = link.inertia.pseudo_inertia
            radius = np.sqrt(max(np.trace(J[:3, :3]), 0.0) / J[3, 3]) if J[3, 3] > 0 else 0.0
            A = np.eye(4)
            A[:3, :3] += fraction / 2 * generator.normal(size=(3, 3))
            A[:3, 3] = fraction / 2 * radius * generator.normal(size=3)
            heavier = np.exp(fraction * generator.normal())
            links.append(
                replace(
                    link, inertia=LinkInertia.from_pseudo_inertia(heavier * A @ J @ A.T), parts=()
                )
            )
        return replace(self, model=replace(self.model, links=tuple(links)))

    def tilted(self, roll: float, pitch: float) -> InstalledRobot:
        """Return the robot mounted askew.

        Its root turned by small angles [rad] about x, then y, so that gravity comes from elsewhere.
        """
        gravity = rotation_from_rpy([roll, pitch, 0.0]).T @ self.model.gravity
        return replace(self, model=self.model.with_gravity(gravity))

    def with_drive(self, drive: DriveSet, values: ArrayLike) -> InstalledRobot:
        """Return the robot with other drives; `values` (n columns_per_joint,) joint by joint."""
        return replace(self, drive=drive, drive_values=read_only(values))

    def with_noise(self, noise: SensorNoise) -> InstalledRobot:
        """Return the robot with other sensors."""
        return replace(self, noise=noise)

    @property
    def truth(self) -> Array:
        """Standard parameters of links and drives, shape (n_standard,)."""
        return read_only(np.concatenate([self.model.parameters, np.asarray(self.drive_values)]))

    def torque(self, q: Array, qd: Array, qdd: Array) -> Array:
        """Return the torque that the motion takes, rigid bodies and drives, without any sensor.

        Shape (N, n).
        """
        rigid = inverse_dynamics(self.model, q, qd, qdd)
        return rigid + drive_torque(
            self.drive, self.drive_values, q, qd, qdd, load=rigid, shares=self.model.motor_shares
        )

    def record(self, motion: Motion, rate: float = 1000.0, rng: Seed = None) -> SimulatedRecording:
        """Move along `motion` exactly and log it at `rate` [Hz] with the robot's sensors.

        The same `rng` gives the same recording.

        With perfect sensors velocities and accelerations are logged too; a real robot's are left
        out, see `SensorNoise`.

        Raises
        ------
        UsageError
            If the motion has another number of joints than the robot.
        """
        n = self.model.n_joints
        if motion.n_joints != n:
            raise UsageError(
                f"the motion moves {motion.n_joints} joints, {self.model.name} has {n}:"
                f" {', '.join(self.model.joint_names)}"
            )
        sampled = motion.sample(rate)
        tau = self.torque(sampled.q, sampled.qd, sampled.qdd)
        seed = f"seed {rng}" if isinstance(rng, int | np.integer) else "no stated seed"
        perfect = self.noise == PERFECT_SENSORS
        how = "noise-free" if perfect else f"with sensor noise, {seed}"
        logged = (
            (sampled.q, sampled.qd, tau)
            if perfect
            else self.noise.measured(self.model, sampled, tau, np.random.default_rng(rng))
        )
        q, qd, tau = logged
        recording = Recording(
            t=sampled.t,
            q=q,
            tau=tau,
            qd=qd,
            qdd=sampled.qdd if perfect else None,
            joint_names=self.model.joint_names,
            source=f"simulation of {self.model.name}",
            torque_source="motor" if "armature" in self.drive.keys else "sensor",
            notes=(
                (
                    f"simulated {how}: {motion.parametrisation} motion of {motion.duration:g} s at"
                    f" {rate:g} Hz, drive terms {self.drive}"
                ),
            ),
        )
        names = parameter_names(self.model, self.drive)
        return SimulatedRecording(
            recording,
            self.truth,
            names,
            self.model,
            self.drive,
            settings={"sensors": asdict(self.noise)},
        )


def with_body(model: RobotModel, body: LinkInertia, at: str | None = None) -> RobotModel:
    """Return the robot with a body welded to a link or frame `at`, given in its axes.

    To the last link where none is named.

    Raises
    ------
    UsageError
        If the robot has no moving link or frame of that name.
    """
    index, placement = _flange(model, at)
    link, carried = model.links[index], body.moved(placement)
    links = list(model.links)
    links[index] = replace(
        link,
        inertia=link.inertia + carried,
        parts=(*(link.parts or ((link.name, link.inertia),)), ("tool", carried)),
    )
    return replace(model, links=tuple(links))


def _flange(model: RobotModel, at: str | None) -> tuple[int, Array]:
    if at is None:
        return model.n_joints - 1, np.eye(4)
    if at in model.link_names:
        return model.link_names.index(at), np.eye(4)
    for frame in model.frames:
        if frame.name == at and frame.link != ROOT:
            return frame.link, frame.placement
    names = [*model.link_names, *(frame.name for frame in model.frames if frame.link != ROOT)]
    raise UsageError(
        f"{model.name} has no moving link or frame {at!r} to carry a tool; it has"
        f" {', '.join(names)}"
    )


def simulate_recording(
    model: RobotModel,
    motion: Motion,
    *,
    rate: float = 1000.0,
    drive: DriveSet | None = None,
    drive_values: ArrayLike | None = None,
    noise: SensorNoise | None = None,
    tool: LinkInertia | None = None,
    rng: Seed = None,
) -> Recording:
    """Return what the robot of a description logs along a motion.

    `tau = inverse_dynamics(q, qd, qdd) + drive terms`, noise-free by default.

    Without `drive` the drive terms are those whose values the description gives; with it,
    `drive_values` (n columns_per_joint,) are needed unless the description has them all. `tool` is
    welded to the last link. For more, and for the truth, see `InstalledRobot`.

    Raises
    ------
    UsageError
        If a drive value is missing or the motion does not fit the robot.

    Examples
    --------
    >>> from asbuilt.description.catalogue import bundled_robot
    >>> from asbuilt.excitation.motions.quintic import QuinticMotion
    >>> motion = QuinticMotion.between([0.0] * 7, [0.5] * 7, duration=2.0)
    >>> simulate_recording(bundled_robot("kuka-iiwa7-r800"), motion, rate=100).tau.shape
    (201, 7)
    """
    robot = InstalledRobot.ideal(model)
    if drive is not None:
        known = parameter_values(model, drive)[len(model.parameters) :]
        robot = robot.with_drive(drive, known if drive_values is None else drive_values)
    elif drive_values is not None:
        raise UsageError(
            "drive_values were given without drive, so it is open what they mean; pass e.g."
            " drive=DriveSet.parse('viscous,coulomb')"
        )
    if tool is not None:
        robot = robot.with_tool(tool)
    return robot.with_noise(noise or PERFECT_SENSORS).record(motion, rate, rng).recording


def torque_and_inertia(model: RobotModel, rng: np.random.Generator) -> tuple[Array, Array]:
    """Return the torque range of each joint (its limit, or the largest at random states) and its
    mean inertia, two (n,).
    """
    bounds = MotionBounds.assumed(model)
    low = np.stack([bounds.lower, -bounds.velocity, -bounds.acceleration])
    high = np.stack([bounds.upper, bounds.velocity, bounds.acceleration])
    q, qd, qdd = (rng.uniform(low[k], high[k], size=(64, model.n_joints)) for k in range(3))
    largest = np.max(np.abs(inverse_dynamics(model, q, qd, qdd)), axis=0)
    inertia = np.mean(np.diagonal(mass_matrix(model, q), axis1=1, axis2=2), axis=0)
    return np.where(np.isfinite(bounds.torque), bounds.torque, np.maximum(largest, 1.0)), inertia


def _beside_described(model: RobotModel, drive: DriveSet, values: Array) -> tuple[DriveSet, Array]:
    """Return drive terms with those others that the description has, and their values joint by
    joint; `values` (n, columns_per_joint) are those of `drive`.
    """
    described, stated = described_drive(model)
    whole = DriveSet((*drive.terms, *described.without(*drive.keys).terms))
    n = model.n_joints
    known = [dict(zip(described.symbols, row, strict=True)) for row in stated.reshape(n, -1)]
    known = [
        have | dict(zip(drive.symbols, row, strict=True))
        for have, row in zip(known, values, strict=True)
    ]
    return whole, np.array([[have[symbol] for symbol in whole.symbols] for have in known]).ravel()
