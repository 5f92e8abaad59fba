"""Whether 95 % intervals cover the truth in 95 % of cases: 200 virtual recordings of each robot, torque noise of several colours."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.signal import lfilter

from asbuilt.description.load import load_robot
from asbuilt.dynamics.base_parameters import find_base_parameters
from asbuilt.dynamics.drives.selection import DriveSet
from asbuilt.excitation.random_motion import random_fourier
from asbuilt.experiment.signal_chain import SignalChain, prepare_samples
from asbuilt.experiment.simulation import InstalledRobot
from asbuilt.identification.identify import design_values
from asbuilt.identification.least_squares import fit_least_squares
from asbuilt.identification.square_root_information import accumulate
from asbuilt.identification.uncertainty import block_uncertainty

REPETITIONS = 200
RATE = 200.0
NOISE = 0.3
NORMAL_95 = 1.959964
STUDIES = (
    ("kuka-iiwa7-r800", 0.2, 20.0),
    ("kuka-iiwa7-r800", 1.0, 60.0),
    ("franka-panda", 0.1, 30.0),
    ("franka-panda", 0.5, 60.0),
    ("ur10e", 0.05, 20.0),
    ("scara", 0.3, 30.0),
    ("puma-560", 0.3, 40.0),
)
"""Robot, correlation time of the torque noise [s], length of the recording [s]."""


def coverage(robot: str, correlation_time: float, duration: float, repetitions: int = REPETITIONS) -> tuple[float, float, float]:
    """Return the share of 95 % intervals that contain the truth, over all parameters: block-robust, the worst parameter's, textbook."""
    model, drive = load_robot(robot), DriveSet.parse("viscous,coulomb,offset")
    base = find_base_parameters(model, drive)
    machine = InstalledRobot.ideal(model).with_drive(drive, np.tile([1.0, 2.0, 0.3], model.n_joints))
    recording = machine.record(random_fourier(model, rng=11, duration=duration, n_harmonics=10), RATE).recording
    recording = replace(recording, qd=None, qdd=None)
    truth, design = base.values(machine.truth), design_values(model, base)
    chain, rng = SignalChain().resolved(recording), np.random.default_rng(0)
    forget, warm_up = np.exp(-1.0 / (RATE * correlation_time)), int(20 * RATE * correlation_time)
    robust, textbook = [], []
    for _ in range(repetitions):
        white = rng.normal(size=(recording.n_samples + warm_up, model.n_joints))
        coloured = lfilter([np.sqrt(1.0 - forget**2)], [1.0, -forget], white, axis=0)[warm_up:]
        samples = prepare_samples(replace(recording, tau=recording.tau + NOISE * coloured), chain)
        information = accumulate(model, base, samples)
        estimate = fit_least_squares(information, weights="joint", prior=design)
        error = np.abs(estimate.beta - truth)
        robust.append(error < NORMAL_95 * block_uncertainty(information, estimate).std_errors)
        textbook.append(error < NORMAL_95 * estimate.std_errors)
    per_parameter = np.mean(robust, axis=0)
    return float(per_parameter.mean()), float(per_parameter.min()), float(np.mean(textbook))


def measure() -> dict[str, float | str]:
    """Return shares."""
    numbers: dict[str, float | str] = {}
    for robot, correlation_time, duration in STUDIES:
        name = f"{robot}_{correlation_time:g}s_noise_{duration:g}s"
        numbers[name], numbers[f"{name}_worst_parameter"], numbers[f"{name}_textbook"] = coverage(robot, correlation_time, duration)
    return numbers
