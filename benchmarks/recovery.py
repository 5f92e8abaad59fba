"""Virtual robots in MuJoCo.

How fast 20 s are recorded, and how often stated errors hold the truth, over several robots of each
kind.
"""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np

from asbuilt.description.load import bundled_robot
from asbuilt.excitation.motions.fourier import random_fourier
from asbuilt.experiment.virtual.sensors import PERFECT_SENSORS, DataLogger
from asbuilt.experiment.virtual.virtual_robot import VirtualRobot
from asbuilt.validation.recovery import Recovery, compare_with_truth
from asbuilt.workflow.study import StudyOptions, identify

ROBOTS = ("kuka-iiwa7-r800", "ur10e", "franka-panda", "scara")
SEEDS = range(5)
RECORDINGS = 3


def measure() -> dict[str, float | str]:
    """Return recording times, coverage of the standard errors and errors of prediction."""
    found: dict[str, float | str] = {}
    model = bundled_robot("kuka-iiwa7-r800")
    motion = random_fourier(model, 1)
    for preset in ("ideal", "lab", "factory"):
        robot = VirtualRobot.preset(preset, model, rng=1)
        robot.record(random_fourier(model, 1, duration=1.0))
        started = time.perf_counter()
        robot.record(motion, rng=2)
        found[f"record_20_s_of_7_joints_{preset}_s"] = time.perf_counter() - started
    for preset in ("lab", "factory"):
        for name in ROBOTS:
            recoveries = [recovered(name, preset, seed) for seed in SEEDS]
            deviations = np.concatenate([recovery.deviations for recovery in recoveries])
            found[f"{preset}_{name}_share_within_2_sigma"] = float(
                np.mean(np.abs(deviations) <= 2.0)
            )
            found[f"{preset}_{name}_rms_sigma"] = float(np.sqrt(np.mean(deviations**2)))
            found[f"{preset}_{name}_torque_error"] = float(
                np.mean([recovery.torque_error for recovery in recoveries])
            )
            found[f"{preset}_{name}_cad_error"] = float(
                np.mean([recovery.cad_error for recovery in recoveries])
            )
    return found


def recovered(name: str, preset: str, seed: int) -> Recovery:
    """Record one robot three times, identify it, compare it with its truth along a new motion."""
    model = bundled_robot(name)
    robot = VirtualRobot.preset(preset, model, rng=seed)
    learned = [
        robot.record(random_fourier(model, 100 * seed + k, n_harmonics=5 + k), rng=100 * seed + k)
        for k in range(RECORDINGS)
    ]
    study = identify(
        model,
        [each.recording for each in learned],
        options=StudyOptions(drive=robot.drive, checked=False),
    )
    clean = replace(
        robot, sensors=PERFECT_SENSORS, logger=DataLogger(rate=100.0, accelerations=True)
    )
    along = clean.record(random_fourier(model, 100 * seed + 99))
    return compare_with_truth(study.result, replace(along, truth=robot.truth))


if __name__ == "__main__":
    for key, value in measure().items():
        print(f"{key:55s} {value:.4g}")
