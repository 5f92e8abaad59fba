"""What a robot model refuses.

Placements that are none, frames that hang on nothing, kinds of joints that do not exist.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from asbuilt.description import (
    ROOT,
    DHRow,
    Frame,
    Joint,
    JointLimits,
    RobotModel,
    load_robot,
    placement,
    robot_from_dh,
)
from asbuilt.description.rotation import find_axes_across, rotation_x
from asbuilt.errors import DescriptionError


def with_entry(row: int, column: int, value: float) -> np.ndarray:
    T = placement(rotation_x(0.3), (0.1, 0.2, 0.3))
    T[row, column] = value
    return T


@pytest.mark.parametrize(
    ("matrix", "message"),
    [
        (np.eye(3), r"must be a finite 4 x 4 matrix, got shape \(3, 3\)"),
        (with_entry(0, 3, np.nan), "must be a finite 4 x 4 matrix"),
        (with_entry(0, 0, 1.1), r"does not hold a rotation .*: R R\^T differs from 1 by 0\.21"),
        (np.diag([1.0, 1.0, -1.0, 1.0]), r"does not hold a rotation .* det R = -1"),
        (with_entry(3, 0, 0.5), r"must have the last row 0 0 0 1, got \[0\.5, 0\.0, 0\.0, 1\.0\]"),
    ],
)
def test_what_is_no_placement_is_refused(matrix, message):
    with pytest.raises(DescriptionError, match=f"placement before joint 'elbow'.*{message}"):
        Joint("elbow", "revolute", ROOT, matrix, np.eye(4))
    with pytest.raises(DescriptionError, match=f"placement after joint 'elbow'.*{message}"):
        Joint("elbow", "revolute", ROOT, np.eye(4), matrix)
    with pytest.raises(DescriptionError, match=f"placement of frame 'tool'.*{message}"):
        Frame("tool", 0, matrix)


def test_a_pedestal_that_is_no_placement_is_refused():
    with pytest.raises(DescriptionError, match=r"joint_1.*does not hold a rotation"):
        robot_from_dh([DHRow(a=0.5, origin=np.diag([2.0, 2.0, 2.0, 1.0]))])


def test_the_kind_of_a_joint_must_exist():
    with pytest.raises(
        DescriptionError,
        match="joint 'elbow' is 'fixed'; known kinds: revolute, continuous, prismatic",
    ):
        Joint("elbow", "fixed", ROOT, np.eye(4), np.eye(4))


@pytest.mark.parametrize(
    ("limits", "message"),
    [
        ({"lower": 1.0, "upper": -1.0}, "position limits from 1.0 to -1.0 leave no position"),
        ({"lower": np.inf}, "position limits from inf to inf leave no position"),
        ({"lower": np.nan}, "position limits from nan to inf leave no position"),
        ({"velocity": -2.0}, "the velocity limit of a joint is -2.0; it must not be negative"),
        ({"torque": np.nan}, "the torque limit of a joint is nan"),
    ],
)
def test_limits_leave_something(limits, message):
    with pytest.raises(DescriptionError, match=message):
        JointLimits(**limits)


def test_frames_hang_on_links_that_exist():
    model = load_robot("two-link")
    frames = (Frame("tool", 2, np.eye(4)),)
    with pytest.raises(
        DescriptionError,
        match="frame 'tool' is fixed to link index 2; the links are 0 to 1, and -1 for the root",
    ):
        replace(model, frames=frames)


def test_limits_are_given_one_per_joint():
    with pytest.raises(
        DescriptionError, match="two-link has 2 joints, got 1 limits; give one per joint"
    ):
        load_robot("two-link").with_limits([JointLimits()])


def test_matrices_of_the_caller_stay_his_own():
    """A model keeps copies: what it was made of may change afterwards, and stays writable."""
    before = placement(rotation_x(0.3))
    joint = Joint("elbow", "revolute", ROOT, before, np.eye(4, dtype=np.int64))
    model = RobotModel("arm", (joint,), (load_robot("two-link").links[0],))
    before[0, 3] = 7.0
    assert model.joints[0].before[0, 3] == 0.0
    assert model.joints[0].after.dtype == np.float64
    with pytest.raises(ValueError, match="read-only"):
        model.joints[0].before[0, 3] = 1.0


@pytest.mark.parametrize(
    "vector",
    [(0.0, 0.0, -9.81), (0.0, 0.0, 0.0), (0.0, 9.81, 0.0), (3.0, -4.0, 7.0), (1e-3, 0.0, 5.0)],
)
def test_axes_across_a_vector(vector):
    axes = find_axes_across(vector)
    assert np.allclose(axes @ axes.T, np.eye(2), atol=1e-15)
    assert np.allclose(axes @ vector, 0.0, atol=1e-14)
    farther = np.sort(np.argsort(np.abs(vector), kind="stable")[:2])
    assert axes[0, farther[0]] > 0.7
    assert axes[1, farther[1]] > 0.7
