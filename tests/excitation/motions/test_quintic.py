from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import BPoly

from asbuilt.errors import MotionError
from asbuilt.excitation import QuinticMotion

number = st.floats(-3, 3, allow_nan=False)


@settings(max_examples=50, deadline=None)
@given(st.lists(st.tuples(number, number, number), min_size=2, max_size=6), st.floats(0.2, 5))
def test_agrees_with_scipy_hermite_interpolation(
    states: list[tuple[float, float, float]], step: float
) -> None:
    array = np.array(states)
    times = step * np.arange(len(states))
    motion = QuinticMotion.through(array[:, :1], times, array[:, 1:2], array[:, 2:])
    oracle = BPoly.from_derivatives(times, [list(state) for state in states])
    t = np.linspace(0, times[-1], 97)
    for order in range(4):
        expected = oracle(t, nu=order)
        np.testing.assert_allclose(
            motion.derivative(t, order)[:, 0], expected, atol=1e-9 * (1 + np.abs(expected).max())
        )


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([np.inf, 40.0]))
def test_fastest_motion_attains_one_limit_exactly_in_every_step(seed: int, jerk: float) -> None:
    rng = np.random.default_rng(seed)
    poses = rng.uniform(-3, 3, size=(2, 4))
    limits = [rng.uniform(0.3, 3, size=4), rng.uniform(0.5, 20, size=4), np.full(4, jerk)]
    motion = QuinticMotion.within(poses, velocity=limits[0], acceleration=limits[1], jerk=limits[2])
    ratios = [np.max(motion.peaks(order) / limit) for order, limit in enumerate(limits, start=1)]
    assert max(ratios) == pytest.approx(1.0, abs=1e-9)


def test_boundary_values_are_met() -> None:
    motion = QuinticMotion.between(
        [0.1, 0.2],
        [1.0, -1.0],
        1.5,
        start_velocity=[0.3, 0.4],
        end_velocity=0.5,
        start_acceleration=-1.0,
        end_acceleration=2.0,
    )
    for t, expected in (
        (0.0, ([0.1, 0.2], [0.3, 0.4], [-1, -1])),
        (1.5, ([1.0, -1.0], [0.5, 0.5], [2, 2])),
    ):
        for value, wanted in zip(motion.at(t), expected, strict=True):
            np.testing.assert_allclose(value, wanted, atol=1e-12)


def test_dwell_and_repeated_poses() -> None:
    motion = QuinticMotion.within(
        [[0.0], [1.0], [1.0], [0.0]], velocity=1.0, acceleration=100.0, dwell=0.5
    )
    assert motion.duration == pytest.approx(2 * 15 / 8 + 2 * 0.5)
    np.testing.assert_array_equal(motion.derivative([1.9, 2.4, 2.8])[:, 0], 1.0)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: QuinticMotion.between([0.0], [1.0], 0.0), "rising times"),
        (lambda: QuinticMotion.between([0.0], [np.nan], 1.0), "row 2, joint 1"),
        (
            lambda: QuinticMotion.through([[0.0], [1.0]], [0.0, 1.0, 2.0]),
            "2 poses need as many rising times",
        ),
        (
            lambda: QuinticMotion.through([[0.0], [1.0]], [0.0, 1.0], [[0.0]] * 3),
            "shape of the poses",
        ),
        (lambda: QuinticMotion.within([[0.0]], velocity=1, acceleration=1), "at least 2 rows"),
        (
            lambda: QuinticMotion.within([[0.0], [1.0]], velocity=-1, acceleration=1),
            "velocity limit of joint 1 must be positive, got -1",
        ),
        (
            lambda: QuinticMotion.within([[0.0], [1.0]], velocity=[1, 2, 3], acceleration=1),
            "one number or one per joint",
        ),
        (lambda: QuinticMotion.within([[0.0], [0.0]], velocity=1, acceleration=1), "nothing moves"),
        (
            lambda: QuinticMotion.within([[0.0], [1.0]], velocity=1, acceleration=1, dwell=-1),
            "dwell",
        ),
        (
            lambda: QuinticMotion.within([[0.0], [1.0]], velocity=np.inf, acceleration=np.inf),
            "finite",
        ),
    ],
)
def test_errors_say_what_is_wrong(call: object, message: str) -> None:
    with pytest.raises(MotionError, match=message):
        call()  # type: ignore[operator]
