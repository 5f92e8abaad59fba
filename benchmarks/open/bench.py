"""A servo on a bench: a pendulum of known mass and length, moved by commands, torque not logged.

The servo is a DC motor behind a position gain, as `vin clip(gain (u - q))` volts, with friction
that grows with its load and is largest at rest. It is integrated here, with a step far below that
of the tools, so that no tool's own simulation is the truth.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import copysign, exp, sin
from pathlib import Path
from typing import Any

import numpy as np
from commanded import write_commanded
from prepare import Array, Problem
from task import Task

from asbuilt.description.load import load_robot
from asbuilt.experiment.recording import Recording

STEP, RATE, SECONDS = 1e-4, 100.0, 8.0
COUNTS = 4096
"""Encoder counts of a turn."""
URDF = """<robot name="bench">
<link name="base"/>
<link name="arm"><inertial><origin xyz="0 0 {centre}"/><mass value="{mass}"/>
<inertia ixx="{inertia}" iyy="{inertia}" izz="1e-6" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="servo" type="revolute"><parent link="base"/><child link="arm"/><axis xyz="1 0 0"/>
<limit lower="-3.1" upper="3.1" velocity="5" effort="14"/></joint></robot>
"""
GRAVITY = 9.80665


@dataclass(frozen=True)
class Servo:
    """Motor constants [V s/rad, ohm], rotor [kg m^2] and friction of a servo of this size."""

    kt: float = 2.1
    resistance: float = 2.2
    rotor: float = 0.022
    friction: float = 0.04
    at_rest: float = 0.11
    slow: float = 0.7
    load_share: float = 0.09
    viscous: float = 0.06

    def moved(self, command: Array, pendulum: dict[str, float]) -> Array:
        """Return positions (N,) at the rate of the log, the command held between samples."""
        mass, arm, length = (pendulum[key] for key in ("load", "arm", "length"))
        inertia = self.rotor + (mass + arm / 3.0) * length**2
        weight = (mass + arm / 2.0) * GRAVITY * length
        gain, volts, most = (pendulum[key] for key in ("gain", "vin", "max_pwm"))
        q, qd, found = float(command[0]), 0.0, []
        for goal in command.tolist():
            found.append(q)
            for _ in range(round(1.0 / RATE / STEP)):
                duty = min(max(gain * (goal - q), -most), most)
                motor = self.kt / self.resistance * (volts * duty - self.kt * qd)
                pull = -weight * sin(q)
                rest = exp(-abs(qd / self.slow))
                most_friction = self.friction + self.at_rest * rest
                most_friction += self.load_share * abs(motor - pull) + self.viscous * abs(qd)
                stop = inertia / STEP * qd + motor + pull
                rubbing = copysign(min(abs(stop), most_friction), stop)
                qd += STEP * (motor + pull - rubbing) / inertia
                q += STEP * qd
        return np.array(found)


def bench_problem(task: Task, folder: Path) -> Problem:
    """Write logs, windows and the description of the bench."""
    folder.mkdir(parents=True, exist_ok=True)
    pendulum, rng = task.settings["pendulum"], np.random.default_rng([2027, task.settings["seed"]])
    mass = pendulum["load"] + pendulum["arm"]
    whole = (pendulum["load"] + pendulum["arm"] / 3.0) * pendulum["length"] ** 2
    centre = (pendulum["load"] + pendulum["arm"] / 2.0) * pendulum["length"] / mass
    inertia = whole - mass * centre**2
    path = folder / "bench.urdf"
    path.write_text(URDF.format(mass=mass, centre=-centre, inertia=inertia))
    described = load_robot(path)
    (joint,) = described.joints
    stated = replace(joint.drive, **task.settings["datasheet"])
    model = replace(described, joints=(replace(joint, drive=stated),))
    logs = [_log(command, pendulum, rng) for command in _commands(rng)]
    return write_commanded(task, model, logs[:3], logs[3:], folder)


def _commands(rng: np.random.Generator) -> list[Array]:
    """Return commands of three motions that are trained on and two others."""
    t = np.arange(0.0, SECONDS, 1.0 / RATE)
    sweep = 0.9 * np.sin(2.0 * np.pi * (0.3 * t + 0.08 * t**2))
    stairs = np.repeat(rng.uniform(-1.3, 1.3, 8), len(t) // 8)
    return [_waves(t, rng, 1.0), sweep, stairs, _waves(t, rng, 1.6), np.roll(stairs[::-1], 50)]


def _waves(t: Array, rng: np.random.Generator, fastest: float) -> Array:
    """Return a sum of five sines up to a frequency [Hz], of at most 1.3 rad."""
    turning = 2.0 * np.pi * np.outer(t, np.linspace(0.2, fastest, 5))
    wave = np.sin(turning + rng.uniform(0.0, 2.0 * np.pi, 5)).sum(axis=1)
    return np.asarray(1.3 * wave / np.abs(wave).max())


def _log(command: Array, pendulum: dict[str, Any], rng: np.random.Generator) -> Recording:
    count = 2.0 * np.pi / COUNTS
    q = count * np.round(Servo().moved(command, pendulum) / count)
    return Recording(
        t=np.arange(len(q)) / RATE,
        q=q[:, None],
        tau=np.zeros((len(q), 1)),
        joint_names=("servo",),
        source="bench",
        command=command[:, None],
    )
