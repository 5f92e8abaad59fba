"""Payloads weighed by drives whose gains are off by 7 % at random.

How often the stated errors hold the truth, with and without what gains leave open.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from asbuilt.description.inertia import LinkInertia
from asbuilt.description.load import bundled_robot
from asbuilt.dynamics.drives.drive_set import DriveSet
from asbuilt.excitation.motions.fourier import random_fourier
from asbuilt.experiment.signal.preparation import prepare_samples
from asbuilt.experiment.signal.samples import Samples
from asbuilt.experiment.virtual.sensors import SensorNoise
from asbuilt.experiment.virtual.virtual_robot import VirtualRobot
from asbuilt.identification.calibration.payload import (
    choose_payload_frame,
    identify_payload_samples,
)
from asbuilt.identification.identify import identify_samples
from asbuilt.identification.information.cause_data import gather_cause_data

ROBOTS = ("ur10e", "kuka-iiwa7-r800", "franka-panda")
DRAWS = 60
OFF = 0.07
TOOL = LinkInertia.from_com(1.8, [0.03, -0.02, 0.09], np.diag([0.011, 0.009, 0.006]))
DRIVE = DriveSet.parse("viscous,coulomb,offset")
TWO_SIDED = 1.96


def measure() -> dict[str, float | str]:
    """Return the share of draws in which the 95 % interval holds the truth, by robot and by how
    much of the error all joints have in common.
    """
    found: dict[str, float | str] = {}
    for name in ROBOTS:
        model = bundled_robot(name)
        robot = (
            VirtualRobot.ideal(model)
            .with_drive(DRIVE, np.tile([1.0, 2.0, 0.3], model.n_joints))
            .with_noise(SensorNoise(torque_noise=0.1))
        )
        bare, loaded = (
            recorded(robot, 1),
            recorded(robot.with_tool(TOOL, at=choose_payload_frame(model)[0]), 3),
        )
        for common in (0.0, 1.0 / 3.0, 1.0):
            rng = np.random.default_rng(1)
            whole, noise = [], []
            for _ in range(DRAWS):
                factors = 1.0 + OFF * (
                    np.sqrt(common) * rng.normal()
                    + np.sqrt(1.0 - common) * rng.normal(size=model.n_joints)
                )
                samples = scaled(bare, factors)
                result = identify_samples(model, samples, drive=DRIVE)
                result = replace(
                    result, cause_data=gather_cause_data(model, result.base, [samples])
                )
                payload = identify_payload_samples(result, scaled(loaded, factors))
                off = np.abs(payload.values[:4] - np.array([TOOL.mass, *TOOL.com]))
                whole.append(off < TWO_SIDED * payload.std_errors[:4])
                noise.append(off < TWO_SIDED * payload.noise_errors[:4])
            case = f"{name}_common_{common:.2f}"
            for part, columns in (("mass", slice(0, 1)), ("centre", slice(1, 4))):
                found[f"{case}_{part}_covered"] = float(np.mean(np.array(whole)[:, columns]))
                found[f"{case}_{part}_covered_by_noise_alone"] = float(
                    np.mean(np.array(noise)[:, columns])
                )
    return found


def recorded(robot: VirtualRobot, seed: int) -> Samples:
    """Return 30 s of a random motion, filtered."""
    return prepare_samples(
        robot.record(
            random_fourier(robot.model, seed, duration=30.0, n_harmonics=10), rate=200.0, rng=seed
        ).recording
    )


def scaled(samples: Samples, factors: np.ndarray) -> Samples:
    """Return samples as a controller with gains off by these factors logs them."""
    return replace(samples, tau=samples.tau * factors, torque_source="current")
