"""Whether 95 % intervals of drives and delay cover the truth when a command is the torque.

A servo arm and a quadruped that hangs in the air, simulated by MuJoCo under random commands, whose
links differ from their description. The gains of the servo are known, or unknown at the arm, whose
delay alone then is compared: all torques have the scale of CAD.
"""

from __future__ import annotations

import sys
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.formats.mjcf import read_mjcf
from asbuilt.description.model import DriveValues, RobotModel
from asbuilt.dynamics.base.base_parameters import find_base_parameters
from asbuilt.dynamics.drives.drive_set import DriveSet
from asbuilt.dynamics.drives.position_servo import PositionServo
from asbuilt.experiment.command.torque import drive_by_command
from asbuilt.experiment.recording import Recording
from asbuilt.identification.identify import fit_samples
from asbuilt.identification.trajectories.mujoco_engine import simulate_windows
from asbuilt.identification.trajectories.simulated_robot import (
    DriveSignal,
    build_robot_as_described,
)
from asbuilt.identification.trajectories.windows import Windows
from asbuilt.workflow.prepare import prepare
from asbuilt.workflow.servo import settle_servo
from asbuilt.workflow.study_options import StudyOptions

REPETITIONS = 20
RATE, DURATION, DELAY = 100.0, 40.0, 0.008
NOISES = (1e-3, 5e-3)
"""Standard deviations of the noise of positions [rad]. With the smaller one, errors that are
not noise, perhaps of friction at reversals, count."""
STEP = 2.5e-4
"""Step of the simulation [s]."""
DRIVE = DriveSet.parse("armature,viscous,coulomb")
DRIVES = DriveValues(armature=0.02, viscous=0.4, coulomb=0.08)
NORMAL_95 = 1.959964
CAD_ERROR = 0.1
"""Standard deviation of the scale of each link's masses and inertias against CAD."""
WAVES = (0.31, 0.57, 0.93, 1.7)
"""Frequencies of the commands [Hz]."""
KINDS = {"Ia": "armature", "Fv": "damping", "Fc": "friction loss"}
LEG = """<body name="{n}hip" pos="{x} {y} 0"><joint name="{n}hip" axis="1 0 0"/>
<geom type="capsule" size="0.04" fromto="0 0 0 0 {h} 0" mass="0.7"/>
<body name="{n}thigh" pos="0 {h} 0"><joint name="{n}thigh" axis="0 1 0"/>
<geom type="capsule" size="0.03" fromto="0 0 0 0 0 -0.2" mass="1.1"/>
<body name="{n}calf" pos="0 0 -0.2"><joint name="{n}calf" axis="0 1 0"/>
<geom type="capsule" size="0.015" fromto="0 0 0 0 0 -0.2" mass="0.25"/></body></body></body>"""
ARM = """<body name="a"><joint name="pan" axis="0 0 1"/>
<geom type="capsule" size="0.03" fromto="0 0 0 0 0 0.1" mass="0.3"/>
<body name="b" pos="0 0 0.1"><joint name="lift" axis="0 1 0"/>
<geom type="capsule" size="0.02" fromto="0 0 0 0.25 0 0" mass="0.4"/>
<body name="c" pos="0.25 0 0"><joint name="elbow" axis="0 1 0"/>
<geom type="capsule" size="0.02" fromto="0 0 0 0.2 0 0" mass="0.3"/></body></body></body>"""


def measure(
    repetitions: int = REPETITIONS, robots: Sequence[str] = ("arm", "unknown gains", "quadruped")
) -> dict[str, float]:
    """Return the share of intervals that cover the truth, by robot and kind of parameter.

    Beside it the root mean square of errors in standard errors.
    """
    legs = "".join(
        LEG.format(n=f"{x}{y}", x=0.2 * x, y=0.05 * y, h=0.09 * y) for x in (1, -1) for y in (1, -1)
    )
    found: dict[str, float] = {}
    for name, bodies, kp, kd in (
        ("arm", ARM, 15.0, 0.0),
        ("unknown gains", ARM, 30.0, 0.6),
        ("quadruped", legs, 20.0, 1.5),
    ):
        if name not in robots:
            continue
        described = read_mjcf(f'<mujoco model="robot"><worldbody>{bodies}</worldbody></mujoco>')
        known = name != "unknown gains"
        for noise in NOISES:
            errors: dict[str, list[float]] = defaultdict(list)
            for seed in range(repetitions):
                rng = np.random.default_rng(seed)
                for kind, each in _errors(described, kp, kd, noise, rng, known=known).items():
                    errors[kind] += each
            for kind, each in errors.items():
                label = f"{name}, {1e3 * noise:g} mrad, {kind}"
                found[label] = float(np.mean(np.abs(each) < NORMAL_95))
                found[f"{label}, RMS"] = float(np.sqrt(np.mean(np.square(each))))
    return found


