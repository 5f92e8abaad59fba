import numpy as np
import pytest

from asbuilt.experiment.signal.differentiation import (
    estimate_standstill_speeds,
    find_moving_ranges,
    find_rests,
)
from asbuilt.experiment.signal.lowpass import butterworth


def test_a_reversal_is_no_standstill_but_a_pause_is():
    t = np.arange(0, 10, 0.01)
    qd = np.where(t < 5, np.cos(2 * np.pi * 0.5 * t), 0.0)
    qd = np.column_stack([qd, np.cos(2 * np.pi * 0.5 * t)])
    still = find_rests(
        qd, estimate_standstill_speeds([(np.cumsum(qd, axis=0) / 100.0, qd)], 7.0), 100.0
    )
    assert not still[:, 1].any()
    assert still[501:, 0].all()
    assert not still[:499, 0].any()


def test_only_rests_of_all_joints_are_cut_and_shoulders_stay():
    still = np.zeros((1000, 2), bool)
    still[300:500] = True
    still[700:900, 0] = True
    still[950:] = True
    assert find_moving_ranges(still, 100.0, 20) == [(0, 320), (480, 970)]
    assert find_moving_ranges(np.ones((200, 2), bool), 100.0, 20) == []
    assert find_moving_ranges(np.zeros((200, 2), bool), 100.0, 20) == [(0, 200)]


def test_speeds_are_relative_to_each_joints_own_top_speed():
    qd = np.column_stack([np.full(100, 2.0), np.full(100, -1.0), np.full(100, 1e-6)])
    still = np.zeros_like(qd)
    speeds = estimate_standstill_speeds([(still, qd), (still, 0.1 * qd)], 7.0)
    np.testing.assert_allclose(speeds, [0.006, 0.003, 0.003])


def test_a_finger_in_metres_moves_beside_joints_in_radians_and_noise_does_not():
    """Its speed of 3 mm/s is a sixth of its top speed, and .15 % of that of the joint."""
    t = np.arange(0.0, 20.0, 0.01)
    phase = 2 * np.pi * 0.2 * t
    q = np.column_stack([1.6 * np.sin(phase), 0.016 * np.sin(phase), 0.0 * t])
    noise = 1e-5 * np.random.default_rng(0).normal(size=(len(t), 1))
    q[:, 2] = butterworth(noise, cutoff=7.0, rate=100.0, order=4)[:, 0]
    qd = np.gradient(q, t, axis=0)
    fast, finger, held = estimate_standstill_speeds([(q, qd)], 7.0)
    assert fast == pytest.approx(0.006, rel=0.02)
    assert finger == pytest.approx(0.006 * 0.02, rel=0.02)
    assert held == pytest.approx(0.003, rel=0.02)
