"""Student's distribution of widened errors, and the data of tests, by simulation and SciPy."""

from __future__ import annotations

import json

import numpy as np
import pytest
from scipy import stats

from asbuilt.codec import make_plain, restore_dataclass
from asbuilt.errors import ResultError
from asbuilt.identification import widening
from asbuilt.identification.uncertainty.block_scatter import (
    MOST_GROUPS,
    BlockScatter,
    effective_rank,
    student_probability,
    sum_degrees,
)
from asbuilt.validation.comparison.significance import joint_test


def test_p_values_of_widened_deviations_are_those_of_student() -> None:
    freedom, deviation = np.array([4.0, 9.0, 300.0]), np.array([2.0, -3.5, 3.3])
    np.testing.assert_allclose(
        student_probability(deviation / widening(freedom), freedom),
        2.0 * stats.t.sf(np.abs(deviation), freedom),
        rtol=1e-9,
    )


def test_welch_degrees_are_those_of_scipy() -> None:
    rng = np.random.default_rng(0)
    one, two = rng.normal(size=12), 3.0 * rng.normal(size=7)
    freedom = sum_degrees(
        (np.array([one.var(ddof=1) / 12]), np.array([11.0])),
        (np.array([two.var(ddof=1) / 7]), np.array([6.0])),
    )
    assert freedom[0] == pytest.approx(stats.ttest_ind(one, two, equal_var=False).df)


def test_many_blocks_are_added_up_and_stored_to_the_last_bit() -> None:
    moves = np.random.default_rng(1).normal(size=(500, 3))
    scatter = BlockScatter.of(moves, np.full(3, 100.0), 0.01)
    assert len(scatter.moves) == MOST_GROUPS
    np.testing.assert_allclose(scatter.moves.sum(axis=0), moves.sum(axis=0))
    again = restore_dataclass(BlockScatter, json.loads(json.dumps(make_plain(scatter))))
    assert np.array_equal(again.moves, scatter.moves)
    assert again.common_variance == scatter.common_variance
    with pytest.raises(ResultError, match="degrees of freedom"):
        BlockScatter(moves, np.ones(2))


def test_effective_rank_counts_equal_directions_from_fewer_blocks_than_columns() -> None:
    rng = np.random.default_rng(2)
    found = [effective_rank(rng.normal(size=(12, 30))) for _ in range(50)]
    assert np.median(found) > 25.0
    lengths = np.sqrt(np.r_[1.0, np.full(29, 1e-3)])
    assert np.median([effective_rank(rng.normal(size=(12, 30)) * lengths) for _ in range(50)]) < 1.3


def test_joint_test_keeps_its_level_with_fewer_blocks_than_parameters() -> None:
    """Twelve independent blocks of a mean of 20 values, whose metric is wrong by a factor of 3."""
    rng, n, p = np.random.default_rng(3), 12, 20
    size = np.sqrt(np.linspace(0.3, 3.0, p))
    found = []
    for _ in range(1500):
        blocks = size * rng.normal(size=(n, p))
        mean = blocks.mean(axis=0)
        moves = (blocks - mean) / n * np.sqrt(n / (n - 1))
        found.append(joint_test(mean, np.eye(p) / (3 * n), moves, np.full(p, n - 1.0)).probability)
    for level in (0.05, 0.01):
        low, high = stats.binom.interval(0.999, 1500, level)
        assert low / 1500 <= np.mean(np.array(found) <= level) <= high / 1500
