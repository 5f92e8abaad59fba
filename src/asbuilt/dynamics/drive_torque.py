"""What the drives add to the torque of the rigid bodies."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from asbuilt.description.model import RobotModel
from asbuilt.dynamics.drives.selection import DriveSet, available_terms
from asbuilt.errors import UsageError

Array = NDArray[np.float64]


def drive_columns(
    drive: DriveSet,
    k: int,
    q: Array,
    qd: Array,
    qdd: Array,
    *,
    load: Array | None = None,
    shares: Array | None = None,
    out: Array | None = None,
) -> Array:
    """Return the columns of the drive parameters of joint k (counted from 0), shape (columns_per_joint, N), from the state of all joints, each (N, n).

    Columns of terms `of_motor` enter the torque of every joint j multiplied by `shares[k, j]` (the robot's `motor_shares`), all others that of joint k alone.
    """
    turned = None if shares is None or not shares[k].any() else shares[k]
    return drive.evaluate(
        *(np.ascontiguousarray(x[:, k]) for x in (q, qd, qdd)),
        load=None if load is None else np.ascontiguousarray(load[:, k]),
        out=out,
        joint=k,
        motor=None if turned is None else (q @ turned, qd @ turned, qdd @ turned),
    )


def drive_torque(
    drive: DriveSet,
    values: ArrayLike,
    q: Array,
    qd: Array,
    qdd: Array,
    *,
    load: Array | None = None,
    shares: Array | None = None,
) -> Array:
    """Return `sum_k column_k(q, qd, qdd) value_k` of every joint [N m or N], shape (N, n) as `q`, `qd`, `qdd`.

    `values` (n columns_per_joint,) holds the drive parameters joint by joint, in the order of `drive.names`; `load` (N, n) is the torque of the
    rigid bodies, for terms that depend on it; `shares` (n, n) are the `motor_shares` of the robot, for motors that several joints turn.

    Raises
    ------
    UsageError
        If the number of values does not fit.
    """
    n = q.shape[1]
    theta = np.asarray(values, dtype=np.float64)
    if theta.shape != (n * drive.columns_per_joint,):
        raise UsageError(
            f"{n} joints with drive terms {drive} have {n * drive.columns_per_joint} drive parameters, got shape {theta.shape}"
        )
    torque = np.zeros(q.shape)
    of_motor = drive.of_motor
    for k, joint_values in enumerate(theta.reshape(n, -1)):
        columns = drive_columns(drive, k, q, qd, qdd, load=load, shares=shares)
        torque[:, k] += joint_values[~of_motor] @ columns[~of_motor]
        if of_motor.any() and shares is not None and shares[k].any():
            torque += np.outer(joint_values[of_motor] @ columns[of_motor], shares[k])
    return torque


def described_drive(model: RobotModel) -> tuple[DriveSet, Array]:
    """Return the drive terms of which the description gives any value, and the values joint by joint, zero where it is silent."""
    stated = [
        term
        for term in available_terms().values()
        if any(value is not None for joint in model.joints for value in term.values(joint.drive))
    ]
    drive = DriveSet(tuple(stated))
    values = [0.0 if value is None else value for joint in model.joints for value in drive.values(joint.drive)]
    return drive, np.array(values, dtype=np.float64)
