"""Whether 95 % intervals hold the truth if the model is a little wrong, or the fault is named.

Virtual recordings of three robots with one fault each: Stribeck friction of half the Coulomb
friction that the fit lacks, a base tilted by 0.5 degrees, torque 5 ms late, encoders of 4096
counts; and none. Either the fault is named in 95 % of cases, or intervals hold 93 %.
"""

from __future__ import annotations

import argparse
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from asbuilt.description.load import load_robot
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.drives.selection import DriveSet
from asbuilt.excitation.motions.random_motion import random_fourier
from asbuilt.experiment.recording import Recording
from asbuilt.experiment.virtual.virtual_robot import VirtualRobot
from asbuilt.workflow.options import StudyOptions
from asbuilt.workflow.study import Study, identify

Array = NDArray[np.float64]

ROBOTS = ("kuka-iiwa7-r800", "ur10e", "scara")
FAULTS = ("none", "stribeck", "tilt", "delay", "counts")
METHODS = ("wls", "auto")
REPETITIONS = 40
DURATION, RATE, NOISE, CORRELATION_TIME = 40.0, 200.0, 0.3, 0.1
NORMAL_95 = 1.959964
FITTED = DriveSet.parse("viscous,coulomb,offset")
RICHER = DriveSet.parse("viscous,coulomb,stribeck:velocity=0.1,offset")
TILT, DELAY, COUNTS = np.deg2rad(0.5), 0.005, 4096
NAMED = {
    "none": (),
    "stribeck": ("richer friction", "stribeck"),
    "tilt": ("base tilt", "base seems tilted", "gravity"),
    "delay": ("delay", " late"),
    "counts": ("coarse", "counts", "resolution", "quantum", "steps of"),
}
"""What a finding says that names the fault."""


def machine(model: RobotModel, fault: str) -> VirtualRobot:
    """Return the robot with its fault."""
    if fault == "tilt":
        turned = Rotation.from_rotvec([TILT, 0.0, 0.0]).apply(np.array(model.gravity))
        model = model.with_gravity(turned)
    drive, values = (
        (RICHER, [1.0, 2.0, 1.0, 0.3]) if fault == "stribeck" else (FITTED, [1.0, 2.0, 0.3])
    )
    return VirtualRobot.ideal(model).with_drive(drive, np.tile(values, model.n_joints))


def recorded(model: RobotModel, fault: str, seed: int) -> Recording:
    """Return a recording with coloured noise and what the fault does to it."""
    rng = np.random.default_rng(seed)
    motion = random_fourier(model, rng=rng, duration=DURATION, n_harmonics=5)
    clean = machine(model, fault).record(motion, rate=RATE).recording
    forget, warm_up = np.exp(-1.0 / (RATE * CORRELATION_TIME)), int(20 * RATE * CORRELATION_TIME)
    white = rng.normal(size=(clean.n_samples + warm_up, model.n_joints))
    noise = lfilter([np.sqrt(1.0 - forget**2)], [1.0, -forget], white, axis=0)[warm_up:]
    q, tau = np.array(clean.q), np.array(clean.tau)
    if fault == "delay":
        tau = np.column_stack([np.interp(clean.t - DELAY, clean.t, each) for each in tau.T])
    if fault == "counts":
        step = 2.0 * np.pi / COUNTS
        q = np.where([joint.is_revolute for joint in model.joints], step * np.round(q / step), q)
    return replace(clean, q=q, tau=tau + NOISE * noise, qd=None, qdd=None)


def is_named(study: Study, fault: str) -> bool:
    """Return whether some finding names the fault."""
    return any(
        word in finding.message.lower() for finding in study.findings for word in NAMED[fault]
    )


def measure(repetitions: int = REPETITIONS) -> dict[str, float | str]:
    """Return the share of intervals that hold the truth, of the worst parameter, and of names."""
    numbers: dict[str, float | str] = {}
    for robot in ROBOTS:
        model = load_robot(robot)
        for fault in FAULTS:
            logs = [recorded(model, fault, seed) for seed in range(repetitions)]
            truth = np.tile([1.0, 2.0, 0.3], model.n_joints)
            truth = np.concatenate(
                [np.concatenate([x.inertia.parameters for x in model.links]), truth]
            )
            for method in METHODS:
                options = StudyOptions(drive=FITTED, method=method, checked=False)
                studies = [identify(model, log, options=options) for log in logs]
                held = np.array(
                    [
                        np.abs(each.result.estimates - each.result.base.values(truth))
                        < NORMAL_95 * each.result.std_errors
                        for each in studies
                    ]
                )
                named = np.mean([is_named(study, fault) for study in studies])
                found = {"": held.mean(), "_worst": held.mean(axis=0).min(), "_named": named}
                for kind, value in found.items():
                    numbers[f"{robot}_{fault}_{method}{kind}"] = float(value)
                    print(f"{robot}_{fault}_{method}{kind:<30} {value:.3f}", flush=True)
    return numbers


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("repetitions", nargs="?", type=int, default=REPETITIONS)
    measure(parser.parse_args().repetitions)
