"""Drive terms that a file format lacks, by the nearest friction and bias that it has."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from asbuilt.arrays import Array
from asbuilt.codec import make_plain
from asbuilt.description.model import PLAIN_TERMS, USUAL_GRAVITY, DriveValues, Joint, RobotModel
from asbuilt.dynamics import DriveSet, drive_columns, gravity_torque, inverse_dynamics
from asbuilt.identification.result.result import IdentificationResult
from asbuilt.tables import format_share
from asbuilt.writers.models.as_built import AsBuilt, draw_sample_states
from asbuilt.writers.models.physical import make_friction_plain

Holds = Callable[[str, Mapping[str, float]], bool]
"""Whether a format holds a drive term of this key and these numbers."""
STATES = 1000
"""Random states that stand for recordings of which a result has no data."""
NOTED = 5e-4
"""Share of a joint's torque from which a loss is told: what does not round to 0 %."""
GAINED = 1.1
"""Loss without the nearest terms over that with them from which both are told."""
PARTS: Mapping[str, Mapping[str, Mapping[str, float]]] = {
    "viscous": {"viscous": {"Fv": 1.0}, "asymmetric_viscous": {"Fvp": 1.0, "Fvn": 1.0}},
    "coulomb": {
        "coulomb": {"Fc": 1.0},
        "asymmetric_coulomb": {"Fcp": 1.0, "Fcn": 1.0},
        "smooth_coulomb": {"Fct": 1.0},
    },
    "offset": {"offset": {"Fo": 1.0}, "asymmetric_coulomb": {"Fcp": 1.0, "Fcn": -1.0}},
}
"""Parameters by term whose columns together are that of a plain term: `qd`, `sign(qd)` or 1."""


@dataclass(frozen=True, slots=True, eq=False)
class NearestTerms:
    """Hold a robot whose drives are the nearest that a format can say, and what that loses.

    Parameters
    ----------
    model
        The robot to write: its drives lack the terms `replaced`, plain ones stand for them.
    replaced
        Keys of these terms, each with the names of the joints that have it.
    lost, left_out
        RMS torque (n,) that the file lacks as a share of the joint's torque: as written, and had
        the terms only been left out. NaN for a joint whose torque is unknown.
    judged_by
        The motion on which that was found.
    """

    model: RobotModel
    replaced: Mapping[str, tuple[str, ...]]
    lost: Array
    left_out: Array
    judged_by: str

    def notes(self, kind: str, alternative: str) -> tuple[str, ...]:
        """Return what stands for missing terms and what is lost, in a sentence; none if nothing.

        `alternative` says what holds everything.
        """
        names = self.model.joint_names
        terms = ", ".join(
            key if len(joints) == len(names) else f"{key} ({', '.join(joints)})"
            for key, joints in self.replaced.items()
        )
        lost = [
            f"{name} {format_share(share)}"
            + (f" ({format_share(before)} without them)" if before > GAINED * share else "")
            for name, share, before in zip(names, self.lost, self.left_out, strict=True)
            if max(share, before) > NOTED
        ]
        if not terms and not lost:
            return ()
        stands = (
            f"{kind} has no place for the drive terms {terms}: the nearest values of terms that it"
            " has stand for them"
        )
        share = f"on {self.judged_by} the file lacks of the torque of {', '.join(lost)}"
        return ("; ".join([*([stands] if terms else []), *([share] if lost else []), alternative]),)

    def as_document(self) -> list[dict[str, Any]]:
        """Return the loss of every joint, ready for JSON; None where it is unknown."""
        shares = zip(make_plain(self.lost), make_plain(self.left_out), strict=True)
        return [
            {"joint": name, "lost": lost, "left_out": left_out}
            for name, (lost, left_out) in zip(self.model.joint_names, shares, strict=True)
        ]


@dataclass(frozen=True, slots=True, eq=False)
class _JointRows:
    """Hold torques of a joint: of drive parameters (N, c), plain terms (N,), everything (N,)."""

    drive: Array
    plain: Mapping[str, Array]
    torque: Array


def find_nearest_terms(
    result: IdentificationResult,
    built: AsBuilt,
    robot: RobotModel,
    holds: Holds,
    *,
    gravity: bool = True,
) -> NearestTerms:
    """Return the drives of a format that are nearest in torque to those of a result.

    `robot`, the one to write, has the drives of `built` and may have further ones as described.
    Terms that the format lacks give way to changes of the plain terms that it has, by least squares
    over the recordings with friction that is not negative. Without `gravity` the format has the
    usual one: what a tilted robot then lacks counts as lost.
    """
    drive = result.base.drive
    n = robot.n_joints
    values = built.parameters.parameters[10 * built.model.n_links :].reshape(n, -1)
    rows, count, judged_by = _gather_rows(result, built)
    joints = []
    squares = np.zeros((3, n))
    replaced = dict[str, list[str]]()
    for k, joint in enumerate(robot.joints):
        rich = [
            key
            for key, numbers in joint.drive.terms.items()
            if key not in PLAIN_TERMS and not holds(key, numbers)
        ]
        left_out, missing = _list_missing(drive, k, values[k], joint, holds, rich)
        plain = {key: column for key, column in rows[k].plain.items() if holds(key, {})}
        changes = _fit(rows[k].drive @ missing, plain, joint.drive)
        lost = rows[k].drive @ left_out
        squares[1, k] = lost @ lost
        for key, change in changes.items():
            lost = lost - change * plain[key]
        squares[0, k] = lost @ lost
        squares[2, k] = rows[k].torque @ rows[k].torque
        joints.append(_replace_terms(joint, changes, rich if changes else []))
        for key in rich if changes else ():
            replaced.setdefault(key, []).append(joint.name)
    tilted = np.zeros(n) if gravity else _measure_tilt(built.model)
    lacking = squares[:2] / count + tilted**2
    # A joint without torque in the recordings has no share.
    size = np.where(squares[2] > 0.0, squares[2] / count, np.nan)
    lost, left_out = np.sqrt(lacking / size)
    names = {key: tuple(having) for key, having in replaced.items()}
    return NearestTerms(replace(robot, joints=tuple(joints)), names, lost, left_out, judged_by)


