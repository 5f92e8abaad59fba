"""Forward selection from normal equations, against least squares of all rows."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from asbuilt.validation.log_errors.forward_selection import BlockEquations

Array = NDArray[np.float64]
B, N, R, M = 12, 200, 4, 6


def rows(effect: float, seed: int = 0) -> tuple[Array, Array, Array]:
    """Return own columns, candidates and torque; the third candidate acts with this value."""
    rng = np.random.default_rng(seed)
    X, V = rng.normal(size=(B * N, R)), rng.normal(size=(B * N, M)) * np.arange(1.0, M + 1.0)
    V[:, 1] += X[:, 0]
    return X, V, X @ np.arange(1.0, R + 1.0) + effect * V[:, 2] + rng.normal(size=B * N)


def equations(X: Array, V: Array, y: Array) -> BlockEquations:
    e = y - X @ np.linalg.lstsq(X, y, rcond=None)[0]
    parts = [np.hstack([X, V])[b * N : (b + 1) * N] for b in range(B)]
    ends = [e[b * N : (b + 1) * N] for b in range(B)]
    return BlockEquations(
        np.array([part.T @ part for part in parts]),
        np.array([part.T @ end for part, end in zip(parts, ends, strict=True)]),
        np.array([end @ end for end in ends]),
        R,
    )


def test_the_chosen_column_has_the_value_of_least_squares_with_it() -> None:
    X, V, y = rows(0.3)
    (chosen,) = equations(X, V, y).selected(4)
    with_it = np.hstack([X, V[:, 2:3]])
    beta, *_ = np.linalg.lstsq(with_it, y, rcond=None)
    without = y - X @ np.linalg.lstsq(X, y, rcond=None)[0]
    left = y - with_it @ beta
    assert chosen.column == 2
    assert chosen.value == pytest.approx(beta[-1], rel=1e-9)
    assert chosen.share == pytest.approx(1.0 - left @ left / (without @ without), rel=1e-9)
    textbook = np.sqrt(left @ left / (B * N) * np.linalg.inv(with_it.T @ with_it)[-1, -1])
    assert 0.9 * textbook < chosen.std_error < 2.0 * textbook


def test_chance_chooses_no_column() -> None:
    assert sum(bool(equations(*rows(0.0, seed)).selected(4)) for seed in range(40)) <= 1


def test_a_value_that_is_not_admitted_is_passed_over() -> None:
    X, V, y = rows(0.3)
    assert equations(X, V, y).selected(4, lambda each: each.column != 2) == ()


def test_a_column_among_those_of_the_fit_is_never_chosen() -> None:
    X, V, y = rows(0.3)
    V[:, 2] = X[:, 1] + 1e-9 * V[:, 2]
    assert all(each.column != 2 for each in equations(X, V, y).selected(4))


def test_an_effect_of_one_stretch_alone_does_not_predict_the_others() -> None:
    X, V, y = rows(0.0)
    y[:N] += 2.0 * V[:N, 2]
    assert equations(X, V, y).selected(4) == ()


def test_a_column_too_near_the_fit_to_be_chosen_still_has_its_share() -> None:
    X, V, y = rows(0.0)
    V[:, 2] = X[:, 1] + 0.02 * V[:, 3]
    y += 10.0 * V[:, 2]
    seen = equations(X, V, y)
    left = [
        float(np.sum((y - Z @ np.linalg.lstsq(Z, y, rcond=None)[0]) ** 2))
        for Z in (X, np.hstack([X, V[:, 2:3]]), np.hstack([X, V[:, 3:4]]))
    ]
    assert [each.column for each in seen.selected(1)] == [3]
    assert seen.shares_alone()[[2, 3]] == pytest.approx(1.0 - np.array(left[1:]) / left[0])
