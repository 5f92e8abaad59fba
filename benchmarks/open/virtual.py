"""Virtual robots with a known truth: their torque is that of Pinocchio's inverse dynamics.

A robot is drawn from a seed: bodies a few percent off the description, friction and rotors, and
with `built` what real robots have and descriptions lack: a base that is not level, a torque that
is logged late, a spring. Logs have encoder counts and noise that is half white, half slow. A
payload is a ball at the flange; the same motion is logged without and with it.
"""

from __future__ import annotations

import sys
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from adapter import Facts
from loops import ClosedChains
from prepare import Array, Problem, loops_of, write_problem
from task import HERE, Task

from asbuilt.description.inertia import LinkInertia
from asbuilt.description.load import load_robot
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.drives.drive_set import DriveSet
from asbuilt.dynamics.parameters import parameter_names
from asbuilt.excitation.motions.fourier import random_fourier
from asbuilt.writers.models.urdf import format_urdf

sys.path.append(str(Path(__file__).resolve().parents[1]))
from outside_robot import OutsideRobot, Sensors, other_bodies, with_body

SECONDS, TEST_SECONDS, RATE, HARMONICS = 30.0, 15.0, 100.0, 9
FRICTION = 0.03
"""Coulomb friction over the torque limit: that of geared arms with joint torque sensors."""
NOISE = 0.004
"""Noise of the torque over its limit."""
TILT, LATE, SPRING = 2.0, 0.004, 0.02
"""Base [deg], delay of the torque [s], torque of the spring over its limit per rad."""
GAIN = 0.05
"""Error of the torque constants of a robot that is weighed with: what makers state of theirs."""
BALL, REACH = 0.06, (0.0, 0.0, 0.08)
"""Radius of a payload and its centre in the frame of the last link [m]."""


def virtual_problems(task: Task, folder: Path) -> list[Problem]:
    """Return one problem for each robot and seed of a task."""
    return [
        _problem(task, name, seed, folder / f"{name}_{seed}")
        for name in task.settings["robots"]
        for seed in range(task.settings["seeds"])
    ]


def _problem(task: Task, name: str, seed: int, folder: Path) -> Problem:
    rng = np.random.default_rng([2027, seed])
    described = HERE / "mechanisms" / f"{name}.toml"
    closed = described.exists()
    cad = load_robot(described) if closed else _as_urdf(load_robot(name), folder)
    robot = _robot(cad, rng, task.settings["built"])
    limits = np.array([joint.limits.torque for joint in cad.joints])
    sensors = Sensors(NOISE * limits, turns=(True,) * cad.n_joints, white=0.5)
    logs = []
    if "mass" in task.settings:
        gains = {k: 1.0 + GAIN * rng.normal() for k in range(cad.n_joints)}
        robot = replace(robot, gain=gains)
        motion = random_fourier(cad, rng=rng, duration=SECONDS, n_harmonics=HARMONICS)
        for each in (robot, carrying(robot, task.settings["mass"])):
            logs.append(each.log(motion, sensors, RATE, rng, torque_source="motor"))
        return write_problem(task, cad, logs[:1], logs[1:], folder)
    for seconds, source in ((SECONDS, "training"), (TEST_SECONDS, "test")):
        motion = random_fourier(cad, rng=rng, duration=seconds, n_harmonics=HARMONICS)
        logs.append(robot.log(motion, sensors, RATE, rng, source=source, torque_source="sensor"))
    drive = DriveSet.parse("viscous,coulomb,offset")
    truth = dict(zip(parameter_names(cad, drive), robot.true_parameters().tolist(), strict=True))
    own = str(described) if closed else ""
    return write_problem(task, cad, logs[:1], logs[1:], folder, truth, own)


def carrying(robot: OutsideRobot, mass: float) -> OutsideRobot:
    """Return a robot with a ball at its flange."""
    ball = LinkInertia.from_com(mass, REACH, 0.4 * mass * BALL**2 * np.eye(3))
    return replace(robot, bodies=with_body(robot.bodies, len(robot.bodies.links) - 1, ball))


@dataclass(frozen=True)
class ClosedRobot(OutsideRobot):
    """A robot with closed chains, its torque by Pinocchio's tree and `loops`."""

    def rigid(self, q: Array, qd: Array, qdd: Array) -> Array:
        """Return the torque of the bodies (N, n) at the motors."""
        with tempfile.TemporaryDirectory() as folder:
            facts = closed_facts(self.bodies, Path(folder), self.gravity)
            return np.asarray(ClosedChains(facts).torque(q, qd, qdd))


def closed_facts(model: RobotModel, folder: Path, gravity: Array) -> Facts:
    """Return what `loops` needs of a robot: its tree as URDF, its loops."""
    tree = model.tree
    bare = tuple(replace(joint, drive=type(joint.drive)()) for joint in tree.joints)
    (folder / "robot.urdf").write_text(format_urdf(replace(tree, joints=bare, frames=())))
    return Facts(
        folder=folder,
        joints=list(model.joint_names),
        tree_joints=list(tree.joint_names),
        tree_links=list(tree.link_names),
        gravity=list(map(float, gravity)),
        cutoff=0.0,
        rate=0.0,
        torque_source="sensor",
        training=[],
        test=[],
        settings={},
        loops=loops_of(model),
    )


def _as_urdf(model: RobotModel, folder: Path) -> RobotModel:
    """Return a robot without drives in the link frames of its URDF, those of the truth."""
    joints = tuple(replace(joint, drive=type(joint.drive)()) for joint in model.joints)
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "cad.urdf"
    path.write_text(format_urdf(replace(model, joints=joints, frames=())))
    return load_robot(path)


def _robot(cad: RobotModel, rng: np.random.Generator, built: bool) -> OutsideRobot:
    limits = np.array([joint.limits.torque for joint in cad.joints])
    n = cad.n_joints
    coulomb = FRICTION * limits * rng.uniform(0.5, 1.5, size=n)
    kind = ClosedRobot if cad.loops else OutsideRobot
    robot = kind(
        other_bodies(cad, rng),
        viscous=coulomb * rng.uniform(0.5, 1.5, size=n),
        coulomb=coulomb,
        offset=rng.normal(scale=0.2, size=n) * coulomb,
        armature=np.zeros(n),
    )
    if not built:
        return robot
    angle = rng.uniform(0.0, 2.0 * np.pi)
    stiffness = SPRING * limits[1]
    return replace(
        robot,
        turn=np.deg2rad(TILT) * np.array([np.cos(angle), np.sin(angle), 0.0]),
        delay=LATE,
        beside={1: lambda q: stiffness * q},
    )
