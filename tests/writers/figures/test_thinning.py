import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from asbuilt.writers import thin_curves


@given(st.integers(1, 3000), st.integers(2, 400), st.integers(0, 5))
def test_extremes_and_ends_survive(n: int, points: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    t = np.arange(n) * 0.01
    one, two = rng.normal(size=(2, n))
    short, a, b = thin_curves(t, one, two, points=points)
    assert a.min() == one.min()
    assert a.max() == one.max()
    assert b.min() == two.min()
    assert b.max() == two.max()
    assert short[0] == t[0]
    assert short[-1] == t[-1]
    assert np.all(np.diff(short) > 0)
    assert len(short) <= max(points, 2) + 8
    assert np.all(np.isin(short, t))


def test_gaps_are_broken_and_not_bridged() -> None:
    t = np.concatenate([np.arange(1000) * 0.01, 50 + np.arange(1000) * 0.01])
    short, curve = thin_curves(t, np.sin(t), points=200)
    gap = np.flatnonzero(np.isnan(short))
    assert len(gap) == 1
    assert np.isnan(curve[gap[0]])
    assert short[gap[0] - 1] == t[999]
    assert short[gap[0] + 1] == t[1000]


def test_short_recordings_are_kept_whole() -> None:
    t = np.arange(10.0)
    short, curve = thin_curves(t, t**2, points=100)
    assert np.array_equal(short, t)
    assert np.array_equal(curve, t**2)
    assert len(thin_curves(np.array([]), np.array([]), points=5)[0]) == 0
