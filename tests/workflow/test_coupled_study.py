"""A study of a robot with joints that follow others, from recording to review."""

from __future__ import annotations

import numpy as np
import pytest

from asbuilt.description import LinkInertia
from asbuilt.excitation import random_fourier
from asbuilt.experiment import simulate_recording
from asbuilt.identification import choose_payload_frame
from asbuilt.validation import review_result
from asbuilt.workflow import Study, StudyOptions, identify
from coupled_robots import palletizer

CARRIED = LinkInertia.from_com(0.8, [0.02, 0.01, 0.05], 1e-3 * np.eye(3))


@pytest.fixture(scope="module")
def study() -> Study:
    model = palletizer()
    motion = random_fourier(model, rng=3, duration=12.0)
    log = simulate_recording(model, motion, rate=100.0, tool=CARRIED)
    return identify(
        model,
        [log],
        options=StudyOptions(drive="armature,viscous,coulomb", method="wls", checked=False),
    )


def test_fingers_carry_no_tool(study: Study) -> None:
    assert choose_payload_frame(study.result.model)[:2] == ("l_a6", 3)
    result = study.result
    truth = result.model.parameters
    truth[30:40] += CARRIED.parameters
    drives = np.concatenate([[j.drive.armature, 1.0, 1.0] for j in result.model.joints])
    expected = result.base.values(np.concatenate([truth, drives]))
    far = np.abs(result.estimates - expected) / np.maximum(result.std_errors, 1e-4)
    assert np.mean(far < 3.0) > 0.9


def test_numbers_of_followers_are_reviewed(study: Study) -> None:
    claims = review_result(study.result).claims
    assert {"level", "f2", "f3"} <= {claim.joint for claim in claims}
