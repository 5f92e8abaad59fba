"""What the drives add to the torque of the rigid bodies, and the terms that a robot calls for."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from asbuilt.arrays import Array
from asbuilt.description.model import RobotModel
from asbuilt.dynamics.drives.drive_set import DriveSet, available_terms
from asbuilt.dynamics.drives.term import MOTOR_SOURCES, DriveTerm, NonlinearValue
from asbuilt.dynamics.parameters import parameter_values
from asbuilt.errors import DescriptionError, UsageError

AT_ONCE = 10_000
"""Samples whose columns are held at once."""


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
    """Return the columns of the drive parameters of joint k (counted from 0).

    Shape (columns_per_joint, N), from the state of all joints, each (N, n).

    Columns of terms `of_motor` enter the torque of every joint j multiplied by `shares[k, j]` (the
    robot's `motor_shares`), all others the torque of joint k alone.
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
    """Return `sum_k column_k(q, qd, qdd) value_k` of every joint [N m or N].

    The shape is (N, n), like the shape of `q`, `qd`, `qdd`.

    `values` (n columns_per_joint,) holds the drive parameters joint by joint, in the order of
    `drive.names`; `load` (N, n) is the torque of the rigid bodies, for terms that depend on it;
    `shares` (n, n) are the `motor_shares` of the robot, for motors that several joints turn.

    Raises
    ------
    UsageError
        If the number of values does not fit.
    """
    n = q.shape[1]
    theta = np.asarray(values, dtype=np.float64)
    if theta.shape != (n * drive.columns_per_joint,):
        raise UsageError(
            f"{n} joints with drive terms {drive} have {n * drive.columns_per_joint} drive"
            f" parameters, got shape {theta.shape}"
        )
    torque = np.zeros(q.shape)
    of_motor = drive.of_motor
    each = theta.reshape(n, -1)
    if not of_motor.any() and not any(term.differs_by_joint for term in drive.terms):
        return _evaluate_shared_terms(drive, each, q, qd, qdd, load)
    for k, joint_values in enumerate(each):
        columns = drive_columns(drive, k, q, qd, qdd, load=load, shares=shares)
        torque[:, k] += joint_values[~of_motor] @ columns[~of_motor]
        if of_motor.any() and shares is not None and shares[k].any():
            torque += np.outer(joint_values[of_motor] @ columns[of_motor], shares[k])
    return torque


def _evaluate_shared_terms(
    drive: DriveSet, values: Array, q: Array, qd: Array, qdd: Array, load: Array | None
) -> Array:
    """Return the torque of terms whose columns are one function of each joint's own state."""
    torque = np.zeros(q.shape)
    column = 0
    for term in drive.terms:
        s = len(term.symbols)
        at = [k for k in range(q.shape[1]) if term.is_at(k)]
        # Most terms are at every joint: a slice copies nothing.
        joints = slice(None) if len(at) == q.shape[1] else at
        own = values[joints, column : column + s]
        column = column + s
        # some samples at a time, so that a long recording takes no memory for its columns
        for first in range(0, len(q), AT_ONCE):
            part = slice(first, first + AT_ONCE)
            state = (q[part], qd[part], qdd[part], None if load is None else load[part])
            columns = np.empty((s, *state[0].shape))
            term.evaluate(*state, columns)
            torque[part, joints] += sum(
                column_of_term * factors
                for column_of_term, factors in zip(columns[:, :, joints], own.T, strict=True)
            )
    return torque


def described_drive(model: RobotModel) -> tuple[DriveSet, Array]:
    """Return the drive terms of which the description gives any value, and the values.

    Nonlinear parameters come from the description; values are joint by joint, zero where it has
    none.

    Raises
    ------
    DescriptionError
        If it names a term that does not exist, or a parameter that a term does not have.
    """
    known = available_terms()
    for joint in model.joints:
        for key, numbers in joint.drive.terms.items():
            _check_described(
                known, f"{model.name}: the drive of joint {joint.name!r}", key, numbers
            )
    stated = []
    for key, term in known.items():
        there = [k for k, joint in enumerate(model.joints) if key in joint.drive.terms]
        if there:
            stated.append(_state_as_described(model, term, there))
        elif any(value is not None for joint in model.joints for value in term.values(joint.drive)):
            stated.append(term)
    drive = DriveSet(tuple(stated))
    return drive, np.nan_to_num(parameter_values(model, drive)[len(model.parameters) :], nan=0.0)


def spring_columns(model: RobotModel, q: Array) -> Array:
    """Return the columns of described springs, balancers and cylinders, (n, N, m).

    At positions (N, n); zero at joints that lack them.
    """
    described = (term for term in described_drive(model)[0].terms if term.by_construction)
    drive = DriveSet(tuple(term for term in described if term.by_position and not term.of_motor))
    still = np.zeros_like(q)
    return np.stack([drive_columns(drive, k, q, still, still).T for k in range(model.n_joints)])


def _state_as_described(model: RobotModel, term: DriveTerm, there: list[int]) -> DriveTerm:
    """Return a term as described: its nonlinear parameters and joints (counted from 0)."""
    parameters: dict[str, NonlinearValue] = {}
    for parameter in term.nonlinear:
        numbers = tuple(
            float(joint.drive.terms.get(term.key, {}).get(parameter.name, parameter.default))
            for joint in model.joints
        )
        parameters[parameter.name] = numbers[0] if len(set(numbers)) == 1 else numbers
    joints = None if len(there) == model.n_joints else tuple(k + 1 for k in there)
    return replace(term.with_nonlinear(parameters), joints=joints)


def _check_described(
    known: Mapping[str, DriveTerm], where: str, key: str, numbers: Mapping[str, float]
) -> None:
    if key not in known:
        raise DescriptionError(
            f"{where} has a term {key!r}, which does not exist; there are {', '.join(known)}"
        )
    names = (*known[key].symbols, *(parameter.name for parameter in known[key].nonlinear))
    for name in numbers:
        if name not in names:
            raise DescriptionError(
                f"{where} has {name!r} in its term {key!r}, which has {', '.join(names)}"
            )


def choose_usual_drive(model: RobotModel, source: str) -> DriveSet:
    """Return the usual drive terms of a robot for a torque of this source.

    Its description names them (`choose_usual_drive`), or they are the default terms and terms of
    coupled motors if the source measures motors; besides, the springs and balancers described.
    """
    drive = DriveSet.parse(model.usual_drive) if model.usual_drive else DriveSet.default(source)
    if source in MOTOR_SOURCES and not model.usual_drive:
        drive = DriveSet((*drive.terms, *list_coupled_motor_terms(model).terms))
    described = tuple(
        term
        for term in described_drive(model)[0].terms
        if term.by_construction and term.key not in drive.keys
    )
    return keep_driven_joints(model, DriveSet((*drive.terms, *described)))


def keep_driven_joints(model: RobotModel, drive: DriveSet) -> DriveSet:
    """Return drive terms for the joints of a robot that have a drive.

    Raises `UsageError` for terms that reactions, which are unknown, would enter.
    """
    if len(model.driven_joints) == model.n_joints:
        return drive
    refused = [term.key for term in drive.terms if term.needs_load or term.free_nonlinear]
    if refused and model.has_reactions:
        raise UsageError(
            f"drive term {refused[0]!r} is not identified where reactions are projected away:"
            " it depends on the load of its joint, or on a number that each joint fits alone; state"
            " its nonlinear parameters, or take viscous, coulomb and offset"
        )
    driven = {k + 1 for k in model.driven_joints}
    return DriveSet(
        tuple(
            replace(term, joints=tuple(sorted(driven.intersection(term.joints or driven))))
            for term in drive.terms
        )
    )


def list_coupled_motor_terms(model: RobotModel) -> DriveSet:
    """Return armature and friction of the motors that turn with several joints."""
    numbers = tuple(k + 1 for k, shares in enumerate(model.motor_shares) if shares.any())
    terms = [
        replace(term, joints=numbers)
        for term in available_terms().values()
        if term.of_motor and not term.by_construction
    ]
    return DriveSet(tuple(terms)) if numbers else DriveSet()
