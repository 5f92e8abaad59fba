from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.interpolate import CubicSpline

from asbuilt.errors import MotionError
from asbuilt.excitation import SplineMotion

POINTS = np.random.default_rng(5).uniform(-2, 2, size=(8, 3))
TIMES = np.array([0.0, 0.7, 1.1, 2.0, 2.4, 3.5, 4.0, 5.2])
KINDS = [(3, "natural"), (5, "rest"), (5, "natural")]


def test_cubic_is_that_of_scipy() -> None:
    motion = SplineMotion.through(POINTS, TIMES, degree=3, ends="natural")
    oracle = CubicSpline(TIMES, POINTS, bc_type="natural")
    t = np.linspace(0, TIMES[-1], 301)
    for order in range(3):
        np.testing.assert_allclose(motion.derivative(t, order), oracle(t, nu=order), atol=1e-10)


@pytest.mark.parametrize(("degree", "ends"), KINDS)
def test_passes_the_way_points_with_continuous_derivatives(degree: int, ends: str) -> None:
    motion = SplineMotion.through(POINTS, TIMES, degree=degree, ends=ends)  # type: ignore[arg-type]
    np.testing.assert_allclose(motion.derivative(TIMES), POINTS, atol=1e-11)
    for order in range(degree):
        left, right = (
            motion.derivative(motion.breaks[1:-1] - 1e-10, order),
            motion.derivative(motion.breaks[1:-1] + 1e-10, order),
        )
        np.testing.assert_allclose(left, right, atol=1e-5 * (1 + motion.peaks(order).max()))


@pytest.mark.parametrize(
    ("degree", "ends", "orders"),
    [(3, "natural", (2,)), (5, "rest", (1, 2)), (5, "natural", (3, 4))],
)
def test_end_derivatives_vanish(degree: int, ends: str, orders: tuple[int, ...]) -> None:
    motion = SplineMotion.through(POINTS, TIMES, degree=degree, ends=ends)  # type: ignore[arg-type]
    for order in orders:
        np.testing.assert_allclose(
            motion.derivative([0.0, TIMES[-1]], order), 0.0, atol=1e-9 * motion.peaks(order).max()
        )


def test_natural_quintic_has_the_least_squared_jerk() -> None:
    natural = SplineMotion.through(POINTS[:, :1], TIMES, ends="natural")
    rest = SplineMotion.through(POINTS[:, :1], TIMES, ends="rest")
    # The first variation of the squared jerk vanishes in every direction that keeps the way points.
    difference = quad(
        lambda t: float(
            natural.derivative(t, 3)[0] * (rest.derivative(t, 3) - natural.derivative(t, 3))[0]
        ),
        0,
        TIMES[-1],
        points=TIMES[1:-1],
        limit=200,
    )[0]
    energy = quad(
        lambda t: float(natural.derivative(t, 3)[0] ** 2),
        0,
        TIMES[-1],
        points=TIMES[1:-1],
        limit=200,
    )[0]
    assert abs(difference) < 1e-7 * energy


@pytest.mark.parametrize("limits", [(1.5, 5.0, np.inf), (10.0, 2.0, np.inf), (2.0, 5.0, 8.0)])
def test_fastest_spline_attains_one_limit_and_keeps_the_others(
    limits: tuple[float, float, float],
) -> None:
    velocity, acceleration, jerk = limits
    motion = SplineMotion.within(POINTS, velocity=velocity, acceleration=acceleration, jerk=jerk)
    ratios = [motion.peaks(order).max() / limit for order, limit in enumerate(limits, start=1)]
    assert max(ratios) == pytest.approx(1.0, abs=1e-9)
    fine = motion.sample(2000)
    assert np.abs(fine.qd).max() <= velocity * (1 + 1e-9)
    assert np.abs(fine.qdd).max() <= acceleration * (1 + 1e-9)
    assert np.min(np.max(np.abs(fine.q[:, None] - POINTS), axis=2), axis=0).max() < 1e-2


def test_two_way_points_suffice() -> None:
    motion = SplineMotion.through([[0.0], [1.0]], [0.0, 2.0])
    np.testing.assert_allclose([motion.start, motion.end], [[0.0], [1.0]], atol=1e-12)
    np.testing.assert_allclose(
        np.abs([motion.derivative([0.0, 2.0], k) for k in (1, 2)]), 0, atol=1e-10
    )


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (
            lambda: SplineMotion.through(POINTS, TIMES, degree=4),
            r"degree 4 with ends 'rest'; choose from degree 3 'natural'",
        ),
        (lambda: SplineMotion.through(POINTS, TIMES, degree=3), "choose from"),
        (lambda: SplineMotion.through(POINTS, TIMES[::-1]), "rising times"),
        (lambda: SplineMotion.through(POINTS[:2], TIMES[:2], ends="natural"), "at least 3"),
        (lambda: SplineMotion.within(POINTS, velocity=np.inf, acceleration=np.inf), "finite"),
        (lambda: SplineMotion.within(POINTS * 0, velocity=1, acceleration=1), "nothing moves"),
    ],
)
def test_errors_say_what_is_wrong(call: object, message: str) -> None:
    with pytest.raises(MotionError, match=message):
        call()  # type: ignore[operator]
