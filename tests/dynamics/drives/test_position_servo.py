"""The law of a position servo, term by term, and what it refuses."""

from __future__ import annotations

import numpy as np
import pytest

from asbuilt.dynamics import PositionServo
from asbuilt.errors import UsageError


def test_torque_is_the_law_of_each_joint_within_its_limit() -> None:
    servo = PositionServo(kp=(100.0, 10.0), kd=(2.0, 0.0), torque_limit=(5.0, 5.0))
    torque = servo.torque([[0.01, 0.3], [1.0, -1.0]], [[0.0, 0.1], [0.0, 0.0]], [[0.2, 9.0]] * 2)
    np.testing.assert_allclose(torque, [[1.0 - 0.4, 2.0], [5.0, -5.0]])


def test_unknown_gains_and_missing_limits_are_allowed() -> None:
    servo = PositionServo(kp=(np.nan, 10.0), kd=(2.0, np.nan))
    assert not servo.known
    assert servo.torque_limit == (np.inf, np.inf)
    assert servo.reordered([1]).kp == (10.0,)


@pytest.mark.parametrize(
    "wrong",
    [
        {"kd": (1.0,)},
        {"kp": (-1.0, 1.0)},
        {"torque_limit": (1.0,)},
        {"delay": np.nan},
        {"deadband": (-1.0, 0.0)},
        {"lead": (-0.1, 0.0)},
        {"lead": (np.inf, 0.0)},
        {"no_load_speed": (1.0, 1.0)},
        {"no_load_speed": (0.0, 1.0), "torque_limit": (1.0, 1.0)},
    ],
)
def test_impossible_values_are_refused(wrong: dict[str, object]) -> None:
    with pytest.raises(UsageError):
        PositionServo(**({"kp": (1.0, 1.0), "kd": (0.0, 0.0)} | wrong))  # type: ignore[arg-type]


def test_deadband_and_voltage_act_as_written_out_by_hand() -> None:
    servo = PositionServo(
        kp=(100.0, 10.0),
        kd=(2.0, 0.0),
        torque_limit=(5.0, 4.0),
        deadband=(0.01, 0.5),
        no_load_speed=(10.0, np.inf),
    )
    assert not servo.proportional
    torque = servo.torque(
        [[0.03, 0.4], [1.0, -2.0], [1.0, 0.0]], np.zeros((3, 2)), [[0.1, 3.0]] * 3
    )
    # 100 (.03 - .01) - 2 * .1; within the band; 5 (1 - .1 / 10); -10 * 1.5 beyond 4
    np.testing.assert_allclose(torque, [[1.8, 0.0], [4.95, -4.0], [4.95, 0.0]])
    backward = servo.torque([[-1.0, 0.0]], np.zeros((1, 2)), [[20.0, 0.0]])
    np.testing.assert_allclose(backward, [[-15.0, 0.0]])


def test_a_duty_cycle_that_saturates_is_the_same_law() -> None:
    stall, free_speed, duty_per_rad = 3.0, 4.7, 2.7
    error, speed = np.meshgrid(np.linspace(-1.0, 1.0, 21), np.linspace(-4.0, 4.0, 9))
    motor = stall * (np.clip(duty_per_rad * error, -1.0, 1.0) - speed / free_speed)
    servo = PositionServo(
        kp=(duty_per_rad * stall,),
        kd=(stall / free_speed,),
        torque_limit=(stall,),
        no_load_speed=(free_speed,),
    )
    found = servo.torque(error.reshape(-1, 1), 0.0, speed.reshape(-1, 1))
    np.testing.assert_allclose(found[:, 0], motor.ravel(), atol=1e-12)
