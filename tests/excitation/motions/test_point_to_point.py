from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from asbuilt.errors import MotionError
from asbuilt.excitation import PointToPointMotion, QuinticMotion


@settings(max_examples=80, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_limiting_joint_attains_its_limit_and_the_path_is_straight(seed: int) -> None:
    rng = np.random.default_rng(seed)
    poses = rng.uniform(-3, 3, size=(2, 5))
    velocity, acceleration = rng.uniform(0.1, 4, size=5), rng.uniform(0.1, 20, size=5)
    motion = PointToPointMotion.within(poses, velocity=velocity, acceleration=acceleration)
    v, a = np.max(motion.peaks(1) / velocity), np.max(motion.peaks(2) / acceleration)
    assert v <= 1 + 1e-12
    assert a == pytest.approx(1.0, abs=1e-12)
    if motion.breaks.size == 4:
        assert v == pytest.approx(1.0, abs=1e-12)
    progress = (motion.derivative(np.linspace(0, motion.duration, 50)) - poses[0]) / (
        poses[1] - poses[0]
    )
    np.testing.assert_allclose(progress, progress[:, :1] * np.ones(5), atol=1e-9)


@settings(max_examples=50, deadline=None)
@given(st.floats(0.01, 5), st.floats(0.05, 5), st.floats(0.05, 50))
def test_duration_is_the_minimum_of_bang_bang_control(
    distance: float, velocity: float, acceleration: float
) -> None:
    motion = PointToPointMotion.within(
        [[0.0], [distance]], velocity=velocity, acceleration=acceleration
    )
    if distance <= velocity**2 / acceleration:
        expected = 2 * np.sqrt(distance / acceleration)
    else:
        expected = distance / velocity + velocity / acceleration
    assert motion.duration == pytest.approx(expected, rel=1e-9)
    assert motion.end[0] == pytest.approx(distance, rel=1e-12)


def test_a_slower_pace_is_the_same_move_in_more_time() -> None:
    poses = np.array([[0.0, 1.0], [2.0, 0.5], [1.0, 1.0]])
    fast = PointToPointMotion.within(poses, velocity=1.0, acceleration=2.0)
    slow = PointToPointMotion.within(poses, velocity=1.0, acceleration=2.0, pace=0.25)
    t = np.linspace(0.0, fast.duration, 50)
    np.testing.assert_allclose(slow.derivative(4 * t), fast.derivative(t), atol=1e-12)
    mixed = PointToPointMotion.within(poses, velocity=1.0, acceleration=2.0, pace=[1.0, 0.5])
    first = PointToPointMotion.within(poses[:2], velocity=1.0, acceleration=2.0).duration
    assert mixed.duration == pytest.approx(first + 2 * (fast.duration - first))
    with pytest.raises(MotionError, match="pace of a move"):
        PointToPointMotion.within(poses, velocity=1.0, acceleration=2.0, pace=[1.0, 0.0])


def test_every_pose_is_reached_and_held() -> None:
    poses = np.random.default_rng(1).uniform(-1, 1, size=(5, 3))
    dwell = [0.4, 0.0, 0.25]
    motion = PointToPointMotion.within(poses, velocity=1.0, acceleration=2.0, dwell=dwell)
    t = np.linspace(0, motion.duration, 20001)
    q, qd, _ = motion.at(t)
    for pose in poses:
        assert np.min(np.max(np.abs(q - pose), axis=1)) < 1e-3
    standing = np.max(np.abs(qd), axis=1) == 0
    assert standing.mean() * motion.duration == pytest.approx(sum(dwell), abs=5e-3)


def test_poses_that_differ_by_rounding_are_one() -> None:
    nearly = [[0.0], [1.0], [1.0 + 2e-16], [1.0 - 1e-13], [0.0]]
    for kind in (PointToPointMotion, QuinticMotion):
        motion = kind.within(nearly, velocity=1.0, acceleration=1.0)
        exact = kind.within([[0.0], [1.0], [0.0]], velocity=1.0, acceleration=1.0)
        assert motion.duration == pytest.approx(exact.duration, abs=1e-9)


def test_joints_that_do_not_move_stay_put() -> None:
    motion = PointToPointMotion.within(
        [[0.0, 1.0], [2.0, 1.0], [2.0, 1.0]], velocity=1.0, acceleration=1.0
    )
    np.testing.assert_array_equal(
        motion.derivative(np.linspace(0, motion.duration, 100))[:, 1], 1.0
    )


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"poses": [[0.0], [0.0]], "velocity": 1, "acceleration": 1}, "nothing moves"),
        ({"poses": [[0.0], [1.0]], "velocity": 1, "acceleration": np.inf}, "finite acceleration"),
        ({"poses": [[0.0], [1.0]], "velocity": 0, "acceleration": 1}, "velocity limit of joint 1"),
        ({"poses": [[0.0], [1.0], [0.0]], "velocity": 1, "acceleration": 1, "dwell": -1}, "dwell"),
        ({"poses": [0.0, 1.0], "velocity": 1, "acceleration": 1}, "one column per joint"),
    ],
)
def test_errors_say_what_is_wrong(arguments: dict[str, object], message: str) -> None:
    with pytest.raises(MotionError, match=message):
        PointToPointMotion.within(**arguments)  # type: ignore[arg-type]
