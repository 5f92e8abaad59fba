"""What the drive parameters of a robot have in common with each other and with its links."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from asbuilt.arrays import Array, Mask
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.base.regrouping_relations import (
    RegroupingRelations,
    null_space,
    reversed_echelon,
)
from asbuilt.dynamics.drives.selection import DriveSet

IMITABLE = ("qdd", "1", "sin(q)", "cos(q)")
"""Elementary functions that links can imitate, in the order of the changes of
`RegroupingRelations`.
"""


@dataclass(frozen=True, eq=False)
class DriveStructure:
    """Hold, for a robot of n joints with drives of m columns each, all columns scaled.

    `ways[k, f]` (m,) are the columns of joint k that make up the elementary function f of
    `IMITABLE`, zero where `able[k, f]` is False; `redundant` (r, n m) are sums of drive columns
    that are zero at all times; `motor_columns` (n, m) says which columns are armatures of motors
    that several joints turn; `shares` (n, n) are the robot's `motor_shares`, scaled.
    """

    ways: Array
    able: Mask
    redundant: Array
    motor_columns: Mask
    shares: Array

    @property
    def imitable(self) -> Mask:
        """What the drive of each joint has that links may imitate (n, 5), mutual armatures last."""
        mutual = np.full(len(self.able), self.motor_columns.any())
        return np.column_stack([self.able[:, 0] | mutual, self.able[:, 1:], mutual])


def decompose_drive(model: RobotModel, drive: DriveSet, unit: Array) -> DriveStructure:
    """Take the columns of a drive apart into elementary functions.

    `unit` (n,) is one unit of each joint coordinate in scaled lengths.
    """
    n = model.n_joints
    m = drive.columns_per_joint
    drive.check_joints(n)
    ways = np.zeros((n, 4, m))
    able = np.zeros((n, 4), dtype=bool)
    redundant = []
    shares = model.motor_shares * unit[None, :] / unit[:, None]
    coupled = np.abs(shares).max(axis=1) > 0.0
    of_motor = drive.of_motor
    armature_of_motor = np.array(
        [term.key == "motor_armature" for term in drive.terms for _ in term.symbols], dtype=bool
    )
    for k in range(n):
        functions = drive.functions(k)
        known = list(
            dict.fromkeys([*IMITABLE, *(name for function in functions for name in function)])
        )
        matrix = np.zeros((len(known), m))
        for column, function in enumerate(functions):
            for name, factor in function.items():
                matrix[known.index(name), column] = (
                    0.0 if of_motor[column] and not coupled[k] else factor
                )
        for f in range(4):
            wanted = np.zeros(len(known))
            wanted[f] = 1.0
            way, *_ = np.linalg.lstsq(matrix, wanted, rcond=None) if m else (np.zeros(0),)
            able[k, f] = bool(m) and float(np.abs(matrix @ way - wanted).max()) < 1e-12
            ways[k, f] = np.where(np.abs(way) < 1e-14, 0.0, way) if able[k, f] else 0.0
        for row in reversed_echelon(null_space(matrix))[0] if m else ():
            placed = np.zeros((n, m))
            placed[k] = row
            redundant.append(placed.ravel())
    return DriveStructure(
        ways,
        able,
        np.array(redundant).reshape(len(redundant), n * m),
        armature_of_motor[None, :] & coupled[:, None],
        shares,
    )


def find_realisable_sums(
    directions: list[RegroupingRelations], structure: DriveStructure
) -> tuple[Array, Array, Array]:
    """Return which sums of all directions the armatures at hand can make.

    (r, k) sums, with the armature changes of joints (r, n) and motors (r, n).

    A mutual armature of joints i and j exists only as a part of a motor's that both turn: `Q =
    diag(Ia) + sum_m Iam_m T_m T_m^T`.
    """
    n = len(structure.shares)
    armature = np.concatenate([found.drive[:, 0] for found in directions])
    mutual = np.vstack([found.mutual for found in directions])
    link = np.concatenate([np.full(len(found.child), found.link) for found in directions])
    k = len(link)
    motors = np.flatnonzero(structure.motor_columns.any(axis=1))
    conditions = np.zeros((n, n, k + len(motors)))
    for d in range(k):
        conditions[link[d], link[d], d] = armature[d]
        conditions[link[d], :, d] += mutual[d]
        conditions[:, link[d], d] += mutual[d]
    for column, motor in enumerate(motors, start=k):
        conditions[:, :, column] = -np.outer(structure.shares[motor], structure.shares[motor])
    free = np.zeros((n, n), dtype=bool)
    np.fill_diagonal(free, structure.able[:, 0])
    solutions, _ = reversed_echelon(null_space(conditions[np.triu(~free)]))
    of_motors = np.zeros((len(solutions), n))
    of_motors[:, motors] = solutions[:, k:]
    diagonal = np.einsum("iik,rk->ri", conditions, solutions)
    return solutions[:, :k], np.where(structure.able[:, 0], diagonal, 0.0), of_motors
