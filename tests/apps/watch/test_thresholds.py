"""Thresholds of residuals whose distribution is known."""

import numpy as np
import pytest

from asbuilt import set_thresholds
from asbuilt.apps.watch import Observed
from asbuilt.apps.watch.causal_filter import largest_velocity_error
from asbuilt.apps.watch.thresholds import MANY, estimate_levels
from asbuilt.apps.watch.watching import cut_held_out_parts
from asbuilt.arrays import Array
from asbuilt.errors import RecordingError

HOUR = 3600


def test_levels_of_joints_of_unlike_size_keep_the_rate_of_the_robot() -> None:
    """Ten false alarms per hour from an hour: the exact rate of the levels, mean of ten hours."""
    rng, sizes = np.random.default_rng(0), np.array([0.1, 1.0, 5.0, 2.0])
    rates = []
    for _ in range(10):
        found = estimate_levels(sizes * rng.exponential(size=(HOUR, 4)), 10.0 / HOUR)
        rates.append(HOUR * -np.expm1(np.sum(np.log1p(-np.exp(-found / sizes)))))
    assert 8.0 < np.mean(rates) < 13.0


def test_rate_is_kept_on_average_over_short_records() -> None:
    """Ten false alarms per hour from 20 minutes of seven joints: a promise of the mean."""
    rng, rates = np.random.default_rng(6), []
    for _ in range(80):
        found = estimate_levels(rng.exponential(size=(HOUR // 3, 7)), 10.0 / HOUR)
        rates.append(HOUR * -np.expm1(np.sum(np.log1p(-np.exp(-found)))))
    assert 8.0 < np.mean(rates) < 12.0


def test_joints_that_alarm_together_count_once() -> None:
    one = np.random.default_rng(1).exponential(size=(HOUR, 1))
    single = estimate_levels(one, 1.0 / HOUR)
    assert np.allclose(estimate_levels(np.repeat(one, 6, axis=1), 1.0 / HOUR), single[0], rtol=1e-9)


def test_few_blocks_have_a_tail_per_joint() -> None:
    """A joint of heavy tail does not raise the level of others."""
    rng = np.random.default_rng(2)
    heavy = rng.exponential(size=MANY // 10) ** 3
    other = rng.uniform(0.9, 1.0, size=MANY // 10)
    both = estimate_levels(np.column_stack([heavy, other]), 1.0 / HOUR)
    assert both[1] < 2.0
    assert both[0] > 10.0


class _ErraticError:
    """A standard deviation of the model's torque that has nothing to do with the residual."""

    def std(self, q: Array, qd: Array, qdd: Array) -> Array:
        return np.exp(2.0 * np.random.default_rng(4).normal(size=(len(q) // 50, 1))).repeat(50, 0)


def test_scale_leaves_out_what_residuals_do_not_follow() -> None:
    """Normal residuals of one size: a threshold is about as high everywhere."""
    rng, n = np.random.default_rng(3), 20000
    t, zeros = 0.01 * np.arange(n), np.zeros((n, 1))
    qd = np.sin(t)[:, None]
    residual = rng.normal(size=(n, 1))
    share = np.where(t > 0.0, 0.4, -1.0)
    log = Observed(t, share, zeros, qd, zeros, zeros, zeros, residual)
    error = _ErraticError()
    made = set_thresholds([log], error, ["joint"], bandwidth=8.0)  # type: ignore[arg-type]
    limit = made.of_log(log, error)[1]  # type: ignore[arg-type]
    assert np.quantile(limit, 0.95) < 2.0 * np.median(limit)
    assert 3.0 < np.median(limit) < 12.0


def _log(seconds: float) -> Observed:
    """Normal residuals of a joint that swings, a hundred a second."""
    t = np.linspace(0.0, seconds, round(100.0 * seconds) + 1)
    zeros = np.zeros((len(t), 1))
    share = np.where(t > 0.0, 0.4, -1.0)
    residual = np.random.default_rng(3).normal(size=zeros.shape)
    return Observed(t, share, zeros, np.sin(t)[:, None], zeros, zeros, zeros, residual)


@pytest.mark.parametrize("rule", ["blocks:5s:3", "last:0.3"])
def test_what_is_held_out_of_a_log_is_the_same_in_parts(rule: str) -> None:
    log = _log(100.0)
    (whole,) = cut_held_out_parts([log], rule)
    parts = [log.part(slice(0, 4321)), log.part(slice(4321, None))]
    found = np.concatenate([part.t for part in cut_held_out_parts(parts, rule)])
    assert found.tolist() == whole.t.tolist()


def test_nothing_held_out_sets_no_thresholds() -> None:
    held_out = cut_held_out_parts([_log(0.2)], "last:0.3")
    with pytest.raises(RecordingError, match="no sample is left"):
        set_thresholds(held_out, _ErraticError(), ["joint"], bandwidth=8.0)  # type: ignore[arg-type]


def test_what_is_left_out_between_held_out_blocks_verifies_no_rate() -> None:
    """Of 300 s every third block of 5 s is held out: thresholds follow from 100 s."""
    log, error = _log(300.0), _ErraticError()
    held_out = cut_held_out_parts([log], "blocks:5s:3")
    made = set_thresholds(held_out, error, ["joint"], bandwidth=8.0)  # type: ignore[arg-type]
    assert abs(3600.0 * made.hours - 100.0) < 0.5


@pytest.mark.parametrize("speed", [0.0, 1.0])
def test_noise_is_that_near_standstill(speed: float) -> None:
    """An irregular clock makes noise of fast motion, which leaves its direction known."""
    rng = np.random.default_rng(5)
    even = np.arange(0.0, 40.0, 0.01)
    exact = even + rng.uniform(-1e-3, 1e-3, even.size)
    q = 0.1 * np.sin(2.0 * speed * exact)[:, None] + 1e-6 * rng.normal(size=(even.size, 1))
    found = largest_velocity_error([(even, q, None)], 200.0)
    assert 1e-4 < found[0] < 6e-3
