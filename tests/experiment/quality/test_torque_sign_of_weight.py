"""Torques that never change sign: magnitudes, or an arm that gravity pulls to one side alone."""

from __future__ import annotations

import numpy as np
import pytest

from asbuilt.description import RobotModel, bundled_robot
from asbuilt.dynamics import inverse_dynamics
from asbuilt.experiment import Recording, check_recording


def recorded(*, magnitudes: bool) -> tuple[RobotModel, Recording]:
    """Two joints that hold a weight on one side, or swing through the vertical as magnitudes."""
    model = bundled_robot("two-link").with_gravity(np.array([0.0, -6.0, -8.0]))
    t = np.arange(0.0, 20.0, 0.01)
    amplitude = 2.5 if magnitudes else 0.4
    q = np.column_stack([amplitude * np.sin(0.9 * t), amplitude * np.sin(1.3 * t + 1.0)])
    qd, qdd = np.gradient(q, t, axis=0), np.gradient(np.gradient(q, t, axis=0), t, axis=0)
    tau = inverse_dynamics(model, q, qd, qdd)
    tau += 0.01 * np.random.default_rng(1).normal(size=tau.shape)
    tau = np.abs(tau) if magnitudes else tau
    recording = Recording(
        t=t, q=q, tau=tau, joint_names=model.joint_names, torque_source="sensor", source="log"
    )
    return model, recording


@pytest.mark.parametrize("magnitudes", [True, False])
def test_only_magnitudes_are_named(magnitudes: bool) -> None:
    model, recording = recorded(magnitudes=magnitudes)
    assert np.all(recording.tau >= 0.0)
    codes = [each.code for each in check_recording(model, recording).findings]
    assert ("torque_unsigned" in codes) is magnitudes