def _gather_rows(
    result: IdentificationResult, built: AsBuilt
) -> tuple[tuple[_JointRows, ...], int, str]:
    """Return the rows of every joint on the recordings, the samples they stand for, and their name.

    Factors have the sums of squares of all samples, as the fit weighed them. Where the result has
    none, or no column of plain friction for a joint, random motion stands for the recordings.
    """
    drive = result.base.drive
    n = result.model.n_joints
    width = drive.columns_per_joint
    data = result.cause_data
    plain = [_find_plain(drive, k) for k in range(n)]
    if data is None or not all("viscous" in terms and "coulomb" in terms for terms in plain):
        return _draw_rows(built, drive), STATES, "random motion"
    columns = data.places(result.base.names)
    stacked = [
        np.vstack(factors)
        for factors in zip(data.whole(data.fitted), data.whole(data.judged), strict=True)
    ]
    found = []
    for k, factor in enumerate(stacked):
        first = 10 * result.model.n_links + k * width
        own = factor[:, columns] @ result.base.regrouping[:, first : first + width]
        made = {key: own @ parts for key, parts in plain[k].items()}
        found.append(_JointRows(own, made, factor[:, -1]))
    return tuple(found), data.n_fitted + data.n_judged, "the recordings"


def _draw_rows(built: AsBuilt, drive: DriveSet) -> tuple[_JointRows, ...]:
    model = built.model
    q, qd, qdd = draw_sample_states(model, STATES)
    load = inverse_dynamics(model, q, qd, qdd)
    values = built.parameters.parameters[10 * model.n_links :].reshape(model.n_joints, -1)
    found = []
    for k in range(model.n_joints):
        columns = drive_columns(drive, k, q, qd, qdd, load=load, shares=model.motor_shares).T
        plain = {"viscous": qd[:, k], "coulomb": np.sign(qd[:, k]), "offset": np.ones(len(q))}
        found.append(_JointRows(columns, plain, load[:, k] + columns @ values[k]))
    return tuple(found)


def _find_plain(drive: DriveSet, k: int) -> dict[str, Array]:
    """Return what of the drive parameters (c,) of joint k makes each plain term that they can."""
    found = dict[str, Array]()
    for plain, by_term in PARTS.items():
        for key, parts in by_term.items():
            there = [term for term in drive.terms if term.key == key and term.is_at(k)]
            if there and plain not in found:
                found[plain] = np.array([
                    parts.get(symbol, 0.0) if term.key == key else 0.0
                    for term in drive.terms
                    for symbol in term.symbols
                ])  # fmt: skip
    return found


def _list_missing(
    drive: DriveSet, k: int, values: Array, joint: Joint, holds: Holds, rich: list[str]
) -> tuple[Array, Array]:
    """Return the drive parameters (c,) that a file lacks, and those of its terms `rich` alone."""
    left_out = np.zeros(len(values))
    place = 0
    for term in drive.terms:
        own = slice(place, place + len(term.symbols))
        place = own.stop
        numbers = joint.drive.terms.get(term.key, {})
        if term.key in rich or (term.is_at(k) and not holds(term.key, numbers)):
            left_out[own] = values[own]
        elif term.key == "asymmetric_coulomb" and not holds("offset", {}):
            left_out[own] = values[own] - np.mean(values[own])
    of_rich = [term.key in rich for term in drive.terms for _ in term.symbols]
    return left_out, np.where(of_rich, left_out, 0.0)


def _fit(torque: Array, plain: Mapping[str, Array], drive: DriveValues) -> dict[str, float]:
    """Return the changes of plain terms that are nearest to a torque (N,); none for no torque."""
    if not plain or not torque.any():
        return {}
    from scipy.optimize import lsq_linear  # noqa: PLC0415 - light start

    columns = np.stack([*plain.values()], axis=1)
    size = np.maximum(np.linalg.norm(columns, axis=0), np.finfo(float).tiny)
    friction = make_friction_plain(drive)
    # Friction that is there may be taken away, no more.
    least = [-np.inf if key == "offset" else -(getattr(friction, key) or 0.0) for key in plain]
    solved = lsq_linear(columns / size, torque, (np.minimum(least, 0.0) * size, np.inf))
    return dict(zip(plain, (solved.x / size).tolist(), strict=True))


def _replace_terms(joint: Joint, changes: Mapping[str, float], rich: list[str]) -> Joint:
    if not rich:
        return joint
    drive = make_friction_plain(joint.drive)
    plain = {key: (getattr(drive, key) or 0.0) + change for key, change in changes.items()}
    terms = {key: numbers for key, numbers in drive.terms.items() if key not in rich}
    return replace(joint, drive=replace(drive, **plain, terms=terms))


def _measure_tilt(model: RobotModel) -> Array:
    """Return the RMS torque (n,) by which the weight differs under usual gravity."""
    usual = model.with_gravity(USUAL_GRAVITY)
    q, _, _ = draw_sample_states(model, STATES)
    apart = gravity_torque(model, q) - gravity_torque(usual, q)
    return np.asarray(np.sqrt(np.mean(apart**2, axis=0)))
