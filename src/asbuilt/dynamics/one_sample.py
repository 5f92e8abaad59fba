"""Torque and mass matrix of one sample, without the checks and the overhead of many."""

# mypy: allow-untyped-calls

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from typing import Any

import numpy as np

from asbuilt.arrays import Array, Indices
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.drives.drive_set import NO_DRIVE, DriveSet
from asbuilt.dynamics.drives.formula import STATE, Formula
from asbuilt.dynamics.kernels import single_sample
from asbuilt.dynamics.kernels.operations import ACT, ADD, MULTIPLY, NUMBER, OPERATIONS, SPEND
from asbuilt.dynamics.kernels.recursion import build_layout

Row = tuple[int, int, float]
"""Operation, joint and constant."""


def compile_drives(drive: DriveSet, values: Array, shares: Array) -> tuple[Indices, Array]:
    """Return a program that adds the drive torques of all joints, and its constants.

    `values` (n columns_per_joint,) are the drive parameters joint by joint, `shares` (n, n) the
    `motor_shares` of the robot. The program has rows of operation, joint and place of a constant.
    """
    n = len(shares)
    rows = list[Row]()
    for k, own in enumerate(values.reshape(n, -1)):
        left = own.tolist()
        for term in drive.at(k).terms:
            acts_on = shares[k] if term.of_motor else np.eye(n)[k]
            stated = {each.name: term.value(each.name) for each in term.nonlinear}
            for column in term.columns:
                value = left.pop(0)
                if value and term.is_at(k) and acts_on.any():
                    rows += _write_column_rows(column, stated, acts_on)
                    acting = [(ACT, int(j), value * acts_on[j]) for j in np.flatnonzero(acts_on)]
                    rows += [*acting[:-1], (SPEND, *acting[-1][1:])]
    constants = dict.fromkeys(constant for _, _, constant in rows)
    places = {constant: place for place, constant in enumerate(constants)}
    program = [(operation, joint, places[constant]) for operation, joint, constant in rows]
    return np.array(program, dtype=np.int64).reshape(-1, 3), np.array(list(constants), dtype=float)


def _write_column_rows(column: str, stated: Mapping[str, float], acts_on: Array) -> list[Row]:
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


class OneSample:
    """Evaluate a robot for one sample at a time.

    Each method returns None unless its arguments are arrays (n,) of finite float64, and for robots
    with joints that follow others; the caller then takes the general road, which converts or
    raises.
    """

    __slots__ = ("_codes", "_general", "_mass", "_n", "_numbers", "_program", "_still", "_torque")

    def __init__(
        self, model: RobotModel, drive: DriveSet, values: Array, parameters: Array
    ) -> None:
        self._general = model.coupling is not None
        if self._general:
            return
        layout = build_layout(model)
        n = model.n_joints
        program, constants = compile_drives(drive, values, model.motor_shares)
        links = np.hstack([layout.placements, parameters.reshape(n, 10)]).ravel()
        self._n, self._still = n, np.zeros(n)
        self._codes = layout.codes.ravel().copy()
        self._program = np.concatenate([self._codes, program.ravel()])
        work = np.zeros(single_sample.work_size(n))
        self._numbers = np.concatenate([links, layout.gravity, constants, work])
        self._torque, self._mass = single_sample.torque, single_sample.mass_matrix

    def torque(self, q: Any, qd: Any, qdd: Any) -> Array | None:
        """Return the torques of rigid bodies and drives [N m or N], shape (n,)."""
        if self._general:
            return None
        out = np.empty(self._n)
        try:
            return out if self._torque(self._program, self._numbers, q, qd, qdd, out) else None
        except TypeError:
            return None

    def gravity(self, q: Any) -> Array | None:
        """Return the torques that hold the rigid bodies at rest [N m or N], shape (n,)."""
        if self._general:
            return None
        out = np.empty(self._n)
        still = self._still
        try:
            return out if self._torque(self._codes, self._numbers, q, still, still, out) else None
        except TypeError:
            return None

    def mass_matrix(self, q: Any) -> Array | None:
        """Return the mass matrix of the rigid bodies, shape (n, n)."""
        if self._general:
            return None
        out = np.zeros((self._n, self._n))
        try:
            return out if self._mass(self._codes, self._numbers, q, out) else None
        except TypeError:
            return None


@lru_cache(maxsize=16)
def compile_rigid_bodies(model: RobotModel) -> OneSample:
    """Return the rigid bodies of a robot, remembered for the robots used last."""
    return OneSample(model, NO_DRIVE, np.empty(0), model.parameters)
