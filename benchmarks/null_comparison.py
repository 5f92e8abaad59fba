"""How often `compare` reports a difference where CAD is the truth.

400 virtual recordings of each robot, another motion and other torque noise in each. The shares
belong within the binomial 95 % band of the nominal level, which is printed beside them. Estimates
that are regularised toward CAD find fewer differences, since CAD is the truth here.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter
from scipy.stats import binom

from asbuilt.description.load import load_robot
from asbuilt.dynamics.drives.drive_set import DriveSet
from asbuilt.excitation.motions.fourier import random_fourier
from asbuilt.experiment.signal.preparation import prepare_samples, resolve_chain
from asbuilt.experiment.signal.signal_chain import SignalChain
from asbuilt.experiment.virtual.virtual_robot import VirtualRobot
from asbuilt.identification.identify import identify_samples
from asbuilt.validation.comparison.comparison import compare

Array = NDArray[np.float64]

ROBOTS = ("kuka-iiwa7-r800", "ur10e", "scara")
DURATIONS = (15.0, 40.0)
METHODS = ("wls", "auto")
REPETITIONS = 400
LEVELS = (0.05, 0.01, 0.001)
RATE = 100.0
NOISE = 0.3
CORRELATION_TIME = 0.1
DRIVE = DriveSet.parse("viscous,coulomb,offset")


def coloured(rng: np.random.Generator, n_samples: int, n_joints: int) -> Array:
    """Return first-order noise of unit variance, shape (n_samples, n_joints)."""
    forget, warm_up = np.exp(-1.0 / (RATE * CORRELATION_TIME)), int(20 * RATE * CORRELATION_TIME)
    white = rng.normal(size=(n_samples + warm_up, n_joints))
    return np.asarray(lfilter([np.sqrt(1.0 - forget**2)], [1.0, -forget], white, axis=0)[warm_up:])


def probabilities(robot: str, duration: float, method: str, repetitions: int) -> dict[str, Array]:
    """Return the p values of all repetitions: of all parameters together, the smallest after
    correction for their number, and of each parameter alone.
    """
    model = load_robot(robot)
    machine = VirtualRobot.ideal(model).with_drive(DRIVE, np.tile([1.0, 2.0, 0.3], model.n_joints))
    found: dict[str, list[Array | float]] = {"together": [], "some": [], "each": []}
    for k in range(repetitions):
        rng = np.random.default_rng([k, int(duration)])
        motion = random_fourier(model, rng=rng, duration=duration, n_harmonics=5)
        recording = replace(machine.record(motion, rate=RATE).recording, qd=None, qdd=None)
        noise = NOISE * coloured(rng, recording.n_samples, model.n_joints)
        recording = replace(recording, tau=recording.tau + noise)
        samples = prepare_samples(recording, resolve_chain(SignalChain(), recording))
        compared = compare(identify_samples(model, samples, drive=DRIVE, method=method))
        each = np.array([p.p_value for p in compared.parameters if p.p_value is not None])
        found["together"].append(
            1.0 if compared.chi_square is None else compared.chi_square.probability
        )
        found["some"].append(
            min(p.false_discovery for p in compared.parameters if p.false_discovery is not None)
        )
        found["each"].append(each)
    return {what: np.array(values) for what, values in found.items()}


def measure(
    repetitions: int = REPETITIONS, methods: Sequence[str] = METHODS
) -> dict[str, float | str]:
    """Return the shares of p values up to each level, and the band of each level."""
    numbers: dict[str, float | str] = {}
    for level in LEVELS:
        low, high = binom.interval(0.95, repetitions, level)
        numbers[f"band_{level:g}"] = f"{low / repetitions:.4f} to {high / repetitions:.4f}"
    for method in methods:
        for robot in ROBOTS:
            for duration in DURATIONS:
                for what, p in probabilities(robot, duration, method, repetitions).items():
                    for level in LEVELS:
                        name = f"{method}_{robot}_{duration:g}s_{what}_{level:g}"
                        numbers[name] = float(np.mean(p <= level))
                        print(f"{name:<56} {numbers[name]:.4f}", flush=True)
    return numbers


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("repetitions", nargs="?", type=int, default=REPETITIONS)
    parser.add_argument("methods", nargs="*", default=METHODS)
    arguments = parser.parse_args()
    for name, value in measure(arguments.repetitions, arguments.methods).items():
        print(f"{name:<56} {value}")
