"""The robot as built: standard parameters and drives of a result, and states to compare it at."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from asbuilt.arrays import Array
from asbuilt.description.model import PLAIN_TERMS, DriveValues, RobotModel
from asbuilt.dynamics import (
    DriveSet,
    available_terms,
    drive_torque,
    inverse_dynamics,
)
from asbuilt.errors import IdentifiabilityError
from asbuilt.identification import (
    IdentificationResult,
    StandardParameters,
    as_built_parameters,
    feasible_intervals,
)
from asbuilt.identification.bodies.cad_prior import find_non_negative_columns
from asbuilt.identification.bodies.consistency import ROUNDING_OF_DRIVES
from asbuilt.writers.models.control import with_gains


@dataclass(frozen=True, slots=True, eq=False)
class AsBuilt:
    """Hold the standard parameters of a result and the robot that has them.

    The robot has all identified drive terms and no others.
    """

    parameters: StandardParameters
    model: RobotModel


def as_built(result: IdentificationResult, *, nearest: bool = False) -> AsBuilt:
    """Return the robot closest to CAD within the noise of the torques of the data used.

    If no physically consistent links have these torques, the links are inconsistent, or, with
    `nearest`, the consistent ones with the least torque difference on the data used, joints
    weighted by their noise.
    """
    found = as_built_parameters(result, nearest)
    robot = build_robot(result, found)
    sources = ", ".join(result.sources)
    notes = (
        *result.model.notes,
        *(note_feasible(result) if found.consistent else ()),
        f"identified ({result.method}) from {sources}; {found.verdict}",
    )
    return AsBuilt(found, replace(robot, notes=notes, source=f"identified from {sources}"))


def build_robot(result: IdentificationResult, found: StandardParameters) -> RobotModel:
    """Return the robot of a result with other standard parameters."""
    robot = with_standard_parameters(result.model, result.base.drive, found.parameters)
    return with_gains(robot, result.servo)


FEASIBLE_NOTE = "of these masses and armatures"
"""Beginning of the note on feasible intervals."""


@lru_cache(maxsize=8)
def note_feasible(result: IdentificationResult) -> tuple[str, ...]:
    """Return a note on masses and armatures that are a choice; none if all are determined."""
    try:
        intervals = feasible_intervals(result)
    except IdentifiabilityError:
        return ()
    open_ones = [
        f"{interval.quantity} {interval.text}" for interval in intervals if not interval.determined
    ]
    if not open_ones:
        return ()
    return (
        f"{FEASIBLE_NOTE} the recordings determine only these ranges (95 %), the values of the file"
        f" are the choice closest to CAD: {'; '.join(open_ones)}",
    )


def with_standard_parameters(model: RobotModel, drive: DriveSet, parameters: Array) -> RobotModel:
    """Return a robot with other standard parameters (n_standard,) and drive terms.

    Friction that is below zero by rounding becomes zero.
    """
    rigid = 10 * model.n_links
    robot = model.with_parameters(parameters[:rigid])
    drives = np.array(parameters[rigid:])
    bounded = find_non_negative_columns(model.n_links, model.n_joints, drive) - rigid
    # Rounding of the fit must not write a friction that drives.
    drives[bounded] = np.where(
        drives[bounded] > -ROUNDING_OF_DRIVES, np.maximum(drives[bounded], 0.0), drives[bounded]
    )
    values = drives.reshape(model.n_joints, -1)
    # Motors that several joints turn have their terms by the motor.
    turned = np.any(model.motor_shares, axis=1)
    joints = []
    for k, joint in enumerate(robot.joints):
        left = values[k].tolist()
        plain = dict[str, float]()
        terms = dict[str, dict[str, float]]()
        for term in drive.at(k).terms:
            term_values = left[: len(term.symbols)]
            left = left[len(term.symbols) :]
            if term.key in PLAIN_TERMS and term.is_at(k):
                plain[term.key] = term_values[0]
            elif term.is_at(k) and (turned[k] or not term.of_motor):
                terms[term.key] = dict(zip(term.symbols, term_values, strict=True)) | {
                    parameter.name: term.value(parameter.name) for parameter in term.nonlinear
                }
        # Gears and gains are no drive terms, and stay as described.
        kept = {name: getattr(joint.drive, name) for name in ("gear_ratio", "kp", "kd")}
        joints.append(replace(joint, drive=DriveValues(**plain, **kept, terms=terms)))
    return replace(robot, joints=tuple(joints), drives_by_design=True)


def keep_described_drives(
    robot: RobotModel, described: RobotModel
) -> tuple[RobotModel, tuple[str, ...]]:
    """Return a robot with the described values of plain drive terms not identified, and notes.

    If a richer term was identified in place of a plain one (`power` for `viscous`), the
    plain one is zero, since it would count the same friction twice.
    """
    joints = []
    as_described = set()
    replaced = dict[tuple[str, str], list[str]]()
    for joint, before in zip(robot.joints, described.joints, strict=True):
        richer = {
            stood_for: key
            for key in joint.drive.terms
            if (stood_for := available_terms()[key].stands_for) is not None
        }
        kept = {
            key: value
            for key in PLAIN_TERMS
            # Zero counts as none: the file then says nothing of it.
            if getattr(joint.drive, key) is None and (value := getattr(before.drive, key))
        }
        for key in kept:
            if key in richer:
                # The richer term holds the same friction.
                kept[key] = 0.0
                replaced.setdefault((key, richer[key]), []).append(joint.name)
            else:
                as_described.add(key)
        joints.append(replace(joint, drive=replace(joint.drive, **kept)))
    listed = ", ".join(key for key in PLAIN_TERMS if key in as_described)
    notes = [f"not identified, and as described: {listed} of the drives"] if listed else []
    for (key, richer_key), names in replaced.items():
        at = "" if len(names) == robot.n_joints else f" at {', '.join(names)}"
        notes.append(
            f"{key} of the description is left out{at}: {richer_key} was identified in its place"
        )
    return replace(robot, joints=tuple(joints)), tuple(notes)


def note_load_friction(result: IdentificationResult, built: AsBuilt) -> tuple[str, ...]:
    """Return a note if load-dependent friction differs from the result's.

    In the base parameters of a result the load contains what is grouped with a link, such as the
    armature of the first joint; the robot as built has it apart.
    """
    drive = result.base.drive
    if not drive.needs_load:
        return ()
    # Random states at which torques are compared.
    q, qd, qdd = draw_sample_states(built.model, 100)
    rigid = len(built.model.parameters)
    shares = built.model.motor_shares
    together = np.zeros(result.n_standard)
    # Grouped parameters on the links: the load that the result has.
    together[result.base.columns] = built.parameters.beta
    torques = []
    for chi in (together, built.parameters.parameters):
        load = inverse_dynamics(built.model, q, qd, qdd, parameters=chi[:rigid])
        torques.append(
            load + drive_torque(drive, chi[rigid:], q, qd, qdd, load=load, shares=shares)
        )
    apart = float(np.abs(torques[1] - torques[0]).max())
    note = (
        "load-dependent friction acts on the load of the links alone; in the result the load"
        " includes armatures grouped with a link. The torques differ by up to"
        f" {apart:.2g} N m in random motion"
    )
    # Torques [N m or N] that differ by less are the same.
    return (note,) if apart > 1e-9 else ()


def draw_sample_states(model: RobotModel, count: int) -> tuple[Array, Array, Array]:
    """Return `count` random q, qd, qdd within the limits, each (count, n); the same every time."""
    # A fixed seed: the same file gives the same note.
    rng = np.random.default_rng(0)
    n = model.n_joints
    # A turn, or half a metre, stands for limits that a joint does not have.
    reach = [np.pi if joint.is_revolute else 0.5 for joint in model.joints]
    lower = np.array(
        [max(joint.limits.lower, -r) for joint, r in zip(model.joints, reach, strict=True)]
    )
    upper = np.array(
        [min(joint.limits.upper, r) for joint, r in zip(model.joints, reach, strict=True)]
    )
    # Largest speed [rad/s or m/s].
    speed = np.array([min(joint.limits.velocity, 3.0) for joint in model.joints])
    # Limits apart from zero may leave upper below lower: the joint is held there.
    q = lower + (np.maximum(upper, lower) - lower) * rng.uniform(size=(count, n))
    # Largest acceleration [rad/s^2 or m/s^2].
    return (
        q,
        speed * rng.uniform(-1.0, 1.0, (count, n)),
        10.0 * rng.uniform(-1.0, 1.0, (count, n)),
    )
