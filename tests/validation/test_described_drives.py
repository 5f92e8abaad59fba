"""Damping and friction that a URDF states count to CAD where a recording is predicted better."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from asbuilt.description import DriveValues, RobotModel
from asbuilt.experiment import prepare_samples
from asbuilt.validation import validate_description, validate_samples
from asbuilt.workflow import identify
from fleet_logs import MODEL, recording


def described(viscous: float, coulomb: float) -> RobotModel:
    """The robot as a URDF states it, with damping and friction of every joint."""
    drive = DriveValues(viscous=viscous, coulomb=coulomb)
    joints = tuple(replace(joint, drive=drive) for joint in MODEL.joints)
    return replace(MODEL, joints=joints, drives_by_design=False)


@pytest.mark.parametrize(
    ("viscous", "coulomb", "helps"),
    [pytest.param(0.05, 0.2, True, marks=pytest.mark.study), (9.0, 9.0, False)],
)
def test_cad_has_its_drives_where_they_help(viscous: float, coulomb: float, helps: bool) -> None:
    """The second road predicts the description alone, with its drives or without."""
    model = described(viscous, coulomb)
    study = identify(model, [recording(1)])
    samples = prepare_samples(recording(2), study.result.chain)
    alone = model if helps else described(0.0, 0.0)
    expected = validate_description(alone, samples)
    found = validate_samples(study.result, samples)
    np.testing.assert_allclose(found.metrics_cad.rms, expected.rms, rtol=1e-9)
    without = validate_description(described(0.0, 0.0), samples)
    assert (expected.relative_error < without.relative_error) is helps
