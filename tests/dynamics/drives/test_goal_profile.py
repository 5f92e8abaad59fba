"""Goal of a servo with limits against integration of its law in small steps."""

import numpy as np
import pytest

from asbuilt.dynamics import PositionServo
from asbuilt.dynamics.drives.goal_profile import derive_goal_path
from asbuilt.errors import UsageError


def integrated(t, command, a, fastest, step=1e-5):
    """Return the goal by bang-bang control in small steps, which sees only the stopping way."""
    times = np.arange(t[0], t[-1], step)
    goal, rate, path = command[0], 0.0, []
    for now in times:
        target = command[np.searchsorted(t, now + 1e-12, side="right") - 1]
        way = target - goal
        wanted = np.sign(way) * min(np.sqrt(2.0 * a * abs(way)), fastest)
        rate += np.clip(wanted - rate, -a * step, a * step)
        goal += rate * step
        path.append(goal)
    return times, np.array(path)


@pytest.mark.parametrize("fastest", [pytest.param(np.inf, marks=pytest.mark.study), 0.6])
def test_goal_is_that_of_time_optimal_control(fastest):
    rng = np.random.default_rng(1)
    t = 0.05 * np.arange(30)
    command = np.cumsum(rng.normal(scale=0.05, size=30))
    times, path = integrated(t, command, 8.0, fastest)
    fine, goal = derive_goal_path(t, command[:, None], 8.0, fastest)
    middles = fine + 0.5 * np.median(np.diff(fine))
    expected = np.interp(middles, times, path)
    inside = middles < times[-1]
    assert np.max(np.abs(goal[inside, 0] - expected[inside])) < 5e-4
    assert np.max(np.abs(np.repeat(command, 50) - goal[:, 0])) > 0.02
    rate = np.diff(goal[:, 0]) / np.diff(fine)
    assert np.max(np.abs(rate)) < min(fastest, 10.0) * (1.0 + 1e-6)
    assert np.max(np.abs(np.diff(rate))) / 1e-3 < 8.0 * (1.0 + 1e-6)


def test_goal_without_limit_is_the_held_command():
    _, goal = derive_goal_path([0.0, 0.02, 0.04], [[0.0], [1.0], [0.5]], np.inf)
    assert goal[:, 0].tolist() == [0.0] * 20 + [1.0] * 20 + [0.5] * 20


def test_only_joints_with_a_limit_are_changed():
    servo = PositionServo(kp=(1.0, 1.0), kd=(0.0, 0.0), goal_acceleration=(np.inf, 1.0))
    assert servo.limits_goal
    _, goal = servo.goal([0.0, 0.1], [[0.0, 0.0], [1.0, 1.0]])
    assert goal[-1, 0] == 1.0
    assert goal[-1, 1] == pytest.approx(0.5 * 0.1**2, rel=0.02)
    assert servo.reordered((1, 0)).goal_acceleration == (1.0, np.inf)


def test_a_speed_without_acceleration_is_refused():
    with pytest.raises(UsageError, match="acceleration"):
        PositionServo(kp=(1.0,), kd=(0.0,), goal_speed=(1.0,))
    with pytest.raises(UsageError, match="positive"):
        PositionServo(kp=(1.0,), kd=(0.0,), goal_acceleration=(0.0,))
