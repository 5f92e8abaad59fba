"""Recording of a described robot along a motion, in one call."""

from __future__ import annotations

from numpy.typing import ArrayLike

from asbuilt.description.inertia import LinkInertia
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.drives.selection import DriveSet
from asbuilt.dynamics.parameters import parameter_values
from asbuilt.errors import UsageError
from asbuilt.excitation.motions.motion import Motion
from asbuilt.experiment.recording import Recording
from asbuilt.experiment.virtual.sensors import PERFECT_SENSORS, SensorNoise
from asbuilt.experiment.virtual.virtual_robot import Seed, VirtualRobot
from asbuilt.findings import Cure


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

    The torque is `tau = inverse_dynamics(q, qd, qdd) + drive terms`; for controlled robots in
    physics, and for the truth behind a recording, see `VirtualRobot`.

    Parameters
    ----------
    model
        The robot.
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
    >>> from asbuilt.description.catalogue import bundled_robot
    >>> from asbuilt.excitation.motions.quintic import QuinticMotion
    >>> motion = QuinticMotion.between([0.0] * 7, [0.5] * 7, duration=2.0)
    >>> simulate_recording(bundled_robot("kuka-iiwa7-r800"), motion, rate=100).tau.shape
    (201, 7)
    """
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
