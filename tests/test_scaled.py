"""What a matrix determines, by exact matrices and by the definitions of inverse and root."""

from __future__ import annotations

import numpy as np
import pytest

from asbuilt.scaled import Scaled


@pytest.fixture
def rows() -> np.ndarray:
    """Return rows of seven columns in units far apart: one absent, one the sum of two others."""
    rng = np.random.default_rng(4)
    rows = rng.normal(size=(60, 7)) * np.array([1.0, 1e-5, 1e4, 1.0, 1e2, 1.0, 1.0])
    rows[:, 3] = 0.0
    rows[:, 5] = rows[:, 0] + rows[:, 6]
    return rows


def test_finds_rank_and_what_is_determined_in_any_units(rows: np.ndarray) -> None:
    own = Scaled(rows.T @ rows)
    assert own.rank == 5
    assert own.determined.tolist() == [False, True, True, False, True, False, False]
    assert own.condition == np.inf


def test_pseudo_inverse_is_one_by_the_conditions_of_penrose_in_scaled_columns(
    rows: np.ndarray,
) -> None:
    A = rows.T @ rows
    own = Scaled(A)
    unit = np.outer(own.size, own.size)
    B, inverse = A / unit, own.pseudo_inverse * unit
    np.testing.assert_allclose(B @ inverse @ B, B, atol=1e-12)
    np.testing.assert_allclose(inverse @ B @ inverse, inverse, atol=1e-10)
    np.testing.assert_allclose(B @ inverse, (B @ inverse).T, atol=1e-12)
    np.testing.assert_allclose(own.root.T @ own.root / unit, B, atol=1e-12)
    np.testing.assert_allclose(own.inverse_diagonal, np.diag(own.pseudo_inverse))


def test_solves_as_least_squares_of_the_rows_do(rows: np.ndarray) -> None:
    y = rows @ np.array([1.0, 2e5, 3e-4, 0.0, 0.5, 1.0, -2.0])
    x = Scaled(rows.T @ rows).solve(rows.T @ y)
    np.testing.assert_allclose(rows @ x, y, rtol=1e-8)
    assert abs(x[3]) < 1e-10


def test_whitens_a_covariance(rows: np.ndarray) -> None:
    own = Scaled(rows.T @ rows)
    white = own.whiten(rows.T)
    np.testing.assert_allclose(white @ white.T, np.eye(5), atol=1e-11)
    assert own.square(rows[0]) == pytest.approx(white[:, 0] @ white[:, 0])


def test_condition_and_inverse_of_a_full_matrix() -> None:
    A = np.array([[4.0, 1.0], [1.0, 9.0]])
    own = Scaled(A)
    np.testing.assert_allclose(own.pseudo_inverse, np.linalg.inv(A))
    assert own.condition == pytest.approx(np.linalg.cond([[1.0, 1.0 / 6.0], [1.0 / 6.0, 1.0]]))


def test_raised_matrix_has_no_direction_that_does_not_count(rows: np.ndarray) -> None:
    covariance = rows[:, [0, 5, 6]].T @ rows[:, [0, 5, 6]]
    own = Scaled(covariance).raised(1e-9)
    assert own.rank == 3
    assert own.condition == pytest.approx(1e9)
    np.testing.assert_allclose(own.matrix, covariance, rtol=1e-6, atol=1e-6)
    exact = Scaled(np.diag([1.0, 4.0]))
    np.testing.assert_allclose(exact.raised().pseudo_inverse, exact.pseudo_inverse)
