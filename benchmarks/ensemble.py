"""Whether the truth's motion lies in an ensemble's 90 % band in 90 % of windows.

200 virtual studies of each robot: the robot differs from CAD, its torque is recorded with coloured
noise, and 39 robots are drawn from the result. Truth and ensemble are then simulated by MuJoCo over
the same windows under the same torques. A window is inside where the
true position of a joint at its end lies between the 5 and 95 % quantiles of the ensemble.

    python benchmarks/ensemble.py [STUDIES [ROBOT]]
"""

from __future__ import annotations

import sys
import time
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from asbuilt.description.load import load_robot
from asbuilt.description.model import DriveValues, RobotModel
from asbuilt.dynamics.base.base_parameters import find_base_parameters
from asbuilt.dynamics.drives.drive_set import DriveSet
from asbuilt.excitation.motions.fourier import random_fourier
from asbuilt.experiment.recording import Recording
from asbuilt.experiment.signal.preparation import prepare_samples, resolve_chain
from asbuilt.experiment.signal.signal_chain import SignalChain
from asbuilt.experiment.virtual.presets import perturb_links
from asbuilt.experiment.virtual.virtual_robot import VirtualRobot
from asbuilt.identification.ensembles.ensemble import Ensemble, draw_ensemble
from asbuilt.identification.identify import identify_samples
from asbuilt.identification.trajectories.mujoco_engine import simulate_windows
from asbuilt.identification.trajectories.simulated_robot import DriveSignal, SimulatedRobot
from asbuilt.identification.trajectories.windows import Windows

Array = NDArray[np.float64]

STUDIES = 200
DRAWS = 39
HORIZON, N_WINDOWS, RATE = 0.5, 8, 200.0
NOISE = 0.3
CORRELATION = 0.05
"""Correlation time of the torque noise [s]."""
FRICTION = np.array([0.1, 1.0, 2.0])
DRIVE = DriveSet.parse("armature,viscous,coulomb")
METHOD = "consistent"
ROBOTS = ("ur10e", "kuka-iiwa7-r800")


def coloured(shape: tuple[int, int], rng: np.random.Generator) -> Array:
    """Return first-order noise of unit size."""
    forget, warm_up = np.exp(-1.0 / (RATE * CORRELATION)), 200
    white = rng.normal(size=(shape[0] + warm_up, shape[1]))
    return np.asarray(lfilter([np.sqrt(1.0 - forget**2)], [1.0, -forget], white, axis=0)[warm_up:])


def windows_of(recording: Recording, tau: Array) -> Windows:
    """Return windows that start on the recorded motion, driven by the true torque."""
    length = round(HORIZON * RATE) + 1
    first = np.linspace(RATE, recording.n_samples - length - RATE, N_WINDOWS).astype(int)
    assert recording.qd is not None
    return Windows(
        "virtual", HORIZON, RATE, recording.t[first],
        np.stack([recording.q[k : k + length] for k in first]),
        recording.q[first], recording.qd[first], DriveSignal("torque", recording.t, tau),
    )  # fmt: skip


def simulated(model: RobotModel, parameters: Array, windows: Windows) -> Array:
    """Return the positions (W, n) at the end of each window."""
    n = model.n_joints
    robot = SimulatedRobot(
        model.with_parameters(parameters[: 10 * n]), DRIVE, parameters[10 * n :].reshape(n, -1)
    )
    return simulate_windows(robot, windows)[:, -1]


def study(name: str, seed: int) -> tuple[Array, Ensemble]:
    """Return which windows and joints are inside (W, n), and the ensemble."""
    rng = np.random.default_rng(seed)
    described = load_robot(name)
    drive = DriveValues(armature=FRICTION[0], viscous=FRICTION[1], coulomb=FRICTION[2])
    design = replace(
        described, joints=tuple(replace(joint, drive=drive) for joint in described.joints)
    )
    true = perturb_links(described, 0.1, rng)
    friction = np.tile(FRICTION, true.n_joints) * np.exp(0.1 * rng.normal(size=3 * true.n_joints))
    machine = VirtualRobot.ideal(true).with_drive(DRIVE, friction)
    motion = random_fourier(described, rng=seed, duration=20.0, n_harmonics=8)
    recording = machine.record(motion, rate=RATE).recording
    noisy = replace(
        recording, qd=None, qdd=None, tau=recording.tau + NOISE * coloured(recording.tau.shape, rng)
    )
    samples = prepare_samples(noisy, resolve_chain(SignalChain(), noisy))
    base = find_base_parameters(design, DRIVE)
    result = identify_samples(design, samples, base=base, method=METHOD)
    ensemble = draw_ensemble(result, DRAWS, rng=seed)
    other = machine.record(
        random_fourier(described, rng=1000 + seed, duration=12.0, n_harmonics=6), rate=RATE
    ).recording
    windows = windows_of(other, other.tau)
    truth = simulated(true, np.concatenate([true.parameters, friction]), windows)
    ends = np.stack([simulated(design, each, windows) for each in ensemble.parameters])
    low, high = np.quantile(ends, [0.05, 0.95], axis=0, method="weibull")
    return np.asarray((low <= truth) & (truth <= high)), ensemble


def main(studies: int, robots: tuple[str, ...] = ROBOTS) -> None:
    """Print the share of windows inside, of each robot."""
    for name in robots:
        start, inside = time.perf_counter(), []
        for seed in range(studies):
            inside.append(study(name, seed)[0])
            if studies <= 5 or seed % 20 == 19:
                shares = np.mean(inside, axis=(1, 2))
                error = float(np.std(shares) / np.sqrt(len(shares)))
                print(
                    f"{name:18} {seed + 1:4} studies: {100 * np.mean(shares):.1f} % +-"
                    f" {100 * error:.1f} of windows and joints inside;"
                    f" per joint {np.round(100 * np.mean(inside, axis=(0, 1)), 1)}"
                    f" ({time.perf_counter() - start:.0f} s)",
                    flush=True,
                )


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else STUDIES, tuple(sys.argv[2:]) or ROBOTS)
