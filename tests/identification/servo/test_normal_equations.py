"""Solutions of normal equations in the search for a servo's law, against SciPy's and NumPy's."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import nnls

from asbuilt.identification.servo.servo_fits import _solve_bounded


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
