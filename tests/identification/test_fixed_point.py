"""Extrapolated iterations, against the solution of the linear system that the fixed point is of."""

from __future__ import annotations

import numpy as np

from asbuilt.identification.estimators.least_squares import FixedPoint


def test_a_slow_linear_iteration_of_three_numbers_ends_after_five_steps() -> None:
    rng = np.random.default_rng(3)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    A, b = turn @ np.diag([0.9, 0.7, -0.5]) @ turn.T, rng.normal(size=3)
    solution = np.linalg.solve(np.eye(3) - A, b)
    ahead, x, plain = FixedPoint(), np.zeros(3), np.zeros(3)
    for _ in range(5):
        x = ahead.advance(x, A @ x + b)
        plain = A @ plain + b
    np.testing.assert_allclose(x, solution, rtol=1e-8)
    assert np.linalg.norm(plain - solution) > 0.1 * np.linalg.norm(solution)


def test_far_from_the_fixed_point_and_after_growth_steps_are_plain() -> None:
    ahead = FixedPoint(near=0.1)
    image = np.array([1.0])
    assert ahead.advance(np.array([0.0]), image) is image
    ahead = FixedPoint(near=0.1)
    near = np.array([1.05])
    assert ahead.advance(image, near) is near
    grown = np.array([1.14])
    assert ahead.advance(near, grown) is grown
