"""Every setting of a virtual robot can be given in words, and changes what it logs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from asbuilt.description import bundled_robot
from asbuilt.errors import UsageError
from asbuilt.excitation import random_fourier
from asbuilt.experiment import Recording, VirtualRobot, with_settings
from asbuilt.experiment.virtual.settings import list_settings

NEEDED = {
    "behind": ("torque=sensor", "coulomb=1"),
    "stribeck_velocity": ("stiction=1",),
    "engagement": ("backlash=1e-2",),
    "warming": ("coulomb=1", "warming_time=1"),
    "warming_time": ("coulomb=1", "warming=0.5"),
    "ripple_cycles": ("torque_ripple=1",),
    "ripple_phase": ("torque_ripple=1",),
    "burst": ("dropped=0.2",),
    "torque": ("armature=1",),
    "damping": ("coulomb=1",),
    "bandwidth": ("coulomb=1",),
    "controller.rate": ("coulomb=1",),
}
"""What must be there for a setting to matter."""
VALUES = {
    "torque": "sensor",
    "behind": "0.2",
    "feedforward": "none",
    "controller.rate": "2000",
    "servo.rate": "400",
    "kp": "200,100",
    "kd": "3",
    "delay": "0.02",
    "logger.rate": "200",
    "encoder_counts": "4096,1000",
    "clock_jitter": "1e-4",
    "warming_time": "2",
    "burst": "9",
    "accelerations": "no",
    "damping": "0.7",
    "stribeck_velocity": "0.3",
}
OTHERWISE = "0.3"


OF_SERVOS = ("kp", "kd", "delay", "servo.rate")


def logged(*settings: str, preset: str = "ideal") -> Recording:
    model = bundled_robot("two-link")
    robot = with_settings(VirtualRobot.preset(preset, model, rng=1), settings)
    return robot.record(random_fourier(model, 1, duration=1.0), rng=1).recording


def same(a: Recording, b: Recording) -> bool:
    pairs = ((a.t, b.t), (a.q, b.q), (a.tau, b.tau), (a.qd, b.qd))
    return all(
        (x is None and y is None) or (x is not None and y is not None and np.array_equal(x, y))
        for x, y in pairs
    )


@pytest.mark.parametrize("name", list_settings())
def test_every_setting_changes_the_log(name: str) -> None:
    needed, preset = NEEDED.get(name, ()), "servo" if name in OF_SERVOS else "ideal"
    plain = logged(*needed, preset=preset)
    changed = logged(*needed, f"{name}={VALUES.get(name, OTHERWISE)}", preset=preset)
    assert not same(plain, changed)


def test_settings_are_the_fields_they_name() -> None:
    model = bundled_robot("two-link")
    lab = VirtualRobot.preset("lab", model, rng=1)
    assert with_settings(lab, ()) is lab
    said = with_settings(
        lab, ["backlash=1e-4,2e-4", " torque_gain = -1 ", "controller.rate=500", "logger.rate=250"]
    )
    built = replace(
        lab,
        train=replace(lab.train, backlash=(1e-4, 2e-4)),
        sensors=replace(lab.sensors, torque_gain=-1.0),
        controller=replace(lab.controller, rate=500.0),
        logger=replace(lab.logger, rate=250.0),
    )
    assert said.settings == built.settings


def test_the_truth_of_an_ideal_robot_has_what_was_set() -> None:
    model = bundled_robot("two-link")
    robot = with_settings(
        VirtualRobot.preset("ideal", model), ["coulomb=2,3", "torque_bias=0.5,-0.5"]
    )
    assert robot.drive.keys == ("coulomb", "offset")
    np.testing.assert_array_equal(robot.truth[20:], [2.0, 0.5, 3.0, -0.5])


@pytest.mark.parametrize(
    ("setting", "said"),
    [
        ("play=1", "NAME of torque, behind"),
        ("rate=100", "controller.rate"),
        ("backlash", "NAME=VALUE"),
        ("backlash=", "NAME=VALUE"),
        ("backlash=much", "takes one number"),
        ("backlash=-1", "non-negative"),
        ("torque_noise=1,2,3", "one per joint"),
        ("torque=gauge", "not one of sensor, motor, current"),
        ("feedforward=some", "not one of none, gravity, full"),
        ("accelerations=2", "yes or no"),
        ("dropped=1", "dropped must be"),
        ("coulomb=nan", "non-negative number"),
        ("behind=2", "from 0 to 1"),
        ("warming=0.1,0.2", "one number"),
        ("torque_gain=inf", "number"),
    ],
)
def test_settings_that_make_no_sense(setting: str, said: str) -> None:
    with pytest.raises(UsageError, match=said):
        with_settings(VirtualRobot.preset("ideal", bundled_robot("two-link")), [setting])
