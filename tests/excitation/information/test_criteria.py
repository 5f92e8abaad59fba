from __future__ import annotations

import numpy as np
import pytest

from asbuilt.errors import UsageError
from asbuilt.excitation.information.information import (
    AOptimality,
    ConditionNumber,
    DOptimality,
    EOptimality,
    FocusedDOptimality,
    select_criterion,
)

WEIGHT = np.diag([0.0, 1.0, 4.0, 0.0, 0.2, 1.0]) + 0.1
"""What matters: not all parameters, and some together."""
EVERY = (
    *(DOptimality(), AOptimality(), AOptimality(WEIGHT), EOptimality(), ConditionNumber()),
    FocusedDOptimality((0, 4)),
)


def information(seed: int = 0, p: int = 6) -> np.ndarray:
    rows = np.random.default_rng(seed).normal(size=(40, p)) * np.geomspace(0.3, 3.0, p)
    return rows.T @ rows


@pytest.mark.parametrize("criterion", EVERY, ids=lambda c: type(c).__name__)
def test_gradients_are_those_of_the_values(criterion) -> None:
    m = information()
    _, gradient = criterion.value_and_gradient(m)
    assert gradient == pytest.approx(gradient.T)
    rng = np.random.default_rng(1)
    for _ in range(4):
        way = rng.normal(size=m.shape)
        way = way + way.T
        step = 1e-5
        slope = (criterion.value(m + step * way) - criterion.value(m - step * way)) / (2 * step)
        assert slope == pytest.approx(float(np.sum(gradient * way)), rel=1e-6, abs=1e-8)


@pytest.mark.parametrize("criterion", EVERY, ids=lambda c: type(c).__name__)
def test_matrices_that_leave_something_untold_are_worth_nothing(criterion) -> None:
    rows = np.random.default_rng(0).normal(size=(3, 6))
    assert criterion.value(np.zeros((6, 6))) == -np.inf
    assert criterion.value(rows.T @ rows - 1e-6 * np.eye(6)) == -np.inf


def test_values_are_what_their_names_say() -> None:
    m = information()
    eigenvalues = np.linalg.eigvalsh(m)
    p = len(m)
    assert DOptimality().value(m) == pytest.approx(np.log(eigenvalues).sum())
    assert AOptimality().value(m) == pytest.approx(-p * np.log(np.mean(1 / eigenvalues)))
    draws = np.random.default_rng(0).multivariate_normal(np.zeros(p), np.linalg.inv(m), 200_000)
    cost = np.mean(np.einsum("np,pq,nq->n", draws, WEIGHT, draws))
    assert np.exp(-AOptimality(WEIGHT).value(m) / p) == pytest.approx(cost / p, rel=0.01)
    assert EOptimality().value(m) / p == pytest.approx(np.log(eigenvalues[0]), abs=np.log(p) / 16)
    assert ConditionNumber().value(m) / p == pytest.approx(
        -np.log(np.linalg.cond(m)) / 2, abs=np.log(p) / 16
    )


def test_a_focus_counts_what_is_left_when_all_else_is_unknown() -> None:
    m = information()
    chosen = [0, 4]
    covariance = np.linalg.inv(m)[np.ix_(chosen, chosen)]
    assert FocusedDOptimality((0, 4)).value(m) == pytest.approx(-np.linalg.slogdet(covariance)[1])
    assert FocusedDOptimality(tuple(range(6))).value(m) == pytest.approx(DOptimality().value(m))


def test_units_do_not_move_the_best_design_for_d() -> None:
    first, second, units = information(1), information(2), np.geomspace(1e-3, 1e3, 6)
    scaled = [m * np.outer(units, units) for m in (first, second)]
    apart = DOptimality().value(first) - DOptimality().value(second)
    assert DOptimality().value(scaled[0]) - DOptimality().value(scaled[1]) == pytest.approx(apart)


def test_unknown_names_are_refused_with_the_known_ones() -> None:
    with pytest.raises(UsageError, match="available: d, a, e, condition"):
        select_criterion("best")
    with pytest.raises(UsageError, match="D_s"):
        select_criterion("a", [1])
