"""The scan for a change: closed forms, p-values without a change, injected changes."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import chi2, kstest

from asbuilt.apps.fleet.drift.variation import (
    DAYS_AFTER,
    DAYS_BEFORE,
    History,
    NullDistribution,
    estimate_variation,
    scan,
    scan_probability,
)


def histories(
    rng: np.random.Generator, n: int, d: int = 20, r: int = 6
) -> tuple[list[History], np.ndarray]:
    """Days of robots without a change, of different information, and their true variation."""
    root = rng.standard_normal((r, 2))
    V = root @ root.T
    found = []
    for _ in range(n):
        A = rng.standard_normal((d, r, 3 * r))
        J = A @ A.transpose(0, 2, 1) / r
        y = rng.multivariate_normal(np.zeros(r), V, d) + rng.standard_normal(r)
        noise = np.array([rng.multivariate_normal(np.zeros(r), np.linalg.inv(j)) for j in J])
        score = np.einsum("dij,dj->di", J, y + noise)
        found.append(History(J, score, np.zeros((d, 0))))
    return found, V


def test_statistic_of_equal_days_is_the_difference_of_means() -> None:
    rng = np.random.default_rng(3)
    y, V = rng.standard_normal((12, 3)), np.diag([1.0, 2.0, 0.0])
    found = scan(np.tile(np.eye(3), (12, 1, 1)), y, V)
    assert found is not None
    for c, statistic in zip(found.candidates, found.statistics, strict=True):
        delta = y[c:].mean(axis=0) - y[:c].mean(axis=0)
        variance = (np.diag(V) + 1.0) * (1.0 / c + 1.0 / (12 - c))
        assert statistic == pytest.approx(float(np.sum(delta**2 / variance)), rel=1e-6)


def test_probability_of_a_scan_lies_between_one_test_and_the_sum_of_all() -> None:
    d = 30
    for single in (1e-1, 1e-3, 1e-8):
        p = scan_probability(single, d, 4)
        assert single <= p <= (d - DAYS_AFTER + 1 - DAYS_BEFORE) * single


def test_p_values_with_known_variation_are_uniform() -> None:
    found, V = histories(np.random.default_rng(5), 150)
    p = [scan(each.information, each.score, V).p_value for each in found]  # type: ignore[union-attr]
    assert kstest(p, "uniform").pvalue > 1e-3


def test_p_values_with_estimated_variation_are_uniform_and_not_too_small() -> None:
    found, V = histories(np.random.default_rng(6), 60)
    variation = estimate_variation(found)
    assert np.linalg.norm(variation.covariance - V) < 0.35 * np.linalg.norm(V)
    p = np.array(
        [
            scan(  # type: ignore[union-attr]
                each.information,
                each.score,
                variation.covariance,
                null=variation.null,
                inflation=float(s),
            ).p_value
            for each, s in zip(found, variation.inflations, strict=True)
        ]
    )
    assert kstest(p, "uniform").pvalue > 1e-3
    assert np.sum(p < 0.05) <= 9


def test_changes_do_not_count_as_variation() -> None:
    found, V = histories(np.random.default_rng(7), 24)
    for each in found[::4]:
        step = np.zeros_like(each.score)
        step[12:] = 25.0
        each.score[:] += np.einsum("dij,dj->di", each.information, step)
    variation = estimate_variation(found)
    assert np.trace(variation.covariance) < 1.5 * np.trace(V)
    places = [
        scan(each.information, each.score, variation.covariance, null=variation.null)
        for each in found
    ]
    for each in places[::4]:
        assert each is not None
        assert each.place == 12
        assert each.p_value < 1e-4


def test_null_distribution_has_the_moments_given() -> None:
    values = 0.8 * chi2(9).rvs(20_000, random_state=0)
    null = NullDistribution.fitted(values, 9, 400.0, 100)
    assert null.exceeded(float(np.quantile(values, 0.95))) == pytest.approx(0.05, rel=0.1)


def test_a_logged_temperature_explains_what_it_moves() -> None:
    rng = np.random.default_rng(8)
    found, V = histories(rng, 20)
    slope = np.array([3.0, -2.0, 0.0, 1.0, 0.0, 0.0])
    warm = []
    for each in found:
        temperature = rng.normal(30.0, 4.0, (each.n_days, 1))
        moved = np.einsum("dij,dj->di", each.information, temperature * slope)
        warm.append(History(each.information, each.score + moved, temperature))
    variation = estimate_variation(warm)
    assert variation.coefficients[0] == pytest.approx(slope, abs=0.15)
    assert np.trace(variation.covariance) < 1.5 * np.trace(V)


def test_too_few_days_are_not_scanned() -> None:
    assert scan(np.tile(np.eye(2), (4, 1, 1)), np.zeros((4, 2)), np.eye(2)) is None


@pytest.mark.filterwarnings("error")
def test_a_robot_without_the_temperature_of_its_type_stays_as_it_is() -> None:
    rng = np.random.default_rng(0)
    score = rng.normal(size=(5, 2))
    covariates = np.column_stack([np.full(5, np.nan), [20.0, np.nan, 24.0, 22.0, 26.0]])
    history = History(np.tile(np.eye(2), (5, 1, 1)), score, covariates)
    slopes = np.array([[1.0, 1.0], [0.5, 0.0]])
    found = history.without(slopes).score
    np.testing.assert_allclose(found[:, 1], score[:, 1])
    np.testing.assert_allclose(found[:, 0] - score[:, 0], [1.5, 0.0, -0.5, 0.5, -1.5])
