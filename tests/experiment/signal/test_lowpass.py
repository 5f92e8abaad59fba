import numpy as np
import pytest
from scipy import signal

from asbuilt.errors import UsageError
from asbuilt.experiment.signal.lowpass import (
    butterworth,
    butterworth_sections,
    decimate_chebyshev,
    gaussian,
    settling_samples,
    single_pass_cutoff,
)

RATE = 500.0


def sine(frequency, seconds=20.0, phase=0.3):
    return np.sin(2 * np.pi * frequency * np.arange(0, seconds, 1 / RATE) + phase)


def gain_and_phase(x, y, frequency):
    n = round(round(8.0 * frequency) / frequency * RATE)
    inside = slice(int(6 * RATE), int(6 * RATE) + n)
    tone = np.exp(-2j * np.pi * frequency * np.arange(n) / RATE)
    ratio = (y[inside] @ tone) / (x[inside] @ tone)
    return abs(ratio), np.angle(ratio)


@pytest.mark.parametrize("order", [1, 2, 4, 6])
def test_the_double_pass_has_minus_3_db_at_the_cutoff_and_no_phase(order):
    for frequency, expected in ((10.0, np.sqrt(0.5)), (5.0, None), (20.0, None)):
        x = sine(frequency)
        gain, phase = gain_and_phase(
            x, butterworth(x, cutoff=10.0, rate=RATE, order=order), frequency
        )
        ratio = np.tan(np.pi * frequency / RATE) / np.tan(np.pi * 10.0 / RATE)
        assert gain == pytest.approx(
            expected or 1 / (1 + (np.sqrt(2) - 1) * ratio ** (2 * order)), abs=2e-6
        )
        assert abs(phase) < 1e-6


def test_a_gaussian_has_minus_3_db_at_the_cutoff_and_ends_after_half_a_period():
    x = sine(10.0)
    gain, phase = gain_and_phase(x, gaussian(x, cutoff=10.0, rate=RATE), 10.0)
    assert gain == pytest.approx(np.sqrt(0.5), rel=2e-3)
    assert abs(phase) < 1e-6
    line = np.linspace(-1.0, 3.0, 400)
    np.testing.assert_allclose(gaussian(line, cutoff=10.0, rate=RATE), line, atol=1e-12)


def test_uncorrected_the_double_pass_has_minus_6_db_at_the_cutoff():
    x = sine(10.0)
    assert gain_and_phase(
        x, butterworth(x, cutoff=10.0, rate=RATE, order=2, corrected=False), 10.0
    )[0] == pytest.approx(0.5, abs=1e-6)


def test_butterworth_agrees_with_filtfilt_away_from_the_ends():
    rng = np.random.default_rng(1)
    x = rng.normal(size=(4000, 3)).cumsum(axis=0)
    b, a = signal.butter(2, 7.0, fs=RATE)
    expected = signal.filtfilt(b, a, x, axis=0)
    ours = butterworth(x, cutoff=7.0, rate=RATE, order=2, corrected=False)
    inside = slice(600, -600)
    np.testing.assert_allclose(ours[inside], expected[inside], atol=1e-9 * np.abs(x).max())


@pytest.mark.parametrize("order", [1, 2, 3, 4, 6, 8])
@pytest.mark.parametrize("cutoff", [0.5, 7.0, 40.0])
def test_sections_are_those_of_another_design(order, cutoff):
    ours = butterworth_sections(order, cutoff, RATE)
    at = np.linspace(0.0, 0.49 * RATE, 200)
    expected = signal.butter(order, cutoff, fs=RATE, output="sos")
    one, other = (signal.sosfreqz(each, at, fs=RATE)[1] for each in (ours, expected))
    np.testing.assert_allclose(one, other, atol=1e-9)
    np.testing.assert_allclose(ours[:, 3:], expected[:, 3:], rtol=1e-9, atol=1e-12)


def test_straight_lines_pass_to_their_ends():
    x = 3.0 + 2.0 * np.arange(2000) / RATE
    np.testing.assert_allclose(butterworth(x, cutoff=5.0, rate=RATE), x, atol=1e-5)


@pytest.mark.parametrize("order", [2, 4])
@pytest.mark.parametrize("tolerance", [1e-2, 1e-6])
def test_settling_is_where_the_impulse_response_has_died(order, tolerance):
    impulse = np.zeros(8001)
    impulse[4000] = 1.0
    response = np.abs(butterworth(impulse, cutoff=5.0, rate=RATE, order=order))[4000:]
    n = settling_samples(5.0, RATE, order=order, tolerance=tolerance)
    assert response[n:].max() <= tolerance * response[0] < response[n - 1] * (1 + 1e-9)


def test_chebyshev_decimation_is_scipys():
    x = np.random.default_rng(2).normal(size=(1234, 2))
    np.testing.assert_array_equal(
        decimate_chebyshev(x, 10), signal.decimate(x, 10, n=8, ftype="iir", axis=0, zero_phase=True)
    )


@pytest.mark.parametrize("cutoff", [0.0, -1.0, 250.0, 300.0])
def test_an_impossible_cutoff_is_refused_with_the_nyquist_frequency(cutoff):
    with pytest.raises(UsageError, match="between 0 and 250 Hz"):
        butterworth(np.zeros(100), cutoff=cutoff, rate=RATE)
    assert single_pass_cutoff(10.0, RATE, 1) > 15.0
