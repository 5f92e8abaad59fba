"""The drive terms that a robot calls for where nobody says otherwise."""

from __future__ import annotations

from dataclasses import replace

from asbuilt.description.model import RobotModel
from asbuilt.dynamics.drives.selection import DriveSet, available_terms
from asbuilt.dynamics.drives.term import MOTOR_SOURCES
from asbuilt.dynamics.drives.torque import described_drive
from asbuilt.errors import UsageError


def usual_drive(model: RobotModel, source: str) -> DriveSet:
    """Return the usual drive terms of a robot for a torque of this source.

    These are those that its description names (`usual_drive`), or the default terms and those of
    coupled motors if the source measures motors; besides, the springs and balancers described.
    """
    drive = DriveSet.parse(model.usual_drive) if model.usual_drive else DriveSet.default(source)
    if source in MOTOR_SOURCES and not model.usual_drive:
        drive = DriveSet((*drive.terms, *coupled_motor_terms(model).terms))
    described = tuple(
        term
        for term in described_drive(model)[0].terms
        if term.by_construction and term.key not in drive.keys
    )
    return on_driven_joints(model, DriveSet((*drive.terms, *described)))


def on_driven_joints(model: RobotModel, drive: DriveSet) -> DriveSet:
    """Return drive terms without those of a free base, whose joints have no drive.

    Raises `UsageError` for terms that contact forces, which are unknown, would enter.
    """
    if not model.n_floating:
        return drive
    refused = [term.key for term in drive.terms if term.needs_load or term.free_nonlinear]
    if refused and model.contacts:
        raise UsageError(
            f"drive term {refused[0]!r} is not identified where contact forces are projected away:"
            " it depends on the load of its joint, or on a number that each joint fits alone; state"
            " its nonlinear parameters, or take viscous, coulomb and offset"
        )
    driven = set(range(model.n_floating + 1, model.n_joints + 1))
    return DriveSet(
        tuple(
            replace(term, joints=tuple(sorted(driven.intersection(term.joints or driven))))
            for term in drive.terms
        )
    )


def coupled_motor_terms(model: RobotModel) -> DriveSet:
    """Return armature and friction of the motors that turn with several joints."""
    numbers = tuple(k + 1 for k, shares in enumerate(model.motor_shares) if shares.any())
    terms = [
        replace(term, joints=numbers)
        for term in available_terms().values()
        if term.of_motor and not term.by_construction
    ]
    return DriveSet(tuple(terms)) if numbers else DriveSet()
