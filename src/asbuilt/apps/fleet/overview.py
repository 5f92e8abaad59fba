"""What a ledger holds: robots, their logs and types, and logs that do not fit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from asbuilt.apps.fleet.ledger.entry import Entry
from asbuilt.apps.fleet.ledger.ledger import Ledger, open_ledger
from asbuilt.apps.fleet.ledger.settings import TypeSettings
from asbuilt.errors import AsbuiltError
from asbuilt.findings import Cure, Finding, list_warnings, rank_findings
from asbuilt.identification import (
    design_values,
    fit_least_squares,
    locate_drive_parameters,
    triangular_factor,
)

UNLIKE_OTHERS = 3.0
"""A log does not fit the others of its robot when the RMS torque error by their model, in that
by its own, is larger; own choice, on real and virtual arms."""
LATEST = 12
"""Logs of a robot, the latest, that are looked at."""


def report_suspicions(ledger: Ledger, robot_id: str) -> list[Finding]:
    """Return findings about a robot's latest entries."""
    latest = ledger.current_names(robot_id)[-LATEST:]
    sound = [entry for entry in (ledger.read(*name) for name in latest) if entry is not None]
    types = {entry.settings.robot_type for entry in sound}
    if len(types) > 1:
        return [
            Finding(
                "robot_types_mixed",
                "error",
                f"{robot_id} has logs of {len(types)} types of robot: {', '.join(sorted(types))}",
                Cure("give each robot an identity of its own"),
            )
        ]
    return [*_report_overlaps(robot_id, sound), *_report_jumps(robot_id, sound)]


def _report_overlaps(robot_id: str, entries: Sequence[Entry]) -> list[Finding]:
    """Return a finding for logs of one robot that were recorded at the same time."""
    stamped = [entry for entry in entries if entry.date_from == "stamps"]
    overlaps = (
        (earlier, later, (earlier.date - later.date).total_seconds() + earlier.duration)
        for earlier, later in pairwise(sorted(stamped, key=lambda entry: entry.date))
    )
    return [
        Finding(
            "logs_overlap",
            "warning",
            f"{robot_id}: {later.log} begins {overlap:.0f} s before {earlier.log} ends;"
            " one robot records one log at a time",
            Cure("look for two robots under one identity, or a clock that was set back"),
        )
        for earlier, later, overlap in overlaps
        if overlap > 1.0
    ]


def _report_jumps(robot_id: str, entries: Sequence[Entry]) -> list[Finding]:
    """Return a finding for each log that the model of the others does not predict.

    The worst is taken out first, since it spoils the model by which the others are tested.
    """
    rest = list(entries)
    found = []
    while len(rest) > 1:
        ratios = [
            measure_misfit(entry, [other for other in rest if other is not entry]) for entry in rest
        ]
        worst = len(rest) - 1 if len(rest) == 2 else int(np.argmax(ratios))
        if ratios[worst] <= UNLIKE_OTHERS:
            break
        found.append((ratios[worst], rest.pop(worst)))
    return [
        Finding(
            "log_of_another_robot",
            "warning",
            f"{robot_id}: the torque of {entry.log} ({entry.date:%Y-%m-%d}) is predicted"
            f" {ratio:.2g} times worse by the other logs than by its own",
            Cure("look for a log of another robot, a tool or a repair", call="fleet_drift"),
        )
        for ratio, entry in found
    ]


def measure_misfit(entry: Entry, others: Sequence[Entry]) -> float:
    """Return the weighted RMS torque error of a log by the others' model, in what is expected.

    Friction follows temperature and wear, so the others' model keeps the friction that the log
    itself shows. The error by the log's own model then grows by `d^T M d`, where d is the
    difference of the other parameters and M the information about them, friction unknown (a Schur
    complement).
    One robot has `tr(M C)` of it on average, C the sum of the covariances of both: little between
    long logs, much between short ones whose motions differ. It is 1.0 where one of them determines
    nothing.
    """
    settings = entry.settings
    part = entry.whole
    prior = np.nan_to_num(design_values(settings.model, settings.base), nan=0.0)
    together = others[0].whole.merge(*(other.whole for other in others[1:]))
    try:
        own = fit_least_squares(part, weights="joint", prior=prior)
        theirs = fit_least_squares(together, weights="joint", prior=prior)
    except AsbuiltError:
        return 1.0
    least = float(own.weights**2 @ part.residual_energy(own.beta))
    friction = [
        place
        for joint in range(part.n_joints)
        for place in locate_drive_parameters(settings.base, joint).get("friction", [])
    ]
    rest = np.setdiff1d(np.arange(len(own.beta)), friction)
    rows = part.stacked(own.weights)[:, :-1][:, [*friction, *rest]]
    root = triangular_factor(rows)[len(friction) :, len(friction) :]
    d = (theirs.beta - own.beta)[rest]
    C = (own.covariance + theirs.covariance)[np.ix_(rest, rest)]
    error = least + float(np.sum((root @ d) ** 2))
    expected = least + float(np.sum((root @ C) * root))
    return float(np.sqrt(error / expected)) if expected > 0.0 else 1.0


@dataclass(frozen=True, slots=True)
class RobotRow:
    """Hold what a ledger has of a robot: `first` and `last` are the dates of its logs."""

    id: str
    robot_type: str
    n_logs: int
    first: str
    last: str
    seconds: float | None = None
    n_samples: int | None = None


@dataclass(frozen=True, eq=False)
class Overview:
    """Hold what a ledger holds."""

    ledger: str
    robots: tuple[RobotRow, ...]
    types: tuple[TypeSettings, ...]
    findings: tuple[Finding, ...]

    def as_document(self) -> dict[str, Any]:
        """Return it as plain data."""
        return {
            "ledger": self.ledger,
            "robots": [asdict(robot) for robot in self.robots],
            "types": [
                {
                    "type": settings.robot_type,
                    "robot": settings.model.name,
                    "settings": settings.digest,
                    "generation": settings.generation,
                    "joints": list(settings.model.joint_names),
                    "drive": str(settings.drive),
                    "cutoff": settings.chain.cutoff,
                    "torque_source": settings.torque_source,
                    "n_base": settings.base.n_base,
                    "chosen": list(settings.chosen),
                }
                for settings in self.types
            ],
            "warnings": list_warnings(self.findings),
            "findings": [finding.as_dict() for finding in self.findings],
        }


def fleet_overview(ledger: Ledger | str | Path, *, thorough: bool = False) -> Overview:
    """Return what a ledger holds.

    Parameters
    ----------
    ledger
        A ledger, its folder or URL.
    thorough
        Read every entry: durations, damaged files, logs that do not fit their robot.

    Raises
    ------
    UsageError
        If there is no ledger.
    """
    opened = open_ledger(ledger)
    types = opened.types()
    rows = []
    findings = []
    for robot_id in opened.robot_ids():
        names = opened.current_names(robot_id, types=types)
        if not names:
            continue
        row = RobotRow(
            id=robot_id,
            robot_type=names[-1][1].robot_type,
            n_logs=len(names),
            first=names[0][0].date.isoformat(),
            last=names[-1][0].date.isoformat(),
        )
        if thorough:
            entries = [e for e in (opened.read(*name) for name in names) if e is not None]
            row = replace(
                row,
                n_logs=len(entries),
                seconds=sum(entry.duration for entry in entries),
                n_samples=sum(entry.information.n_samples for entry in entries),
            )
            findings += report_suspicions(opened, robot_id)
        rows.append(row)
    return Overview(
        opened.root,
        tuple(rows),
        tuple(types.values()),
        rank_findings([*findings, *opened.findings]),
    )
