import numpy as np
from scipy import signal, stats

from asbuilt.validation import VelocityCurve, analyse_residual
from asbuilt.validation.residuals import (
    autocorrelation,
    bin_by_velocity,
    durbin_watson,
    effective_samples,
    find_contiguous_segments,
    ljung_box,
    measure_whiteness,
)


def coloured(n: int, phi: float, seed: int) -> np.ndarray:
    return signal.lfilter([1.0], [1.0, -phi], np.random.default_rng(seed).normal(size=n))


def test_autocorrelation_agrees_with_direct_sums() -> None:
    e = coloured(300, 0.7, 0)
    runs = ((0, 120), (120, 300))
    d = e - e.mean()
    direct = [
        sum(d[i] * d[i + k] for a, b in runs for i in range(a, b - k)) / (d @ d) for k in range(11)
    ]
    np.testing.assert_allclose(autocorrelation(e, runs, 10), direct, atol=1e-12)


def test_a_constant_error_has_no_correlation_to_tell() -> None:
    assert autocorrelation(np.ones(10), ((0, 10),), 3).tolist() == [1.0, 0.0, 0.0, 0.0]


def test_white_noise_passes_and_coloured_noise_fails() -> None:
    t = np.arange(4000) * 0.01
    errors = np.column_stack([coloured(4000, 0.0, 1), coloured(4000, 0.9, 2)])
    analysis = analyse_residual(t, errors, ("white", "slow"))
    assert analysis.probability_white[0] > 0.01
    assert analysis.probability_white[1] < 1e-10
    np.testing.assert_allclose(analysis.durbin_watson, [2.0, 0.2], atol=0.1)
    assert analysis.effective_samples[0] > 3000
    assert 130 < analysis.effective_samples[1] < 340  # n (1 - phi) / (1 + phi) = 211


def test_ljung_box_is_uniform_under_the_null() -> None:
    probabilities = []
    for seed in range(300):
        e = coloured(500, 0.0, seed)
        probabilities.append(ljung_box(autocorrelation(e, ((0, 500),), 20), 500, 20)[1])
    assert stats.kstest(probabilities, "uniform").pvalue > 1e-3


def test_spectrum_integrates_to_the_variance() -> None:
    t = np.concatenate([np.arange(3000) * 0.01, 100 + np.arange(2000) * 0.01])
    e = coloured(5000, 0.5, 5)[:, None]
    analysis = analyse_residual(t, e, ("a",))
    area = np.trapezoid(analysis.spectrum[:, 0], analysis.frequencies)
    np.testing.assert_allclose(area, e.var(), rtol=0.1)
    np.testing.assert_allclose(analysis.lags[1], 0.01)


def test_durbin_watson_does_not_step_over_gaps() -> None:
    e = np.array([1.0, 1.0, -1.0, -1.0])
    assert durbin_watson(e, ((0, 2), (2, 4))) == 0.0
    assert durbin_watson(e, ((0, 4),)) == 1.0


def test_whiteness_in_the_band_does_not_depend_on_cutoff_or_rate() -> None:
    """White noise behind an ideal low-pass is white up to it.

    A random walk is slow at every cutoff.
    """
    n, rate = 2**16, 500.0
    rng = np.random.default_rng(5)
    noise = np.column_stack([rng.normal(size=n), np.cumsum(rng.normal(size=n))])
    spectrum, frequency = np.fft.rfft(noise, axis=0), np.fft.rfftfreq(n, 1 / rate)
    for cutoff, kept in ((2.0, 1), (2.0, 25), (12.5, 4), (12.5, 10), (125.0, 1)):
        low = np.fft.irfft(np.where((frequency <= cutoff)[:, None], spectrum, 0.0), axis=0)[::kept]
        statistic, worth = measure_whiteness(np.arange(len(low)) * kept / rate, low, cutoff)
        assert 1.75 < statistic[0] < 2.25
        assert worth[0] > 0.6
        assert statistic[1] < 0.2
        assert worth[1] < 0.1


def test_short_recordings_are_analysed_too() -> None:
    analysis = analyse_residual(np.arange(2) * 0.1, np.array([[1.0], [-1.0]]), ("a",))
    assert analysis.autocorrelation.shape == (2, 1)
    assert effective_samples(np.array([1.0, -0.9]), 2) <= 2


def test_runs_split_where_time_jumps_or_returns() -> None:
    assert find_contiguous_segments(np.array([])) == ()
    assert find_contiguous_segments(np.array([1.0])) == ((0, 1),)
    assert find_contiguous_segments(np.array([0.0, 1, 2, 2, 3, 9])) == ((0, 3), (3, 5), (5, 6))


def test_velocity_curve_keeps_directions_apart() -> None:
    rng = np.random.default_rng(0)
    qd = rng.uniform(-2, 1, 5000)
    curve = bin_by_velocity(qd, np.sign(qd) + 0.1 * qd, bins=20)
    assert np.array_equal(np.isnan(curve.median), curve.count < 3)
    assert np.all(curve.velocity[np.isnan(curve.median)] > 1.0)
    curve = VelocityCurve(
        *(
            values[curve.count >= 3]
            for values in (curve.velocity, curve.lower, curve.median, curve.upper, curve.count)
        )
    )
    assert np.all(np.sign(curve.median) == np.sign(curve.velocity))
    np.testing.assert_allclose(
        curve.median, np.sign(curve.velocity) + 0.1 * curve.velocity, atol=0.02
    )
    assert curve.count.sum() == 5000
    assert np.all(curve.lower <= curve.median)
    assert np.all(curve.median <= curve.upper)
