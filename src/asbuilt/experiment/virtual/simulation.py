"""Simulations in one call: a recording along a motion, and motion without a controller."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from asbuilt.arrays import Array
from asbuilt.description import LinkInertia, RobotModel, load_robot
from asbuilt.dynamics import (
    DriveSet,
    gravity_torque,
    kinetic_energy,
    parameter_values,
    potential_energy,
)
from asbuilt.errors import InertiaError, UsageError
from asbuilt.excitation import Motion, MotionBounds
from asbuilt.experiment.recording import Recording
from asbuilt.experiment.virtual.drive_train import PositionController
from asbuilt.experiment.virtual.physics import Physics
from asbuilt.experiment.virtual.sensors import PERFECT_SENSORS, SensorNoise
from asbuilt.experiment.virtual.virtual_robot import Seed, VirtualRobot
from asbuilt.findings import Cure


def simulate_recording(
    model: RobotModel | str | Path,
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

    The torque is `tau = inverse_dynamics(q, qd, qdd) + drive terms`; for controlled robots in
    physics, and for the truth behind a recording, see `VirtualRobot`.

    Parameters
    ----------
    model
        The robot, the name of a bundled one, or the path of a description.
    motion
        The motion, followed exactly.
    rate
        Sampling rate [Hz].
    drive
        Drive terms, by default those whose values the description gives.
    drive_values
        Their values (n columns_per_joint,), joint by joint, by default the description's.
    noise
        Sensors, by default perfect ones.
    tool
        Body welded to the last link.
    rng
        Seed or generator of the noise.

    Raises
    ------
    UsageError
        If a drive value is missing or the motion does not fit the robot.

    Examples
    --------
    >>> from asbuilt.description.load import bundled_robot
    >>> from asbuilt.excitation.motions.quintic import QuinticMotion
    >>> motion = QuinticMotion.between([0.0] * 7, [0.5] * 7, duration=2.0)
    >>> simulate_recording(bundled_robot("kuka-iiwa7-r800"), motion, rate=100).tau.shape
    (201, 7)
    """
    model = load_robot(model)
    robot = VirtualRobot.ideal(model)
    if drive is not None:
        known = parameter_values(model, drive)[len(model.parameters) :]
        robot = robot.with_drive(drive, known if drive_values is None else drive_values)
    elif drive_values is not None:
        raise UsageError(
            "drive_values were given without drive, so their meaning is open",
            cure=Cure("give the drive terms too, such as DriveSet.parse('viscous,coulomb')"),
        )
    if tool is not None:
        robot = robot.with_tool(tool)
    return robot.with_noise(noise or PERFECT_SENSORS).record(motion, rng, rate=rate).recording


Release = Literal["drop", "step", "free"]


# Hold how a free motion starts and is integrated.

FREE_MOTION_STEP = 0.2  # Size of a step of each joint [rad]; a quarter of it [m] for sliding joints
# Speed at which a free motion starts, as a fraction of each joint's velocity limit
FREE_MOTION_SPEED = 0.3
FREE_MOTION_LONGEST = 3600.0  # Longest free motion [s]
FREE_MOTION_TIMESTEP = 5e-4  # Step of the integrator [s]
FREE_MOTION_LOGGED = 2  # Steps of the integrator per sample that is kept
# Joint velocity [rad/s or m/s] from which a simulation counts as diverged
FREE_MOTION_DIVERGED = 1e4


STEP_CONTROLLER = PositionController(bandwidth=3.0, feedforward="gravity")
"""The controller of a step: gravity and a pole pair at 3 Hz, according to the model itself."""


@dataclass(frozen=True, slots=True, eq=False)
class FreeMotion:
    """Hold a free motion: `t` and energies [J] (N,), states and torques (N, n).

    `kinetic` includes rotors, `potential` is zero at the start, `work` is done by the drives,
    `dissipated` by friction.
    """

    model: RobotModel
    release: Release
    t: Array
    q: Array
    qd: Array
    tau: Array
    kinetic: Array
    potential: Array
    work: Array
    dissipated: Array

    @property
    def total(self) -> Array:
        """Kinetic and potential energy, shape (N,)."""
        return self.kinetic + self.potential

    @property
    def imbalance(self) -> float:
        """Largest error of the energy balance, relative to the energy turned over.

        The motion is MuJoCo's, the energies follow asbuilt's equations, so this compares
        the two and the integrator.
        """
        missing = self.total - self.total[0] - self.work + self.dissipated
        turnover = np.ptp(self.kinetic) + np.ptp(self.potential)
        return float(
            np.max(np.abs(missing)) / max(turnover, np.max(self.kinetic), np.finfo(float).tiny)
        )


