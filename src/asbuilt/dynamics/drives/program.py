"""Drive torques as a program for the stack machine of the single-sample kernels."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from asbuilt.arrays import Array, Indices
from asbuilt.dynamics.drives.formula import STATE, Formula
from asbuilt.dynamics.drives.selection import DriveSet
from asbuilt.dynamics.kernels.operations import ACT, ADD, MULTIPLY, NUMBER, OPERATIONS, SPEND

Row = tuple[int, int, float]
"""Operation, joint and constant."""


def drive_program(drive: DriveSet, values: Array, shares: Array) -> tuple[Indices, Array]:
    """Return a program that adds the drive torques of all joints, and its constants.

    `values` (n columns_per_joint,) are the drive parameters joint by joint, `shares` (n, n) the
    `motor_shares` of the robot. The program has rows of operation, joint and place of a constant.
    """
    n, rows = len(shares), list[Row]()
    for k, own in enumerate(values.reshape(n, -1)):
        left = own.tolist()
        for term in drive.at(k).terms:
            acts_on = shares[k] if term.of_motor else np.eye(n)[k]
            stated = {each.name: term.value(each.name) for each in term.nonlinear}
            for column in term.columns:
                value = left.pop(0)
                if value and term.is_at(k) and acts_on.any():
                    rows += _column_rows(column, stated, acts_on)
                    acting = [(ACT, int(j), value * acts_on[j]) for j in np.flatnonzero(acts_on)]
                    rows += [*acting[:-1], (SPEND, *acting[-1][1:])]
    constants = dict.fromkeys(constant for _, _, constant in rows)
    places = {constant: place for place, constant in enumerate(constants)}
    program = [(operation, joint, places[constant]) for operation, joint, constant in rows]
    return np.array(program, dtype=np.int64).reshape(-1, 3), np.array(list(constants), dtype=float)


def _column_rows(column: str, stated: Mapping[str, float], acts_on: Array) -> list[Row]:
    """Return the rows that leave the value of a column on the stack."""

    def number(value: float) -> list[Row]:
        return [(NUMBER, 0, value)]

    def name(text: str) -> list[Row]:
        if text not in STATE:
            return number(stated[text])
        rows = list[Row]()
        for j in np.flatnonzero(acts_on):
            rows += [(OPERATIONS.index(text), int(j), 0.0)]
            rows += (
                [] if acts_on[j] == 1.0 else [(NUMBER, 0, float(acts_on[j])), (MULTIPLY, 0, 0.0)]
            )
            rows += [] if j == np.flatnonzero(acts_on)[0] else [(ADD, 0, 0.0)]
        return rows

    def apply(operation: str, *parts: list[Row]) -> list[Row]:
        return [*(row for part in parts for row in part), (OPERATIONS.index(operation), 0, 0.0)]

    return Formula(column).fold(number, name, apply)