def _errors(
    described: RobotModel,
    kp: float,
    kd: float,
    noise: float,
    rng: np.random.Generator,
    *,
    known: bool = True,
) -> dict[str, list[float]]:
    """Return for each kind the errors of one recording's estimates, in standard errors."""
    n = described.n_joints
    scale = np.exp(CAD_ERROR * rng.standard_normal(n))
    chi = (described.parameters.reshape(n, 10) * scale[:, None]).reshape(-1)
    joints = tuple(replace(joint, drive=DRIVES) for joint in described.joints)
    truth = replace(described.with_parameters(chi), joints=joints)
    servo = PositionServo(kp=(kp,) * n, kd=(kd,) * n, delay=DELAY)
    recording = _recorded(truth, servo, noise, rng)
    unknown = (np.nan,) * n
    stated = servo if known else replace(servo, kp=unknown, kd=unknown)
    driven = drive_by_command(recording, replace(stated, delay=None))
    options = StudyOptions(drive=DRIVE, checked=False)
    (item,), _, source, options = settle_servo(described, [driven], [], options)
    found = source.servo
    late = ((found.servo.delay or 0.0) - DELAY) / found.errors.delay
    if not known:
        return {"delay": [late]}
    prepared = prepare(described, [item], chain=options.chain, checked=False, estimate_delay=False)
    training = source.settle_samples(prepared, [item]).training
    base = find_base_parameters(described, DRIVE)
    fit = fit_samples(described, training, base=base, method="auto", expected=source.expected)
    fit = source.with_errors(fit)
    variance = np.diag(fit.uncertainty.covariance).copy()
    variance += 0.0 if fit.errors().delay is None else np.diag(fit.errors().delay.covariance)
    drives = np.tile([DRIVES.armature, DRIVES.viscous, DRIVES.coulomb], n)
    beta = base.regrouping @ np.append(chi, drives)
    off = (fit.estimate.beta - beta) / np.sqrt(variance)
    errors: dict[str, list[float]] = defaultdict(list)
    for parameter, each in zip(base.names, off.tolist(), strict=True):
        if parameter[:2] in KINDS:
            errors[KINDS[parameter[:2]]].append(each)
    errors["delay"].append(late)
    return errors


def _recorded(
    truth: RobotModel, servo: PositionServo, noise: float, rng: np.random.Generator
) -> Recording:
    """Return a recording that MuJoCo simulates, with noise of the positions."""
    n, t = truth.n_joints, np.arange(round(DURATION * RATE)) / RATE
    u = np.zeros((t.size, n))
    for frequency in WAVES:
        size = rng.uniform(0.05, 0.25, n) / np.sqrt(frequency)
        u += size * np.sin(2.0 * np.pi * frequency * t[:, None] + rng.uniform(0.0, 2.0 * np.pi, n))
    q = _simulated(truth, servo, t, u) + noise * rng.standard_normal(u.shape)
    return Recording(
        t=t,
        q=q,
        tau=np.zeros_like(q),
        command=u,
        joint_names=truth.joint_names,
        torque_source="command",
    )


def _simulated(truth: RobotModel, servo: PositionServo, t: Array, u: Array) -> Array:
    """Return the positions of one window as long as the recording, (N, n).

    MuJoCo's steps are early by half a step, and their implicit damping acts as that much more
    armature; without both they are of second order.
    """
    early = 0.5 * STEP
    joints = tuple(
        replace(
            joint,
            drive=replace(
                joint.drive,
                armature=joint.drive.armature - early * (joint.drive.viscous + kd),
            ),
        )
        for joint, kd in zip(truth.joints, servo.kd, strict=True)
    )
    truth = replace(truth, joints=joints)
    servo = replace(servo, delay=servo.delay + early)
    window = Windows(
        "virtual",
        float(t[-1]),
        RATE,
        t[:1],
        u[None],
        u[:1],
        np.zeros_like(u[:1]),
        DriveSignal("command", t, u),
        longest_step=STEP,
    )
    return simulate_windows(build_robot_as_described(truth, servo), window)[0]


if __name__ == "__main__":
    given = [int(sys.argv[1])] if len(sys.argv) > 1 else []
    for kind, share in measure(*given, *([sys.argv[2:]] if len(sys.argv) > 2 else [])).items():
        print(f"{kind:<36} {share:5.2f}" if "RMS" in kind else f"{kind:<36} {100.0 * share:5.1f} %")
