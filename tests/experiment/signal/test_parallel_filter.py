import numpy as np
import pytest

from asbuilt.errors import UsageError
from asbuilt.experiment.signal import samples as samples_module
from asbuilt.experiment.signal.parallel_filter import design_parallel_filter
from asbuilt.experiment.signal.samples import Samples


def response(f, frequency):
    k = np.arange(-f.margin, f.margin + 1)
    return f.taps @ np.cos(2 * np.pi * frequency / f.rate * k)


@pytest.mark.parametrize(
    ("cutoff", "rate"), [(3.0, 100.0), (10.9, 100.0), (25.0, 1000.0), (20.0, 80.0)]
)
def test_the_response_is_flat_then_minus_3_db_then_nothing(cutoff, rate):
    f = design_parallel_filter(cutoff, rate)
    assert response(f, 0.0) == pytest.approx(1.0, abs=1e-14)
    assert response(f, 0.4 * cutoff) == pytest.approx(1.0, abs=3e-3)
    assert response(f, cutoff) == pytest.approx(np.sqrt(0.5), abs=1e-9)
    beyond = np.linspace(1.75 * cutoff, rate / 2, 200)
    assert max(abs(response(f, g)) for g in beyond) < 2e-3


def test_sines_come_out_scaled_without_phase_at_their_own_instants():
    f = design_parallel_filter(5.0, 100.0, 4)
    t = np.arange(0, 7.03, 0.01)
    for frequency in (1.0, 5.0, 7.0):
        y = f.apply(np.sin(2 * np.pi * frequency * t)[None, :])[0]
        np.testing.assert_allclose(
            y, response(f, frequency) * np.sin(2 * np.pi * frequency * f.times(t)), atol=1e-12
        )
    assert len(f.times(t)) == f.n_outputs(len(t)) == y.size


def test_apply_is_a_plain_convolution_along_any_axis():
    rng = np.random.default_rng(3)
    x = rng.normal(size=(5, 301))
    f = design_parallel_filter(6.0, 100.0, 3)
    expected = np.stack([np.convolve(row, f.taps, mode="valid")[::3] for row in x])
    np.testing.assert_allclose(f.apply(x), expected, atol=1e-13)
    np.testing.assert_allclose(f.apply(np.ascontiguousarray(x.T), axis=0), expected.T, atol=1e-13)
    np.testing.assert_allclose(
        f.apply(x.reshape(5, 7, 43).swapaxes(1, 2), axis=1).shape, (5, f.n_outputs(43), 7)
    )
    out = np.empty_like(expected)
    assert f.apply(x, out=out) is out


def test_rows_of_wider_memory_are_filtered_as_those_of_a_copy():
    wide = np.random.default_rng(5).normal(size=(9, 400))
    f = design_parallel_filter(6.0, 100.0, 3)
    before = wide.copy()
    for rows in (wide[2:6, :301], wide[::2, 7:308], wide[::-1, :301], wide[:, ::-1], wide[:1]):
        np.testing.assert_array_equal(f.apply(rows), f.apply(rows.copy()))
    np.testing.assert_array_equal(wide, before)


def test_pieces_that_overlap_by_the_margins_give_the_whole():
    x = np.random.default_rng(4).normal(size=(2, 1000))
    f = design_parallel_filter(4.0, 100.0, 5)
    whole = f.apply(x)
    cut = 40
    first = f.apply(x[:, : (cut - 1) * 5 + f.taps.size])
    second = f.apply(x[:, cut * 5 :])
    np.testing.assert_array_equal(np.concatenate([first, second], axis=1), whole)


def test_a_run_shorter_than_the_filter_gives_nothing():
    f = design_parallel_filter(4.0, 100.0)
    assert f.apply(np.zeros((3, f.taps.size - 1))).shape == (3, 0)
    assert f.times(np.zeros(f.taps.size - 1)).size == 0


def test_what_would_alias_is_refused_with_a_cure():
    with pytest.raises(UsageError, match="decimate by at most 2"):
        design_parallel_filter(10.0, 100.0, 5)
    with pytest.raises(UsageError, match="at most"):
        design_parallel_filter(40.0, 100.0)


@pytest.mark.parametrize("at_once", [7, 40, 1000])
def test_samples_are_filtered_alike_however_many_at_once(at_once, monkeypatch):
    monkeypatch.setattr(samples_module, "AT_ONCE", at_once)
    rng = np.random.default_rng(4)
    f = design_parallel_filter(6.0, 100.0, 3)
    t = np.arange(400) / 100.0
    x = rng.normal(size=(400, 2))
    # One segment is shorter than the filter, and has no outputs.
    segments = ((0, 150), (150, 160), (170, 400))
    samples = Samples(
        t, x, x, x, x, rate=100.0, joint_names=("a", "b"), segments=segments, parallel=f
    )
    expected = [
        np.convolve(x[a:b, k], f.taps, mode="valid")[::3]
        for k in range(2)
        for a, b in segments
        if b - a >= f.taps.size
    ]
    found = samples.filtered(x)
    assert len(found) == samples.n_filtered
    np.testing.assert_allclose(found.T.ravel(), np.concatenate(expected), atol=1e-12)
