"""Factors of rows that have some of the columns each, against one factor of all rows by numpy."""

import numpy as np
import pytest

from asbuilt.arrays import Array, Indices
from asbuilt.identification.information import triangular
from asbuilt.identification.information.triangular import join_factors, stack_factors

LIMBS = [  # Columns of the joints of two limbs at a trunk, each with drive columns of its own
    [0, 1, 2, 3, 4, 5, 6, 7, 8, 11],
    [3, 4, 5, 9],
    [5, 10],
    [6, 7, 8, 12],
    [8, 13],
]
APART = [[0, 1, 4], [2, 3, 5]]
MIXED = [list(range(6))] * 3
SPLIT = [[0, 3], [1, 2], [0, 1, 2, 3, 4], [2, 5]]


def plain_factor(parts: list[tuple[Indices, Array]], p: int) -> Array:
    whole = np.vstack([np.zeros((p + 1, p + 1)), *(spread(*part, p) for part in parts)])
    factor = np.linalg.qr(whole, mode="r")
    return factor * np.where(np.diag(factor) < 0.0, -1.0, 1.0)[:, None]


def spread(columns: Indices, rows: Array, p: int) -> Array:
    wide = np.zeros((len(rows), p + 1))
    wide[:, np.append(columns, p)] = rows
    return wide


@pytest.mark.parametrize("supports", [LIMBS, APART, MIXED, SPLIT])
@pytest.mark.parametrize("n_rows", [2, 30])
@pytest.mark.parametrize("triangles", [False, True])
@pytest.mark.parametrize("few", [0, 100])
def test_the_factor_of_parts_is_that_of_all_rows(
    supports: list[list[int]],
    n_rows: int,
    triangles: bool,
    few: int,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(triangular, "FEW_COLUMNS", few)
    rng = np.random.default_rng(n_rows)
    parts = []
    for own in supports:
        rows = rng.normal(size=(n_rows, len(own) + 1))
        parts.append((np.array(own), np.linalg.qr(rows, mode="r") if triangles else rows))
    p = 1 + max(max(own) for own in supports)

    found = stack_factors(parts, p)

    expected = plain_factor(parts, p)
    assert np.all(np.tril(found, -1) == 0.0)
    # Signs of rows that say nothing are arbitrary, so squares are compared where rows are few.
    np.testing.assert_allclose(found.T @ found, expected.T @ expected, atol=1e-12)
    if n_rows > p:
        np.testing.assert_allclose(found, expected, atol=1e-12)


@pytest.mark.parametrize("size", [1, 7, 40])
def test_factors_are_joined_as_their_rows(size: int) -> None:
    rng = np.random.default_rng(size)
    one, other = np.triu(rng.normal(size=(2, size, size)))
    before = one.copy(), other.copy()

    found = join_factors(one, other)

    expected = np.linalg.qr(np.vstack([one, other]), mode="r")
    expected *= np.where(np.diag(expected) < 0.0, -1.0, 1.0)[:, None]
    np.testing.assert_allclose(found, expected, atol=1e-12)
    # What is joined is used again: prefixes and suffixes share their factors.
    np.testing.assert_array_equal((one, other), before)
