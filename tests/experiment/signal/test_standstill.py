import numpy as np

from asbuilt.experiment.signal.standstill import at_rest, moving_ranges, standstill_speeds


def test_a_reversal_is_no_standstill_but_a_pause_is():
    t = np.arange(0, 10, 0.01)
    qd = np.where(t < 5, np.cos(2 * np.pi * 0.5 * t), 0.0)
    qd = np.column_stack([qd, np.cos(2 * np.pi * 0.5 * t)])
    still = at_rest(qd, standstill_speeds([qd]), 100.0)
    assert not still[:, 1].any()
    assert still[501:, 0].all()
    assert not still[:499, 0].any()


def test_only_rests_of_all_joints_are_cut_and_shoulders_stay():
    still = np.zeros((1000, 2), bool)
    still[300:500] = True
    still[700:900, 0] = True
    still[950:] = True
    assert moving_ranges(still, 100.0, 20) == [(0, 320), (480, 970)]
    assert moving_ranges(np.ones((200, 2), bool), 100.0, 20) == []
    assert moving_ranges(np.zeros((200, 2), bool), 100.0, 20) == [(0, 200)]


def test_speeds_are_relative_to_each_joints_own_top_speed():
    qd = np.column_stack([np.full(100, 2.0), np.full(100, -1.0), np.full(100, 1e-6)])
    np.testing.assert_allclose(standstill_speeds([qd, 0.1 * qd]), [0.006, 0.003, 0.003])
