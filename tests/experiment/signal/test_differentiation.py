import numpy as np
import pytest

from asbuilt.errors import UsageError
from asbuilt.experiment.signal.differentiation import (
    central_differences,
    savitzky_golay,
    savitzky_golay_window,
    smoothing_spline,
)

RATE = 200.0
T = np.arange(0, 10, 1 / RATE)


def test_central_differences_are_exact_on_parabolas_to_the_ends():
    x = np.column_stack([1 + 2 * T - 3 * T**2, T**2])
    np.testing.assert_allclose(
        central_differences(x, RATE), np.column_stack([2 - 6 * T, 2 * T]), atol=1e-9
    )


def test_central_differences_scale_a_sine_by_sinc():
    w = 2 * np.pi * 5.0
    expected = np.sin(w / RATE) / (w / RATE) * w * np.cos(w * T)
    np.testing.assert_allclose(
        central_differences(np.sin(w * T), RATE)[1:-1], expected[1:-1], atol=1e-9
    )


def test_savitzky_golay_is_exact_on_polynomials_to_the_ends():
    x = (1 - T + 0.5 * T**2 - 0.1 * T**3 + 0.01 * T**4)[:, None]
    q, qd, qdd = savitzky_golay(x, RATE, cutoff=8.0)
    np.testing.assert_allclose(q, x, atol=1e-9)
    np.testing.assert_allclose(qd[:, 0], -1 + T - 0.3 * T**2 + 0.04 * T**3, atol=1e-8)
    np.testing.assert_allclose(qdd[:, 0], 1 - 0.6 * T + 0.12 * T**2, atol=1e-6)


@pytest.mark.parametrize("method", [savitzky_golay, smoothing_spline])
@pytest.mark.parametrize("cutoff", [4.0, 10.0])
def test_smoothers_have_minus_3_db_near_the_cutoff_and_no_phase(method, cutoff):
    w = 2 * np.pi * cutoff
    q = method(np.sin(w * T)[:, None], RATE, cutoff=cutoff)[0][:, 0]
    inside = slice(500, 1500)
    sine, cosine = np.sin(w * T[inside]), np.cos(w * T[inside])
    assert 2 * np.mean(q[inside] * sine) == pytest.approx(
        np.sqrt(0.5), abs=0.06 if method is savitzky_golay else 0.01
    )
    assert abs(np.mean(q[inside] * cosine)) < 1e-3


@pytest.mark.parametrize("method", [savitzky_golay, smoothing_spline])
def test_smoothers_differentiate_slow_sines(method):
    w = 2 * np.pi * 0.5
    q, qd, qdd = method(np.sin(w * T)[:, None], RATE, cutoff=8.0)
    inside = slice(200, -200)
    np.testing.assert_allclose(q[inside, 0], np.sin(w * T[inside]), atol=1e-4)
    np.testing.assert_allclose(qd[inside, 0], w * np.cos(w * T[inside]), atol=1e-3 * w)
    np.testing.assert_allclose(qdd[inside, 0], -(w**2) * np.sin(w * T[inside]), atol=1e-3 * w**2)


def test_smoothing_spline_keeps_straight_lines():
    q, qd, qdd = smoothing_spline((2 + 3 * T)[:, None], RATE, cutoff=5.0)
    np.testing.assert_allclose(q[:, 0], 2 + 3 * T, atol=1e-7)
    np.testing.assert_allclose(qd, 3.0, atol=1e-6)
    np.testing.assert_allclose(qdd, 0.0, atol=1e-3)


def test_impossible_smoothing_is_refused_with_numbers():
    with pytest.raises(UsageError, match="between 0 and 100 Hz"):
        savitzky_golay(np.zeros((50, 1)), RATE, cutoff=100.0)
    with pytest.raises(UsageError, match="but the segment has 20"):
        savitzky_golay(np.zeros((20, 1)), RATE, cutoff=1.0)
    with pytest.raises(UsageError, match="at least 3 samples"):
        central_differences(np.zeros(2), RATE)
    assert savitzky_golay_window(50.0, RATE) % 2 == 1
