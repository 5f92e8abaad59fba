"""Robots recorded on a wall or a ceiling with the description of one on the floor."""

from __future__ import annotations

import numpy as np
import pytest

from asbuilt.description import bundled_robot
from asbuilt.excitation import random_fourier
from asbuilt.experiment import Recording, check_recording, simulate_recording
from studied_cases import first_of

ROBOTS = ("ur10e", "kuka-iiwa7-r800", "franka-panda")
ONE_AND_STUDIES = [
    ROBOTS[0],
    *(pytest.param(name, marks=pytest.mark.study) for name in ROBOTS[1:]),
]


def recorded(name: str, gravity: tuple[float, ...]) -> Recording:
    """Return a recording of a robot with this gravity."""
    mounted = bundled_robot(name).with_gravity(gravity)
    return simulate_recording(mounted, random_fourier(mounted, rng=5), rate=100.0, rng=6)


@pytest.mark.parametrize(
    ("name", "gravity", "said"),
    first_of(
        1,
        [
            (ROBOTS[0], (9.81, 0.0, 0.0), "+x"),
            (ROBOTS[1], (0.0, -9.81, 0.0), "-y"),
            (ROBOTS[2], (0.0, 0.0, 9.81), "+z"),
        ],
    ),
)
def test_the_direction_is_named(name: str, gravity: tuple[float, ...], said: str) -> None:
    check = check_recording(bundled_robot(name), recorded(name, gravity))
    found = {finding.code: finding for finding in check.findings}
    cure = found["gravity_direction"].cure
    assert cure is not None
    assert cure.settings == {"gravity": said}
    assert not check.ok
    assert "joints_swapped" not in found


@pytest.mark.parametrize("name", ONE_AND_STUDIES)
def test_the_right_direction_and_a_small_tilt_are_not_doubted(name: str) -> None:
    tilt = np.radians(5.0)
    for gravity in ((0.0, 0.0, -9.81), (9.81 * np.sin(tilt), 0.0, -9.81 * np.cos(tilt))):
        recording = recorded(name, gravity)
        check = check_recording(bundled_robot(name), recording)
        assert "gravity_direction" not in check.codes
    flipped = check_recording(bundled_robot(name), recording.flipped())
    assert "gravity_direction" not in flipped.codes
    assert "torque_flipped" in flipped.codes


@pytest.mark.parametrize("name", ONE_AND_STUDIES)
def test_a_description_without_gravity_is_doubted_where_the_log_shows_some(name: str) -> None:
    floating = bundled_robot(name).with_gravity((0.0, 0.0, 0.0))
    (found,) = [
        each
        for each in check_recording(floating, recorded(name, (0.0, 0.0, -9.81))).findings
        if each.code == "gravity_direction"
    ]
    assert found.cure is not None
    assert found.cure.settings == {"gravity": "-z"}
    weightless = recorded(name, (0.0, 0.0, 0.0))
    for log in (weightless, weightless.flipped()):
        assert "gravity_direction" not in check_recording(floating, log).codes


def test_a_direction_that_is_no_axis_is_estimated() -> None:
    along = np.array([0.6, -0.64, 0.48]) * 9.81
    check = check_recording(bundled_robot("ur10e"), recorded("ur10e", tuple(along)))
    (finding,) = [each for each in check.findings if each.code == "gravity_direction"]
    assert finding.cure is not None
    said = np.array([float(part) for part in finding.cure.settings["gravity"].split(",")])
    assert said @ along / 9.81**2 > np.cos(np.radians(5.0))
