"""Does identification find the truth? Four virtual robots, not as described, are recorded in MuJoCo as in a laboratory, identified, and held against it.

The robots follow their commands under a controller, with friction, rotors, encoders that count and torque sensors with noise, bias and ripple; mass
distributions are about 3 % off the description. Each is identified from three random motions of 20 s, and judged on a fourth.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from asbuilt import load_robot
from asbuilt.excitation.random_motion import random_fourier
from asbuilt.experiment.data_logger import DataLogger
from asbuilt.experiment.sensors import PERFECT_SENSORS
from asbuilt.experiment.virtual_robot import VirtualRobot
from asbuilt.tables import Column, Table, columns, share, significant
from asbuilt.validation.recovery import Recovery, compare_with_truth
from asbuilt.validation.study import StudyOptions, run_study

ROBOTS = ("kuka-iiwa7-r800", "ur10e", "franka-panda", "scara")


def recover(name: str, seed: int = 1, recordings: int = 3) -> tuple[Recovery, float]:
    """Record, identify, and return the recovery with the error of prediction on a fresh recording."""
    model = load_robot(name)
    robot = VirtualRobot.preset("lab", model, rng=seed)
    learned = [robot.record(random_fourier(model, 100 * seed + k, n_harmonics=5 + k), rng=100 * seed + k) for k in range(recordings)]
    fresh = random_fourier(model, 100 * seed + 99)
    judged = robot.record(fresh, rng=100 * seed + 99)
    study = run_study(
        model,
        [simulated.recording for simulated in learned],
        validation=[judged.recording],
        options=StudyOptions(drive=robot.drive, checked=False),
    )
    clean = replace(robot, sensors=PERFECT_SENSORS, logger=DataLogger(rate=100.0, accelerations=True)).record(fresh)
    truth = replace(clean, truth=robot.truth)
    return compare_with_truth(study.result, truth), study.result.validation[0].relative_error


if __name__ == "__main__":
    rows = []
    for name in ROBOTS:
        recovery, held_out = recover(name)
        deviations = recovery.deviations
        rows.append(
            (
                name,
                len(recovery.names),
                share(recovery.within(2.0), 0),
                share(recovery.within(3.0), 0),
                significant(float(np.sqrt(np.mean(deviations**2))), 2),
                significant(float(np.abs(deviations).max()), 2),
                share(held_out, 2),
                share(recovery.torque_error, 2),
                share(recovery.cad_error, 1),
            )
        )
        assert recovery.within(3.0) > 0.95, f"{name}: the stated errors are too small"
        assert recovery.torque_error < 0.1 * recovery.cad_error
    numbers = ("parameters", "in 2 sigma", "in 3 sigma", "RMS sigma", "worst", "held out", "torque error", "CAD")
    print(Table(columns("robot", *(Column(head, align="right") for head in numbers)), tuple(rows)).as_text())
    print(
        "held out: error of the torque predicted for a fresh recording, its noise included; torque error: without any noise, against the truth"
    )
