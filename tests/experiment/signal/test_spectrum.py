"""Power spectra against those of SciPy."""

import numpy as np
import pytest
from scipy import signal

from asbuilt.experiment.signal.band_choice import power_density


@pytest.mark.parametrize("window", ["hann", "blackmanharris"])
@pytest.mark.parametrize("centred", [True, False])
@pytest.mark.parametrize(("samples", "length"), [(1000, 200), (999, 201), (200, 200), (431, 57)])
def test_the_density_is_that_of_scipy(samples, length, centred, window):
    x = 3.0 + np.cumsum(np.random.default_rng(samples).normal(size=(samples, 3)), axis=0)
    frequency, expected = signal.welch(
        x,
        250.0,
        window=window,
        nperseg=length,
        detrend="constant" if centred else False,
        axis=0,
    )
    found = power_density(x, 250.0, length, window=window, centred=centred)
    np.testing.assert_allclose(found, expected, rtol=1e-10, atol=1e-14 * expected.max())
    np.testing.assert_allclose(np.fft.rfftfreq(length, 1.0 / 250.0), frequency)
