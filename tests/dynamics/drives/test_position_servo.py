"""The law of a position servo, term by term, and what it refuses."""

from __future__ import annotations

import numpy as np
import pytest

from asbuilt.dynamics.drives.position_servo import PositionServo
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
    "wrong", [{"kd": (1.0,)}, {"kp": (-1.0, 1.0)}, {"torque_limit": (1.0,)}, {"delay": np.nan}]
)
def test_impossible_values_are_refused(wrong: dict[str, object]) -> None:
    with pytest.raises(UsageError):
        PositionServo(**({"kp": (1.0, 1.0), "kd": (0.0, 0.0)} | wrong))  # type: ignore[arg-type]
