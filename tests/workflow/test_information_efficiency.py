"""A recording that moves little is told from one that moves well."""

from __future__ import annotations

import json
from types import SimpleNamespace

import numpy as np
import pytest

from asbuilt.description import load_robot
from asbuilt.dynamics import DriveSet
from asbuilt.excitation import MotionBounds, information_efficiency, random_fourier
from asbuilt.experiment import Recording, VirtualRobot
from asbuilt.workflow import recorded_information


@pytest.fixture(scope="module")
def recording() -> Recording:
    model = load_robot("two-link")
    return (
        VirtualRobot.ideal(model)
        .record(random_fourier(model, rng=1, duration=10.0, n_harmonics=8), rate=200.0)
        .recording
    )


def test_wide_motion_carries_more_than_timid_motion(recording: Recording) -> None:
    model = load_robot("two-link")
    wide = recorded_information(model, recording)
    timid = recorded_information(
        model,
        Recording(
            recording.t, 0.05 * recording.q, recording.tau, joint_names=recording.joint_names
        ),
    )
    assert 0.0 < timid.efficiency.d_efficiency < 0.2 * wide.efficiency.d_efficiency < 1.0
    assert set(wide.too_little) <= set(timid.too_little)


def test_a_still_joint_is_named(recording: Recording) -> None:
    q = recording.q.copy()
    q[:, 1] = 0.3
    still = recorded_information(
        load_robot("two-link"),
        Recording(recording.t, q, recording.tau, joint_names=recording.joint_names),
    )
    assert recording.joint_names[1] in still.too_little
    assert still.efficiency.d_efficiency == 0.0
    assert "moved too little" in " ".join(still.as_text().split())
    json.dumps(still.as_document(), allow_nan=False)
    assert np.all(still.efficiency.by_joint >= 0)
    assert still.std_error_ratios[1] == np.inf
    assert still.as_document()["std_error_ratio"][recording.joint_names[1]] is None
    assert f"{recording.joint_names[1]} 0 %" in still.as_text()


def test_the_text_names_slow_joints_and_small_ranges(recording: Recording) -> None:
    """Travel and top speed are those of the motion that was sampled.

    A slower one is called slow, a smaller one small.
    """
    model = load_robot("two-link")
    wide = recorded_information(model, recording)
    bounds = MotionBounds.assumed(model)
    travel = np.ptp(recording.q, axis=0) / np.minimum(bounds.upper - bounds.lower, 2 * np.pi)
    np.testing.assert_allclose(wide.travel, travel, rtol=0.02)
    slow = recorded_information(
        model,
        Recording(
            10.0 * recording.t, recording.q, recording.tau, joint_names=recording.joint_names
        ),
    )
    np.testing.assert_allclose(slow.top_speed, wide.top_speed / 10, rtol=0.05)
    assert "% of the speed limit" in " ".join(slow.as_text().split())
    small = recorded_information(
        model,
        Recording(
            recording.t, 0.02 * recording.q, recording.tau, joint_names=recording.joint_names
        ),
    )
    assert "% of the range" in " ".join(small.as_text().split())


def test_the_worst_parameter_is_that_of_least_information(recording: Recording) -> None:
    """The ratio of standard errors comes from the covariances.

    Own observation matrix against the bound's information.
    """
    model = load_robot("two-link")
    found = recorded_information(model, recording)
    base = found.efficiency.base
    for k, worst in enumerate(found.efficiency.worst):
        assert worst is not None
        own = [p for p, name in enumerate(base.names) if name.endswith(str(k + 1))]
        assert worst in own
        assert found.std_error_ratios[k] == pytest.approx(
            1 / np.sqrt(min(found.efficiency.by_parameter[own]))
        )


def test_noise_is_no_information_beyond_the_bound():
    """Accelerations of coarse positions exceed every limit; the efficiency does not exceed 1."""
    model = load_robot("two-link")
    rng = np.random.default_rng(1)
    states = SimpleNamespace(
        q=rng.uniform(-3, 3, (400, 2)),
        qd=rng.normal(0.0, 5.0, (400, 2)),
        qdd=rng.normal(0.0, 5000.0, (400, 2)),
    )
    found = information_efficiency(model, DriveSet.parse("viscous,coulomb,offset"), states)
    assert 0.0 < found.d_efficiency <= 1.0
    assert np.all(found.beyond > 50.0)
