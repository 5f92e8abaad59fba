"""Moves slow down one by one, by what they ask for, and a weight that is too heavy is no matter of
speed.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
from pinocchio_oracle import pinocchio_model

from asbuilt.description import load_robot
from asbuilt.excitation import DesignOptions, MotionBounds, PointToPointMotion, design_motion
from asbuilt.excitation.motions.point_to_point import pace_moves
from asbuilt.excitation.state_constraint import StateConstraint, WeightLimit

PLANE = MotionBounds(*(np.array([value, value]) for value in (-1.0, 1.0, 1.0, 4.0, np.inf, np.inf)))
POSES = np.array([[-0.8, 0.0], [0.8, 0.0], [0.8, 0.9], [-0.8, 0.9]])


class SlowAbove(StateConstraint):
    """Allow the first joint a speed where the second is high."""

    name = "slow"
    two_sided = True

    def __init__(self, speed: float) -> None:
        self.speed = speed

    def values(self, q, qd, qdd):
        return np.where(q[:, 1] > 0.5, qd[:, 0] / self.speed, 0.0)[:, None]

    def slopes(self, q, qd, qdd):
        raise NotImplementedError


def weakened(name: str, share: float):
    model = load_robot(name)
    return replace(
        model,
        joints=tuple(
            replace(joint, limits=replace(joint.limits, torque=share * joint.limits.torque))
            for joint in model.joints
        ),
    )


def test_only_the_move_that_asks_for_it_is_slowed_down() -> None:
    fast = PointToPointMotion.within(
        POSES, velocity=PLANE.velocity, acceleration=PLANE.acceleration
    )
    paced = pace_moves(POSES, PLANE, [SlowAbove(0.4)])
    assert paced is not None
    arrival = (
        fast.breaks[-1]
        - PointToPointMotion.within(POSES[2:], velocity=1.0, acceleration=4.0).duration
    )
    t = np.linspace(0.0, arrival, 500)
    np.testing.assert_allclose(paced.derivative(t), fast.derivative(t), atol=1e-12)
    late = paced.derivative(np.linspace(arrival, paced.duration, 2000), 1)[:, 0]
    assert 0.4 / 1.08 < np.abs(late).max() < 0.4
    np.testing.assert_allclose(paced.derivative([paced.duration])[0], POSES[-1], atol=1e-12)


def test_what_no_pace_cures_has_no_motion() -> None:
    assert pace_moves(POSES, PLANE, [SlowAbove(0.01)]) is None


def test_the_weight_is_gravity_by_pinocchio() -> None:
    model = load_robot("ur10e")
    limit = np.array([joint.limits.torque for joint in model.joints])
    q = np.random.default_rng(3).uniform(-2, 2, (5, 6))
    weight, other = WeightLimit((model,), limit), pinocchio_model(model)
    data = other.createData()
    expected = np.array([pin.computeGeneralizedGravity(other, data, pose) for pose in q]) / limit
    np.testing.assert_allclose(weight.values(q, 1 + q, 2 - q), expected, atol=1e-12)
    slopes = weight.slopes(q, q, q)[..., 0]
    for k in range(6):
        step = 1e-6 * np.eye(6)[k]
        change = np.array(
            [
                (
                    pin.computeGeneralizedGravity(other, data, p + step)
                    - pin.computeGeneralizedGravity(other, data, p - step)
                )
                for p in q
            ]
        )
        np.testing.assert_allclose(slopes[:, :, k], change / 2e-6 / limit, atol=1e-7)
    assert not weight.binds(q)
    assert WeightLimit((model,), 0.1 * limit).binds(q)


@pytest.mark.study
def test_poses_are_designed_for_a_robot_that_hardly_carries_itself() -> None:
    model = weakened("ur10e", 0.3)
    options = DesignOptions(parametrisation="point-to-point", duration=5.0, size=6, starts=2)
    motion = design_motion(model, options, with_bound=False, cores=1).motion
    other = pinocchio_model(model)
    data = other.createData()
    tau = np.array(
        [
            pin.rnea(other, data, *map(np.array, state))
            for state in zip(*motion.at(motion.sample_times(1000.0)), strict=True)
        ]
    )
    allowed = 0.8 * np.array([joint.limits.torque for joint in model.joints])
    assert np.all(np.abs(tau) <= allowed * (1 + 1e-9))
