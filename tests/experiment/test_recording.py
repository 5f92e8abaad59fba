"""The recording: validated once, frozen, and reordered without mixing joints."""

from __future__ import annotations

import numpy as np
import pytest

from asbuilt.errors import RecordingError
from asbuilt.experiment import Recording


def three_joints() -> Recording:
    rng = np.random.default_rng(1)
    return Recording(
        t=np.arange(50) / 100,
        q=rng.normal(size=(50, 3)),
        tau=rng.normal(size=(50, 3)),
        qd=rng.normal(size=(50, 3)),
        joint_names=("a", "b", "c"),
        source="log.csv",
        extra={"tau_ext": rng.normal(size=(50, 3)), "temperature": rng.normal(size=50)},
    )


def test_rate_and_duration() -> None:
    recording = three_joints()
    assert recording.rate == pytest.approx(100)
    assert recording.duration == pytest.approx(0.49)
    assert (recording.n_samples, recording.n_joints) == (50, 3)


def test_rate_is_the_median_of_an_uneven_clock() -> None:
    t = np.cumsum([0.0, 0.01, 0.01, 0.01, 5.0, 0.01, 0.01])
    assert Recording(t, np.zeros((7, 1)), np.zeros((7, 1))).rate == pytest.approx(100)


def test_arrays_are_read_only_and_the_caller_keeps_his() -> None:
    q = np.zeros((4, 1))
    recording = Recording(np.arange(4.0), q, np.zeros((4, 1)))
    with pytest.raises(ValueError, match="read-only"):
        recording.q[0, 0] = 1
    q[0, 0] = 7
    assert recording.q[0, 0] == 0


def test_flipping_twice_gives_the_recording_back() -> None:
    recording = three_joints()
    again = recording.flipped().flipped()
    np.testing.assert_array_equal(again.tau, recording.tau)
    np.testing.assert_array_equal(recording.flipped().extra["tau_ext"], -recording.extra["tau_ext"])
    np.testing.assert_array_equal(
        recording.flipped().extra["temperature"], recording.extra["temperature"]
    )


def test_reordering_moves_whole_joints() -> None:
    recording = three_joints()
    turned = recording.reordered(("c", "a"))
    assert turned.joint_names == ("c", "a")
    for name in ("q", "qd", "tau"):
        np.testing.assert_array_equal(getattr(turned, name), getattr(recording, name)[:, [2, 0]])
    np.testing.assert_array_equal(turned.extra["tau_ext"], recording.extra["tau_ext"][:, [2, 0]])


def test_gains_multiply_columns() -> None:
    recording = three_joints()
    np.testing.assert_allclose(recording.scaled([1, 2, 3]).tau, recording.tau * [1, 2, 3])
    np.testing.assert_allclose(recording.scaled(2).tau, recording.tau * 2)


def test_between_is_half_open() -> None:
    part = three_joints().between(0.1, 0.2)
    assert part.n_samples == 10
    assert part.t[0] == pytest.approx(0.1)
    assert part.extra["temperature"].shape == (10,)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"tau": np.zeros((50, 2))}, r"tau must have the shape of q, \(50, 3\), got \(50, 2\)"),
        ({"q": np.zeros((49, 3))}, r"q must have shape \(50, n_joints\)"),
        ({"t": np.zeros(0)}, "at least one time"),
        ({"joint_names": ("a", "b")}, "3 columns in q but 2 joint names"),
        ({"joint_names": ("a", "b", "a")}, "joint name 'a' is used 2 times"),
        (
            {"torque_source": "guess"},
            "torque_source 'guess' is not one of sensor, motor, current, command, unknown",
        ),
        ({"extra": {"tau_ext": np.zeros((3, 3))}}, "tau_ext has shape"),
        ({"q": [["x"] * 3] * 50}, "q is not an array of numbers"),
    ],
)
def test_impossible_recordings_are_refused(change: dict, message: str) -> None:
    good = {"t": np.arange(50) / 100, "q": np.zeros((50, 3)), "tau": np.zeros((50, 3))}
    with pytest.raises(RecordingError, match=message):
        Recording(**(good | change))


@pytest.mark.parametrize(
    ("gain", "message"),
    [([1, 2], "2 gains for 3 joints"), ([1, 0, 2], "not zero"), (float("nan"), "finite")],
)
def test_impossible_gains_are_refused(gain: object, message: str) -> None:
    with pytest.raises(RecordingError, match=message):
        three_joints().scaled(gain)


def test_missing_joints_and_empty_stretches_are_refused() -> None:
    with pytest.raises(RecordingError, match="has no joint 'd'; it has a, b, c"):
        three_joints().reordered(("a", "d"))
    with pytest.raises(RecordingError, match="no sample between 7 s and 8 s"):
        three_joints().between(7, 8)
