"""A virtual robot as driver: a preset, with effects that the description lacks."""

from __future__ import annotations

import zlib

import numpy as np

from asbuilt import LinkInertia, Recording, UsageError, VirtualRobot
from asbuilt.apps.run.drivers import DRIVERS, DriverRequest
from asbuilt.excitation import Motion
from asbuilt.experiment import with_settings

TILT = 1.0
"""Base tilt about x and y [degrees], from a mounting that was not levelled."""
TOOL = 0.02
"""Mass at the flange as a share of the moving mass: a gripper that nobody put into the CAD."""
TOOL_CENTRE = (0.01, -0.01, 0.06)
"""Centre of that mass in the frame of the last link [m]."""
TOOL_RADIUS = 0.04
"""Radius of gyration of that mass [m]."""


class VirtualDriver:
    """Record a virtual robot.

    Its argument is a preset (`lab`, the default, `factory`, `servo` or `ideal`) and, after further
    commas, settings as of `asbuilt simulate --set`: `lab,backlash=2e-4`. All but `ideal` have a
    base tilt of about a degree and a body at the flange that the description lacks.
    """

    moves_metal = False

    def __init__(self, request: DriverRequest) -> None:
        if request.programs:
            raise UsageError(
                "a virtual robot runs no controller program; leave the programs out, or choose the"
                " driver files:DIR"
            )
        preset, *settings = request.argument.split(",") if request.argument else ["lab"]
        robot = VirtualRobot.preset(preset, request.model, request.seed)
        if preset != "ideal":
            robot = _add_unknown_effects(robot, request.seed)
        self.robot = with_settings(robot, settings)
        self._seed = request.seed

    def record(self, motion: Motion) -> Recording:
        """Follow the motion in MuJoCo and log it."""
        # The noise follows from the motion, so that a loop that is resumed has the same.
        noise = zlib.crc32(np.stack(motion.at(motion.duration / 3)).tobytes())
        return self.robot.record(motion, np.random.default_rng([self._seed, noise])).recording

    def describe(self) -> str:
        """Return preset and engine."""
        return f"virtual robot {self.robot.name!r} on {self.robot.engine}"


def _add_unknown_effects(robot: VirtualRobot, seed: int) -> VirtualRobot:
    """Return the robot with a body at its flange and a base tilt that its description lacks."""
    rng = np.random.default_rng([seed, 1])
    moving = sum(link.inertia.mass for link in robot.model.links)
    inertia = TOOL * moving * TOOL_RADIUS**2 * np.eye(3)
    tool = LinkInertia.from_com(TOOL * moving, TOOL_CENTRE, inertia)
    roll, pitch = np.deg2rad(TILT) * rng.choice([-1.0, 1.0], 2) * rng.uniform(0.7, 1.3, 2)
    return robot.with_tool(tool).tilted(float(roll), float(pitch))


DRIVERS.register("virtual", VirtualDriver)
