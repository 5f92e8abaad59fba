"""The law of a servo in a search, where a joint has no servo."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from asbuilt.dynamics import PositionServo
from asbuilt.identification.trajectories.refined_fit import derive_refined_law
from asbuilt.identification.trajectories.simulated_robot import FittedLaw, ServoCoordinates


def test_a_joint_without_a_servo_hides_no_error_of_the_stiffness() -> None:
    """Joint 1 has no stiffness; that of joint 2 is 50 +- 5."""
    law = FittedLaw(PositionServo(kp=(0.0, 50.0), kd=(0.0, 1.0)), ServoCoordinates(stiffness=True))
    objective: Any = SimpleNamespace(
        start=SimpleNamespace(law=law),
        trajectories=SimpleNamespace(base=SimpleNamespace(n_base=1)),
    )
    point: Any = SimpleNamespace(law=law)
    refined = derive_refined_law(objective, point, np.diag([1.0, 0.0, 25.0, 0.0, 0.0, 0.0, 0.0]))
    assert refined.stiffness_error == pytest.approx(0.1)


def test_the_coordinates_of_a_law_lead_back_to_it() -> None:
    free = ServoCoordinates(stiffness=True, delay=True, lead=True)
    start = FittedLaw(PositionServo(kp=(0.0, 50.0), kd=(0.0, 1.0), delay=0.01), free)
    step = np.array([0.3, 2.0, 4.0])
    np.testing.assert_allclose(start.moved(step).away(start), step)
    assert start.moved(step).stiffness_factor(start) == pytest.approx(np.exp(0.3))
