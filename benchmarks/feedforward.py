"""What feed-forward of the identified model buys: tracking error in closed loop, in MuJoCo.

A virtual robot (preset `lab`, torque of the motor) is recorded and identified; the same position
controller then follows another motion with the torque of CAD, and of the robot as built, as
feed-forward.

    python benchmarks/feedforward.py
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.load import bundled_robot
from asbuilt.dynamics.newton_euler import gravity_torque, inverse_dynamics
from asbuilt.excitation.motions.fourier import random_fourier
from asbuilt.excitation.motions.motion import Trajectory
from asbuilt.experiment.virtual.drive_train import DriveTrain, PositionController, track
from asbuilt.experiment.virtual.physics import Physics
from asbuilt.experiment.virtual.virtual_robot import VirtualRobot
from asbuilt.workflow.study import identify
from asbuilt.workflow.study_options import StudyOptions

ROBOTS = ("kuka-iiwa7-r800", "ur10e", "franka-panda")
BANDWIDTH = 4.0
"""Bandwidth of the controller [Hz]: soft, as of a robot among people."""
TICKS = 1000.0


def tracking_error(robot: VirtualRobot, command: Trajectory, feedforward: Array) -> Array:
    """Return the position error (N, n) [rad] under a feed-forward torque (N, n)."""
    train, n = robot.train, robot.model.n_joints
    assert isinstance(train, DriveTrain)
    assert robot.described is not None
    physics = Physics(
        robot.model,
        armature=train.of("armature", n),
        viscous=train.of("viscous", n),
        coulomb=train.of("coulomb", n),
        timestep=1.0 / TICKS,
    )
    controller = PositionController(bandwidth=BANDWIDTH)
    gains = controller.gains(robot.described, train.of("armature", n), command.q)
    limits = np.array([joint.limits.torque for joint in robot.model.joints])
    moved = track(physics, train, command, feedforward, gains, limits)
    error: Array = moved.q - command.q
    return error


def main() -> None:
    """Print a row per robot."""
    print(f"RMS tracking error over all joints [mrad], controller of {BANDWIDTH:g} Hz")
    print("robot                 gravity (CAD)   CAD   as built   CAD / as built")
    for seed, name in enumerate(ROBOTS):
        model = bundled_robot(name)
        robot = replace(VirtualRobot.preset("lab", model, rng=seed), torque="motor")
        log = robot.record(random_fourier(model, rng=seed, duration=20.0), rng=seed).recording
        drive = "armature,viscous,coulomb,offset"
        result = identify(model, log, options=StudyOptions(drive=drive)).result
        command = random_fourier(model, rng=100 + seed, duration=10.0).sample(TICKS)
        state = (command.q, command.qd, command.qdd)
        torques = (
            gravity_torque(model, command.q),
            inverse_dynamics(model, *state),
            result.torque(*state),
        )
        errors = [
            1e3 * float(np.sqrt(np.mean(tracking_error(robot, command, each) ** 2)))
            for each in torques
        ]
        print(
            f"{name:20s} {errors[0]:14.2f} {errors[1]:6.2f} {errors[2]:10.2f}"
            f" {errors[1] / errors[2]:16.1f}",
            flush=True,
        )


if __name__ == "__main__":
    main()
