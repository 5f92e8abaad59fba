"""The regrouping: its checks of symbols, and what a turn about a joint leaves as it is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from asbuilt.description import DHRow, LinkInertia, load_robot, robot_from_dh
from asbuilt.dynamics import DriveSet, find_base_parameters
from asbuilt.dynamics.base.regrouping import AXIAL, regroup_structurally, regroup_symbolically

from .test_base_parameters_random import assert_regroups, first_independent, stacked


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
    found = regroup_structurally(model, drive)
    longer = {symbol: 2.0 * length for symbol, length in model.lengths.items()}

    def has_letters(matrix):
        """Which rows change with the lengths."""
        rows = regroup_symbolically(model, drive, replace(found, matrix=matrix))
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


@pytest.mark.parametrize("light", [(0,), (1,), (2,), (0, 2), (1, 2)])
def test_links_without_mass_have_no_columns_and_leave_others_their_own(light):
    robot = robot_from_dh(
        [DHRow(b=0.3, alpha=np.pi / 2), DHRow(a=0.4), DHRow(a=0.3, alpha=0.6), DHRow(b=0.1)],
        name="elbow",
    )
    links = [replace(link, negligible=k in light) for k, link in enumerate(robot.links)]
    bare = replace(robot, links=tuple(links))
    drive = DriveSet.parse("armature,viscous")
    Y, columns = stacked(bare, drive), [10 * k + j for k in light for j in range(10)]
    Y[:, columns] = 0.0
    base = find_base_parameters(bare, drive)
    assert base.columns.tolist() == first_independent(Y)
    assert_regroups(base, Y)
    assert not base.regrouping[:, columns].any()
    assert base.symbolic == base.expressions
