"""Inner products of rows by block against dense matrices."""

from __future__ import annotations

import numpy as np
import pytest

from asbuilt.identification import MODEL, TimeBlock
from asbuilt.identification.information.equations import BlockRows, Products

SUPPORT = (np.array([0, 1, 2, 5, 9]), np.array([1, 2, 3, 4, 6, 7, 9]), np.array([2, 8]))
COLUMNS = 10
WEIGHTS = np.array([1.0, 0.5, 3.0])
BLOCKS = 4


@pytest.fixture(scope="module")
def rows() -> BlockRows:
    """Rows of three joints: 0 to 3 are of the model, 9 is shared, all others are of one joint."""
    rng = np.random.default_rng(3)
    return BlockRows(
        {MODEL: 4, "effects": COLUMNS - 4},
        SUPPORT,
        tuple(rng.normal(size=(BLOCKS, 3 + k, len(s) + 1)) for k, s in enumerate(SUPPORT)),
        (TimeBlock("log", 0.0, 1.0, 5),) * BLOCKS,
    )


def dense(rows: BlockRows, blocks=range(BLOCKS)) -> np.ndarray:
    """Weighted rows of all joints in all columns, torque last."""
    stacked = []
    for own, support, weight in zip(rows.rows, rows.support, WEIGHTS, strict=True):
        wide = np.zeros((len(blocks) * own.shape[1], COLUMNS + 1))
        wide[:, np.append(support, COLUMNS)] = weight * own[list(blocks)].reshape(-1, own.shape[2])
        stacked.append(wide)
    return np.vstack(stacked)


def test_squares_are_those_of_all_rows(rows: BlockRows) -> None:
    every = np.arange(COLUMNS + 1)
    gram = dense(rows).T @ dense(rows)
    squares = rows.squares(WEIGHTS)
    assert squares.at(every, every) == pytest.approx(gram, abs=1e-12)
    assert squares.diagonal == pytest.approx(np.diag(gram), abs=1e-12)
    left = np.array([8, 2, 5, 10])
    right = np.array([7, 4, 9, 0, 5])
    assert squares.at(left, right) == pytest.approx(gram[np.ix_(left, right)], abs=1e-12)
    assert rows.inner(WEIGHTS, left[:3], right) == pytest.approx(
        gram[np.ix_(left[:3], right)], abs=1e-12
    )


def test_products_of_some_blocks(rows: BlockRows) -> None:
    every = np.arange(COLUMNS + 1)
    part = dense(rows, [0, 2])
    found = rows.inner(WEIGHTS, every, every, np.array([0, 2]))
    assert found == pytest.approx(part.T @ part, abs=1e-12)
    some = np.array([1, 5, 6, 9, 10])
    products = Products(some, found[np.ix_(some, some)])
    left = np.array([9, 1])
    right = np.array([10, 6, 5])
    assert products.at(left, right) == pytest.approx(found[np.ix_(left, right)], abs=1e-12)


def test_rows_of_some_columns_have_the_same_products(rows: BlockRows) -> None:
    some = np.array([0, 2, 6, 9])
    kept = rows.among(some)
    # The torque stays.
    asked = np.append(some, COLUMNS)
    expected = rows.inner(WEIGHTS, asked, asked)
    assert kept.inner(WEIGHTS, asked, asked) == pytest.approx(expected, abs=1e-12)
    assert sum(own.nbytes for own in kept.rows) < sum(own.nbytes for own in rows.rows)


def test_the_torque_of_some_columns(rows: BlockRows) -> None:
    found = rows.product(1, np.array([6, 0, 9]), np.array([2.0, 5.0, -1.0]))
    expected = 2.0 * rows.rows[1][..., 4] - rows.rows[1][..., 6]
    assert found == pytest.approx(expected)
