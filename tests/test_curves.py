"""Cubic splines against SciPy's, and roots."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.interpolate import CubicSpline as ScipySpline

from asbuilt.curves import CubicSpline, find_root


@pytest.mark.parametrize("n", [4, 5, 8, 300])
@pytest.mark.parametrize("derivative", [0, 1, 2, 3, 4])
def test_spline_is_that_of_scipy(n: int, derivative: int) -> None:
    random = np.random.default_rng(n)
    t = np.cumsum(random.uniform(0.5, 1.5, n))
    x = random.normal(size=(n, 3))
    at = np.concatenate([random.uniform(t[0] - 0.3, t[-1] + 0.3, 200), t])
    expected = ScipySpline(t, x, axis=0)(at, derivative)
    np.testing.assert_allclose(CubicSpline(t, x)(at, derivative), expected, rtol=0, atol=1e-12)


def test_spline_of_a_cubic_is_the_cubic() -> None:
    t = np.array([0.0, 1.0, 1.5, 3.0, 3.2])
    at = np.linspace(-1.0, 4.0, 50)
    spline = CubicSpline(t, (2.0 - t + 3.0 * t**3)[:, None])
    np.testing.assert_allclose(spline(at)[:, 0], 2.0 - at + 3.0 * at**3, atol=1e-11)
    np.testing.assert_allclose(spline(at, 1)[:, 0], -1.0 + 9.0 * at**2, atol=1e-11)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_root_is_found_to_rounding(sign: float) -> None:
    root = find_root(lambda x: sign * (np.cos(x) - 0.3), 0.0, 3.0)
    assert root == pytest.approx(np.arccos(0.3), abs=1e-15)
