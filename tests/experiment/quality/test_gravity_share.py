"""Logs whose torques lack gravity, or a part of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
from pinocchio_oracle import pinocchio_model

from asbuilt.description import RobotModel, bundled_robot
from asbuilt.excitation import random_fourier
from asbuilt.experiment import Recording, check_recording, simulate_recording


def subtract_gravity(model: RobotModel, recording: Recording, share: float) -> Recording:
    """Return a recording less a share of the torque of gravity, by Pinocchio."""
    robot = pinocchio_model(model)
    data = robot.createData()
    weight = np.array([pin.computeGeneralizedGravity(robot, data, q) for q in recording.q])
    return replace(recording, tau=recording.tau - share * weight)


@pytest.mark.parametrize(("share", "code"), [(1.0, "gravity_absent"), (0.5, "gravity_partial")])
def test_a_log_without_gravity_is_named_with_its_cure(share: float, code: str) -> None:
    model = bundled_robot("ur10e")
    log = simulate_recording(model, random_fourier(model, rng=5), rate=100.0, rng=6)
    check = check_recording(model, subtract_gravity(model, log, share))
    found = {finding.code: finding for finding in check.findings}
    assert found[code].severity == ("error" if share == 1.0 else "warning")
    cure = found[code].cure
    assert cure is not None
    said = [float(part) for part in cure.settings["gravity"].split(",")]
    assert said == pytest.approx([0.0, 0.0, -9.81 * (1.0 - share)], abs=0.01)
    whole = check_recording(model, log)
    assert not {"gravity_absent", "gravity_partial"} & set(whole.codes)
    stated = check_recording(model.with_gravity(said), subtract_gravity(model, log, share))
    assert not {"gravity_absent", "gravity_partial", "gravity_direction"} & set(stated.codes)
