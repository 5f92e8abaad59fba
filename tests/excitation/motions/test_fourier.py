from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from asbuilt.errors import MotionError
from asbuilt.excitation import BSplineMotion, FourierMotion


@settings(max_examples=40, deadline=None)
@given(st.integers(2, 12), st.floats(0.5, 60), st.integers(1, 3), st.integers(0, 2**32 - 1))
def test_any_coefficients_are_at_rest_at_both_ends(
    harmonics: int, period: float, periods: int, seed: int
) -> None:
    rows = np.random.default_rng(seed).normal(size=(2 * harmonics - 1, 2))
    motion = FourierMotion(rows, period, periods)
    w = 2 * np.pi / period
    for end in (0.0, motion.duration):
        q, qd, qdd = motion.at(end)
        np.testing.assert_allclose(q, rows[0], atol=1e-12)
        np.testing.assert_allclose(qd, 0.0, atol=1e-11 * w)
        np.testing.assert_allclose(qdd, 0.0, atol=1e-11 * w**2)


@pytest.mark.parametrize("harmonics", [2, 5, 9])
def test_is_the_series_of_swevers(harmonics: int) -> None:
    motion = FourierMotion(
        np.random.default_rng(harmonics).normal(size=(2 * harmonics - 1, 3)), 12.0
    )
    w = 2 * np.pi / motion.period
    orders = np.arange(1, harmonics + 1)
    sines, cosines = motion.coefficients[1:harmonics], motion.coefficients[harmonics:]
    a = w * np.vstack([-sines.sum(axis=0), sines])
    b = w * np.vstack([-cosines.sum(axis=0), cosines / orders[1:, None]])
    q0 = motion.coefficients[0] + (b / (w * orders[:, None])).sum(axis=0)
    np.testing.assert_allclose(a.sum(axis=0), 0, atol=1e-12)
    np.testing.assert_allclose(orders @ b, 0, atol=1e-12)
    t = np.linspace(0, 12.0, 200)
    phase = np.outer(t, orders) * w
    q, qd, qdd = motion.at(t)
    np.testing.assert_allclose(
        q,
        q0
        + np.sin(phase) @ (a / (w * orders[:, None]))
        - np.cos(phase) @ (b / (w * orders[:, None])),
        atol=1e-12,
    )
    np.testing.assert_allclose(qd, np.cos(phase) @ a + np.sin(phase) @ b, atol=1e-12)
    np.testing.assert_allclose(
        qdd,
        -np.sin(phase) @ (a * w * orders[:, None]) + np.cos(phase) @ (b * w * orders[:, None]),
        atol=1e-11,
    )


def test_holds_no_frequency_above_the_last_harmonic() -> None:
    motion = FourierMotion(np.random.default_rng(0).normal(size=(9, 1)), 10.0)
    spectrum = np.abs(np.fft.rfft(motion.derivative(np.arange(1000) / 100.0)[:, 0]))
    assert spectrum[6:].max() < 1e-12 * spectrum[1:6].max()


def test_periods_repeat() -> None:
    motion = FourierMotion(np.random.default_rng(0).normal(size=(7, 2)), 3.0, periods=4)
    t = np.linspace(0, 3.0, 31)
    for order in range(4):
        np.testing.assert_allclose(
            motion.derivative(t + 6.0, order), motion.derivative(t, order), atol=1e-10
        )


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(2, 12))
def test_b_spline_stays_within_its_control_points(seed: int, count: int) -> None:
    points = np.random.default_rng(seed).normal(size=(count, 2))
    motion = BSplineMotion(points, 5.0)
    q = motion.derivative(np.linspace(0, 5.0, 300))
    assert np.all(q >= points.min(axis=0) - 1e-12)
    assert np.all(q <= points.max(axis=0) + 1e-12)
    np.testing.assert_allclose([motion.start, motion.end], points[[0, -1]], atol=1e-12)
    np.testing.assert_allclose(motion.basis(np.linspace(0, 5.0, 50)).sum(axis=1), 1.0, atol=1e-12)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: FourierMotion(np.zeros((4, 2)), 1.0), "2 L - 1 rows"),
        (lambda: FourierMotion(np.zeros((1, 2)), 1.0), "at least 3 rows"),
        (lambda: FourierMotion(np.zeros((3, 2)), 0.0), "period must be a positive"),
        (lambda: FourierMotion(np.zeros((3, 2)), 1.0, periods=0), "whole number of periods"),
        (lambda: BSplineMotion(np.zeros((1, 2)), 1.0), "at least 2 rows"),
        (lambda: BSplineMotion(np.zeros((3, 2)), -1.0), "duration must be a positive"),
    ],
)
def test_errors_say_what_is_wrong(call: object, message: str) -> None:
    with pytest.raises(MotionError, match=message):
        call()  # type: ignore[operator]
