"""The regrouping: its checks of symbols, and what a turn about a joint leaves as it is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from asbuilt.description.inertia import LinkInertia
from asbuilt.description.load import load_robot
from asbuilt.dynamics.base.regrouping import AXIAL, structural_regrouping, symbolic_regrouping
from asbuilt.dynamics.drives.selection import DriveSet


def test_axial_directions_span_exactly_the_masses_on_the_axis() -> None:
    masses = [
        LinkInertia.from_com(1.0, [0.0, 0.0, height], np.zeros((3, 3))).parameters
        for height in (0.0, 0.3, -1.0)
    ]
    found = np.linalg.lstsq(AXIAL.T, np.transpose(masses), rcond=None)[0]
    np.testing.assert_allclose(AXIAL.T @ found, np.transpose(masses), atol=1e-12)
    assert np.linalg.matrix_rank(found) == np.linalg.matrix_rank(AXIAL) == 3


def test_a_row_in_symbols_that_is_not_the_numbers_keeps_the_numbers() -> None:
    model, drive = load_robot("ur10e"), DriveSet()
    found = structural_regrouping(model, drive)
    longer = {symbol: 2.0 * length for symbol, length in model.lengths.items()}

    def has_letters(matrix):
        """Which rows change with the lengths."""
        rows = symbolic_regrouping(model, drive, replace(found, matrix=matrix))
        return [
            any(each.value(longer) != each.value(model.lengths) for each in row.values())
            for row in rows
        ]

    every = has_letters(found.matrix)
    b = every.index(True)
    j = np.flatnonzero(found.matrix[b])[-1]
    for share, kept in ((1e-6, False), (1e-12, True)):
        matrix = found.matrix.copy()
        matrix[b, j] += share * np.abs(matrix[b]).max()
        assert has_letters(matrix) == [*every[:b], kept, *every[b + 1 :]]
