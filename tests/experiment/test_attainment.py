"""A recording that moves little is told from one that moves well."""

from __future__ import annotations

import json

import numpy as np
import pytest

from asbuilt.description.load import load_robot
from asbuilt.excitation.random_motion import random_fourier
from asbuilt.experiment.attainment import recorded_information
from asbuilt.experiment.recording import Recording
from asbuilt.experiment.simulation import InstalledRobot


@pytest.fixture(scope="module")
def recording() -> Recording:
    model = load_robot("two-link")
    return InstalledRobot.ideal(model).record(random_fourier(model, rng=1, duration=10.0, n_harmonics=8), 200.0).recording


def test_wide_motion_carries_more_than_timid_motion(recording: Recording) -> None:
    model = load_robot("two-link")
    wide = recorded_information(model, recording)
    timid = recorded_information(model, Recording(recording.t, 0.05 * recording.q, recording.tau, joint_names=recording.joint_names))
    assert 0.0 < timid.efficiency.d_efficiency < 0.2 * wide.efficiency.d_efficiency < 1.0
    assert set(wide.too_little) <= set(timid.too_little)


def test_a_standing_joint_is_named(recording: Recording) -> None:
    q = recording.q.copy()
    q[:, 1] = 0.3
    standing = recorded_information(load_robot("two-link"), Recording(recording.t, q, recording.tau, joint_names=recording.joint_names))
    assert recording.joint_names[1] in standing.too_little
    assert standing.efficiency.d_efficiency == 0.0
    assert "moved too little" in standing.as_text().lower()
    json.dumps(standing.as_document(), allow_nan=False)
    assert np.all(standing.efficiency.by_joint >= 0)
