"""Torque and mass matrix of one sample, without the checks and the overhead of many."""

# mypy: allow-untyped-calls

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.drives.program import drive_program
from asbuilt.dynamics.drives.selection import NO_DRIVE, DriveSet
from asbuilt.dynamics.kernels import single_sample
from asbuilt.dynamics.kernels.recursion import layout_of


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
        layout, n = layout_of(model), model.n_joints
        program, constants = drive_program(drive, values, model.motor_shares)
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
        out, still = np.empty(self._n), self._still
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
def rigid_bodies(model: RobotModel) -> OneSample:
    """Return the rigid bodies of a robot, remembered for the robots used last."""
    return OneSample(model, NO_DRIVE, np.empty(0), model.parameters)
