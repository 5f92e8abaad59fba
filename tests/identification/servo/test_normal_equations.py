"""Solutions of normal equations in the search for a servo's law, against SciPy's and NumPy's."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import nnls

from asbuilt.identification.servo.block_fits import solve_truncated
from asbuilt.identification.servo.servo_fits import _solve_bounded


def test_truncated_solution_is_the_least_one_of_dependent_columns() -> None:
    rng = np.random.default_rng(1)
    A = rng.normal(size=(40, 6)) * [1.0, 1e4, 1.0, 1.0, 1e-3, 1.0]
    A[:, 5] = A[:, 0]
    b = rng.normal(size=40)
    x = solve_truncated(A.T @ A, A.T @ b)
    whole, *_ = np.linalg.lstsq(A[:, :5], b, rcond=None)
    assert x[0] + x[5] == pytest.approx(whole[0], rel=1e-6)
    assert x[0] == pytest.approx(x[5], rel=1e-6)
    assert x[1:5] == pytest.approx(whole[1:], rel=1e-6)


def test_bounds_are_those_of_nonnegative_least_squares_from_any_guess() -> None:
    rng = np.random.default_rng(2)
    A, b = rng.normal(size=(50, 8)), rng.normal(size=50)
    expected, _ = nnls(A, b)
    inside = np.flatnonzero(expected > 0.0)
    assert 0 < inside.size < 8
    for near in (inside, np.arange(8), inside[:1]):
        x, free = _solve_bounded(A.T @ A, A.T @ b, np.zeros(8), near)
        assert x == pytest.approx(expected, abs=1e-9)
        assert free.tolist() == inside.tolist()
