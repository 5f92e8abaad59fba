"""Which log is another robot's: friction that follows temperature is none, a tool is one."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np

from asbuilt.apps.fleet.overview import UNLIKE_OTHERS, measure_misfit
from asbuilt.dynamics import DriveSet, find_base_parameters, observation_matrix, parameter_values
from asbuilt.excitation import random_fourier
from asbuilt.experiment import Samples
from asbuilt.identification.information.square_root_information import accumulate
from fleet_logs import MODEL

DRIVE = DriveSet.parse("viscous,coulomb,offset")
BASE = find_base_parameters(MODEL, DRIVE)
CHI = np.nan_to_num(parameter_values(MODEL, DRIVE), nan=0.0)
CHI[20:] = [0.6, 0.8, 0.1, 0.3, 0.4, -0.1]
FRICTION = [20, 21, 23, 24]
NOISE = 0.05


def entry(chi: np.ndarray, seed: int) -> Any:
    """What a log of 20 s leaves in a ledger."""
    motion = random_fourier(MODEL, rng=seed, duration=20.0).sample(50.0)
    tau = observation_matrix(MODEL, motion.q, motion.qd, motion.qdd, drive=DRIVE) @ chi
    noise = NOISE * np.random.default_rng(seed).standard_normal((len(motion.q), 2))
    samples = Samples(
        motion.t, motion.q, motion.qd, motion.qdd, tau.reshape(-1, 2) + noise, 50.0,
        joint_names=MODEL.joint_names,
    )  # fmt: skip
    return SimpleNamespace(
        settings=SimpleNamespace(model=MODEL, base=BASE),
        whole=accumulate(MODEL, BASE, samples, threads=1),
    )


def warmed(by: float) -> np.ndarray:
    """The robot with friction changed by a share."""
    chi = CHI.copy()
    chi[FRICTION] *= 1.0 + by
    return chi


def test_friction_that_follows_temperature_is_no_other_robot() -> None:
    logs = [entry(warmed(0.15 * np.sin(0.8 * k)), k) for k in range(8)]
    ratios = [measure_misfit(each, [other for other in logs if other is not each]) for each in logs]
    assert max(ratios) < 1.5
    assert measure_misfit(entry(warmed(-0.5), 20), logs) < 1.5


def test_a_heavier_link_is_another_robot_whatever_its_friction() -> None:
    logs = [entry(warmed(0.15 * np.sin(0.8 * k)), k) for k in range(8)]
    heavier = warmed(0.15)
    heavier[10:20] *= 1.1
    assert measure_misfit(entry(heavier, 21), logs) > UNLIKE_OTHERS
