"""Normal equations in the search for a servo's law, against SciPy, NumPy and exact fractions."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
from scipy.optimize import nnls

from asbuilt.identification import Equations, TimeBlock
from asbuilt.identification.servo.servo_fits import _solve_bounded
from asbuilt.identification.servo.servo_rows import block_energies, block_weights


def test_bounds_are_those_of_nonnegative_least_squares_from_any_guess() -> None:
    rng = np.random.default_rng(2)
    A, b = rng.normal(size=(50, 8)), rng.normal(size=50)
    expected, _ = nnls(A, b)
    inside = np.flatnonzero(expected > 0.0)
    assert 0 < inside.size < 8
    for near in (inside, np.arange(8), inside[:1]):
        x, free = _solve_bounded(A.T @ A, A.T @ b, np.zeros(8), near)
        assert x == pytest.approx(expected, abs=1e-9)
        assert free.tolist() == inside.tolist()


def test_a_residual_that_cancels_to_nothing_has_not_all_of_the_weight() -> None:
    """Rows that excite little leave large coefficients; their exact squares are alike."""
    rng = np.random.default_rng(3)
    column = rng.normal(size=(6, 40))
    rows = np.stack([column, column + 1e-9 * rng.normal(size=(6, 40)), column], axis=2)
    residual = np.array([1e7, -1e7, 1e-3])
    blocks = tuple(TimeBlock("log", float(b), b + 1.0, 40) for b in range(6))
    grams = np.swapaxes(rows, 1, 2) @ rows
    equations = Equations({"all": 2}, (np.arange(2),), (grams,), blocks, np.full((1, 6), 40.0))
    exact = [
        float(sum(sum(Fraction(x) * Fraction(w) for x, w in zip(row, residual, strict=True)) ** 2
                  for row in block.tolist()))
        for block in rows
    ]  # fmt: skip
    assert np.any(equations.energies(0, residual) < 0.1 * np.array(exact))
    assert np.all(block_energies(equations, 0, residual) >= np.array(exact))
    weights = block_weights(equations, 0, residual)
    assert np.all((weights > 0.05) & (weights < 0.95))