def run_free(
    model: RobotModel,
    release: Release = "drop",
    *,
    duration: float = 3.0,
    start: ArrayLike | None = None,
    speed: ArrayLike | None = None,
) -> FreeMotion:
    """Simulate a robot without its controller, with the armature and friction of its description.

    There are no joint stops.

    Parameters
    ----------
    model
        The robot.
    release
        `"drop"` starts at rest, drives without torque; `"free"` has no friction either and starts
        at 0.3 of the speed limits, so that the energy is constant; `"step"` commands 0.2 rad
        (0.05 m) from a controller with the gravity and mass matrix of this model and its torque
        limits.
    duration
        Duration [s].
    start
        Pose (n,), by default the one of many in which gravity torques are largest.
    speed
        Initial velocity (n,).

    Raises
    ------
    UsageError
        If pose or speed do not fit the robot, or there is no such release.
    InertiaError
        If the mass matrix is not positive definite during the motion, as it may be for inertias
        identified without constraints.

    Examples
    --------
    >>> from asbuilt.description.load import bundled_robot
    >>> run_free(bundled_robot("two-link"), "free", duration=0.5).imbalance < 1e-6
    True
    """
    from scipy.integrate import cumulative_trapezoid  # noqa: PLC0415 - light start

    further = sorted({key for joint in model.joints for key in joint.drive.terms})
    if release not in get_args(Release):
        raise UsageError(
            f"there is no release {release!r}; there are {', '.join(get_args(Release))}"
        )
    if not (np.isfinite(duration) and duration >= 2 * FREE_MOTION_TIMESTEP * FREE_MOTION_LOGGED):
        raise UsageError(f"the duration must be a positive number of seconds, got {duration}")
    if duration > FREE_MOTION_LONGEST:
        raise UsageError(
            f"the duration must be at most {FREE_MOTION_LONGEST:g} s, got {duration:g}"
        )
    if further:
        raise UsageError(
            f"the drives of {model.name} have the terms {', '.join(further)}, which MuJoCo does not"
            " simulate",
            value=further,
        )
    n = model.n_joints
    armature, viscous, coulomb, offset = (
        np.array([getattr(joint.drive, name) or 0.0 for joint in model.joints])
        for name in ("armature", "viscous", "coulomb", "offset")
    )
    if release == "free":
        viscous, coulomb, offset = np.zeros((3, n))
    pose = _check_state(start, n, "start") if start is not None else find_heaviest_pose(model)
    rates = (
        FREE_MOTION_SPEED * MotionBounds.assumed(model).velocity
        if release == "free"
        else np.zeros(n)
    )
    rates = rates if speed is None else _check_state(speed, n, "speed")
    physics = Physics(
        model, armature=armature, viscous=viscous, coulomb=coulomb, timestep=FREE_MOTION_TIMESTEP
    )
    samples = round(duration / (FREE_MOTION_TIMESTEP * FREE_MOTION_LOGGED)) + 1
    t: Array = np.arange(samples, dtype=np.float64) * FREE_MOTION_TIMESTEP * FREE_MOTION_LOGGED
    q, qd, tau = np.empty((3, samples, n))
    goal = pose + _choose_step(model, pose)
    limit = np.array([joint.limits.torque for joint in model.joints])
    physics.start(pose, rates)
    with physics.quiet():
        for k in range(samples):
            q[k], qd[k] = physics.state
            if not np.all(np.abs(qd[k]) < FREE_MOTION_DIVERGED):
                raise InertiaError(
                    f"the simulation of {model.name} diverges at t = {t[k]:.3g} s: its mass matrix"
                    " is not positive definite there",
                    cure=Cure(
                        "identify physically consistent inertias, or give its joints an armature"
                    ),
                    time=float(t[k]),
                )
            tau[k] = (
                np.clip(_evaluate_controller(model, armature, q[k], qd[k], goal), -limit, limit)
                if release == "step"
                else 0.0
            )
            physics.advance(tau[k] - offset, FREE_MOTION_LOGGED)
    ones = np.ones((samples, 1))
    _, friction = physics.accelerations(
        q, qd, tau - offset, coulomb=coulomb * ones, viscous=viscous * ones
    )
    potential = potential_energy(model, q)
    return FreeMotion(
        model=model,
        release=release,
        t=t,
        q=q,
        qd=qd,
        tau=tau,
        kinetic=kinetic_energy(model, q, qd) + 0.5 * qd**2 @ armature,
        potential=potential - potential[0],
        work=np.concatenate([[0.0], np.cumsum(np.sum(tau[:-1] * np.diff(q, axis=0), axis=1))]),
        dissipated=np.asarray(
            cumulative_trapezoid(np.sum((friction + offset) * qd, axis=1), t, initial=0)
        ),
    )


def find_heaviest_pose(model: RobotModel) -> Array:
    """Return the pose of largest gravity torque for its joints' range, out of 512, shape (n,)."""
    bounds = MotionBounds.assumed(model)
    poses = np.random.default_rng(0).uniform(bounds.lower, bounds.upper, (512, model.n_joints))
    poses = np.vstack([0.5 * (bounds.lower + bounds.upper), poses])
    return np.array(poses[int(np.argmax(np.linalg.norm(gravity_torque(model, poses), axis=1)))])


def _evaluate_controller(
    model: RobotModel, armature: Array, q: Array, qd: Array, goal: Array
) -> Array:
    """Return the torque of the step's controller, shape (n,)."""
    stiffness, lead = STEP_CONTROLLER.gains(model, armature, q[None])
    return np.asarray(gravity_torque(model, q) + stiffness[0] @ (goal - q - lead * qd))


def _choose_step(model: RobotModel, pose: Array) -> Array:
    """Return a step of every joint towards the middle of its range, shape (n,)."""
    bounds = MotionBounds.assumed(model)
    size = np.array(
        [FREE_MOTION_STEP if joint.is_revolute else FREE_MOTION_STEP / 4 for joint in model.joints]
    )
    return np.where(pose < 0.5 * (bounds.lower + bounds.upper), size, -size)


def _check_state(values: ArrayLike, n: int, what: str) -> Array:
    state = np.asarray(values, dtype=np.float64)
    if state.shape != (n,) or not np.all(np.isfinite(state)):
        raise UsageError(
            f"{what} must be {n} finite numbers, one per joint, got {np.asarray(values).tolist()}"
        )
    return state
