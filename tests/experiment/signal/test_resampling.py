import numpy as np
import pytest

from asbuilt.errors import RecordingError
from asbuilt.experiment import Recording, plan_uniform_grid

W = 2 * np.pi * np.array([0.5, 1.0])


def resampled(recording, *settings, **named):
    grid = plan_uniform_grid(recording, *settings, **named)
    return grid.uniform(), grid.rate, grid.notes


def motion(t):
    return np.sin(np.outer(t, W))


def recorded(t, **changes):
    return Recording(
        t=t,
        q=changes.pop("q", motion(t)),
        tau=changes.pop("tau", np.cos(np.outer(t, W))),
        source="log",
        **changes,
    )


def test_a_uniform_log_is_passed_on_untouched():
    t = np.arange(0, 5, 0.01)
    (run,), rate, notes = resampled(recorded(t))
    assert rate == pytest.approx(100.0, rel=1e-12)
    assert notes == ()
    np.testing.assert_array_equal(run.q, motion(t))
    np.testing.assert_allclose(run.t, t, atol=1e-9)


def test_an_irregular_clock_is_resampled_within_the_spline_error_bound():
    rng = np.random.default_rng(0)
    t = np.cumsum(rng.choice([0.008, 0.010, 0.012, 0.013], size=2000, p=[0.1, 0.5, 0.3, 0.1]))
    (run,), rate, notes = resampled(recorded(t))
    assert np.ptp(np.diff(run.t)) < 1e-9
    assert rate == pytest.approx(1 / np.mean(np.diff(t)), rel=1e-3)
    bound = 5 / 384 * 0.013**4 * W.max() ** 4
    inside = slice(5, -5)
    assert np.abs(run.q - motion(run.t))[inside].max() < bound
    assert "cubic splines" in notes[0]


def test_stamps_that_jitter_about_an_uniform_clock_are_not_used():
    rng = np.random.default_rng(1)
    even = np.arange(0, 20, 0.005)
    (run,), rate, notes = resampled(
        recorded(even + rng.normal(0, 3e-4, even.size), q=motion(even), tau=motion(even))
    )
    assert rate == 200.0
    assert np.abs(run.q - motion(run.t))[5:-5].max() < 2e-4 * W.max()
    assert np.abs(np.diff(run.q, n=3, axis=0)).max() < 1e-4
    assert "smoother on a uniform clock" in " ".join(notes)


def test_a_log_polled_faster_than_the_controller_writes_is_thinned_to_the_controller():
    polled = np.arange(0, 20, 0.0025) + np.random.default_rng(2).normal(0, 1e-4, 8000)
    written = np.floor(polled / 0.01 + 0.3) * 0.01
    (run,), rate, notes = resampled(recorded(polled, q=motion(written), tau=motion(written)))
    assert rate == pytest.approx(100.0, rel=1e-3)
    lag = run.t[np.argmax(run.q[:100, 0])] - 0.5
    assert abs(lag) < 0.011
    assert np.abs(np.diff(run.q, n=3, axis=0))[3:-3].max() < 2e-3
    assert "that repeat" in notes[0]


def test_a_robot_at_rest_without_noise_is_no_repeated_sample():
    t = np.arange(0, 6, 0.01)
    q = np.where(t[:, None] < 2, 0.0, np.sin(t[:, None] - 2))
    (run,), _, notes = resampled(Recording(t=t, q=q, tau=q))
    assert run.t.size == t.size
    assert notes == ()


def test_nothing_is_interpolated_across_a_gap():
    t = np.arange(0, 10, 0.01)
    keep = (t < 4.0) | (t > 4.2)
    jitter = np.random.default_rng(3).uniform(-2e-3, 2e-3, t.size)
    for clock in (t, t + jitter):
        runs, _, notes = resampled(recorded(clock[keep]))
        assert [bool((run.t < 4.01).all()) or bool((run.t > 4.19).all()) for run in runs] == [
            True,
            True,
        ]
        assert any("1 gap longer than 0.045" in note for note in notes)


def test_bad_rows_are_dropped_and_counted():
    t = np.arange(0, 5, 0.01)
    q = motion(t)
    q[7, 0] = np.nan
    t[200] = t[199]
    t[300] = t[250]
    (run,), _, notes = resampled(recorded(t, q=q, tau=motion(t)))
    assert "1 of 500 samples with NaN" in notes[0]
    assert "2 samples whose time does not increase" in notes[1]
    assert np.all(np.isfinite(run.q))
    np.testing.assert_allclose(run.q, motion(run.t), atol=1e-3)


def test_a_rate_is_honoured_and_an_impossible_one_refused():
    t = np.arange(0, 5, 0.01)
    (run,), rate, _ = resampled(recorded(t), rate=40.0)
    assert rate == 40.0
    np.testing.assert_allclose(run.q, motion(run.t), atol=1e-5)
    with pytest.raises(RecordingError, match="above the rate of the log, 100 Hz"):
        resampled(recorded(t), rate=400.0)
    with pytest.raises(RecordingError, match="at least 8 are required"):
        resampled(recorded(t[:5]))
