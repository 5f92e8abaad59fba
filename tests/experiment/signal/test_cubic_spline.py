"""Cubic splines, and smoothed spectra, by SciPy."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import interpolate
from scipy.ndimage import uniform_filter1d

from asbuilt.experiment.signal.band_choice import SMOOTHED, _smooth
from asbuilt.experiment.signal.cubic_spline import CubicSpline


@pytest.mark.parametrize("count", [2, 3, 4, 5, 60])
@pytest.mark.parametrize("derivative", [0, 1, 2, 3])
def test_splines_are_those_of_scipy(count, derivative):
    rng = np.random.default_rng(count)
    times = np.cumsum(rng.uniform(0.5, 1.5, count))
    values = rng.normal(size=(count, 3))
    at = np.linspace(times[0] - 0.1, times[-1] + 0.1, 500)
    expected = interpolate.CubicSpline(times, values)(at, derivative)
    found = CubicSpline.through(times, values)(at, derivative)
    np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize(("ends", "mode"), [("symmetric", "reflect"), ("edge", "nearest")])
def test_smoothed_spectra_are_those_of_scipy(ends, mode):
    spectra = np.random.default_rng(0).exponential(size=(80, 3))
    expected = uniform_filter1d(spectra, SMOOTHED, axis=0, mode=mode)
    np.testing.assert_allclose(_smooth(spectra, ends), expected, rtol=1e-12)
