from __future__ import annotations

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
from pinocchio_oracle import pinocchio_model

from asbuilt.description import load_robot
from asbuilt.dynamics import DriveSet, gravity_torque, observation_matrix
from asbuilt.errors import UsageError
from asbuilt.excitation import DesignOptions, MotionBounds, design_static_poses


def standing(model, poses, drive=None):
    rest = np.zeros_like(poses)
    return observation_matrix(model, poses, rest, rest, drive=drive or DriveSet())


@pytest.mark.parametrize(
    ("robot", "drive"),
    [
        ("ur10e", "none"),
        ("two-link", "offset"),
        pytest.param("kuka-iiwa7-r800", "none", marks=pytest.mark.study),
        pytest.param("franka-panda", "none", marks=pytest.mark.study),
    ],
)
def test_poses_tell_all_that_gravity_tells_better_than_random_ones(robot: str, drive: str) -> None:
    model, terms = load_robot(robot), DriveSet.parse(drive)
    design = design_static_poses(model, 14, drive=terms)
    bounds = MotionBounds.assumed(model, 0.95)
    rng = np.random.default_rng(0)
    many = standing(model, rng.uniform(bounds.lower, bounds.upper, (400, model.n_joints)), terms)
    _, sizes, directions = np.linalg.svd(many, full_matrices=False)
    told = directions[sizes > 1e-8 * sizes[0]].T
    assert design.n_parameters == told.shape[1]

    def log_det(poses) -> float:
        return float(
            np.linalg.slogdet(
                (standing(model, poses, terms) @ told).T @ (standing(model, poses, terms) @ told)
            )[1]
        )

    random = [
        log_det(rng.uniform(bounds.lower, bounds.upper, (14, model.n_joints))) for _ in range(100)
    ]
    assert log_det(design.poses) > max(random)
    assert np.all((design.poses >= bounds.lower - 1e-9) & (design.poses <= bounds.upper + 1e-9))
    assert np.all(
        np.abs(gravity_torque(model, design.poses)) <= 0.8 * MotionBounds.of(model).torque
    )
    assert design.limits.worst_margin["velocity"] >= 0
    visited = design.motion.at(design.motion.sample_times(100.0))[0]
    for pose in design.poses:
        assert np.abs(visited - pose).max(axis=1).min() < 0.05


def test_travel_is_shorter_than_in_random_order() -> None:
    model = load_robot("kuka-iiwa7-r800")
    design = design_static_poses(model, 16)
    speed = MotionBounds.assumed(model, 0.95).velocity

    def length(poses) -> float:
        return float(np.abs(np.diff(poses / speed, axis=0)).max(axis=1).sum())

    rng = np.random.default_rng(1)
    assert length(design.poses) < min(length(design.poses[rng.permutation(16)]) for _ in range(200))


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.study)])
def test_a_robot_that_hardly_carries_itself_finds_its_way(seed: int) -> None:
    """The straight way between two poses may be too heavy where both are not."""
    model = load_robot("ur10e")
    weak = replace(
        model,
        joints=tuple(
            replace(joint, limits=replace(joint.limits, torque=0.3 * joint.limits.torque))
            for joint in model.joints
        ),
    )
    design = design_static_poses(weak, 10, DesignOptions(seed=seed))
    q, qd, qdd = design.motion.at(design.motion.sample_times(1000.0))
    other = pinocchio_model(weak)
    data = other.createData()
    tau = np.array(
        [pin.rnea(other, data, *map(np.array, state)) for state in zip(q, qd, qdd, strict=True)]
    )
    assert np.all(np.abs(tau) <= 0.8 * MotionBounds.of(weak).torque * (1 + 1e-9))
    for pose in design.poses:
        assert np.abs(q - pose).max(axis=1).min() < 1e-4


def test_too_few_poses_and_weightless_robots_are_refused() -> None:
    model = load_robot("kuka-iiwa7-r800")
    with pytest.raises(UsageError, match=r"got 1 poses; .* takes at least 2"):
        design_static_poses(model, 1)
    with pytest.raises(UsageError, match="determine no parameter"):
        design_static_poses(load_robot("two-link").with_gravity([0.0, 0.0, 0.0]), 5)
