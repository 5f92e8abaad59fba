"""Which robots of a fleet changed, when, what and how large."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np

from asbuilt.apps.fleet.drift.columns import (
    Day,
    Directions,
    FleetColumns,
    find_directions,
    make_day,
    merge_by_day,
)
from asbuilt.apps.fleet.drift.explanation import explain_change
from asbuilt.apps.fleet.drift.variation import (
    DAYS_AFTER,
    DAYS_BEFORE,
    WEAK,
    History,
    Variation,
    estimate_variation,
    scan,
)
from asbuilt.apps.fleet.ledger.ledger import Ledger, open_ledger
from asbuilt.apps.fleet.ledger.settings import TypeSettings, convert_to_utc
from asbuilt.apps.fleet.options import FleetDriftOptions
from asbuilt.arrays import Array
from asbuilt.codec import make_plain
from asbuilt.dynamics import use_one_blas_thread
from asbuilt.errors import UsageError
from asbuilt.findings import Finding, list_warnings, rank_findings
from asbuilt.identification import FoundEffect
from asbuilt.validation import benjamini_hochberg
from asbuilt.workflow import Progress

EXAMPLES = 40
"""Robots of a type from which its noise and directions are found."""


@dataclass(frozen=True, slots=True, eq=False)
class RobotDrift:
    """Hold whether a robot changed.

    Parameters
    ----------
    id, robot_type
        The robot.
    n_logs, first, last
        Number of its logs and dates of the first and the last.
    changed
        Whether it changed, at the false discovery rate of the fleet.
    when
        Date of the first log after the change; None if it did not change.
    p_value
        Probability of so large a change by natural variation; None with too few days.
    false_discovery
        Rate at which it would be the last robot to be named.
    what
        Effects that changed, the one with the most torque first.
    days, distances
        Each day and its distance from the robot's reference, RMS over the directions in units of
        natural variation: 1 is usual.
    """

    id: str
    robot_type: str
    n_logs: int
    first: str
    last: str
    changed: bool
    when: str | None
    p_value: float | None
    false_discovery: float | None
    what: tuple[FoundEffect, ...]
    days: tuple[str, ...]
    distances: tuple[float, ...]

    @property
    def rank(self) -> tuple[bool, float]:
        """Key by which robots are sorted: those that changed first, the surest before."""
        return not self.changed, 1.0 if self.false_discovery is None else self.false_discovery


@dataclass(frozen=True, slots=True, eq=False)
class TypeVariation:
    """Hold the natural variation of a robot type.

    Parameters
    ----------
    robot_type
        The type.
    n_robots, n_days
        Robots and days behind it.
    n_directions
        Directions that a day of motion determines.
    autocorrelation
        Of neighbouring days.
    torque, torque_units
        RMS torque of the variation at each joint, N m or N.
    """

    robot_type: str
    n_robots: int
    n_days: int
    n_directions: int
    autocorrelation: float
    torque: tuple[float, ...]
    torque_units: tuple[str, ...]


@dataclass(frozen=True, slots=True, eq=False)
class FleetDrift:
    """Hold which robots of a fleet changed; those that changed first, the surest before."""

    ledger: str
    since: str | None
    robots: tuple[RobotDrift, ...]
    types: tuple[TypeVariation, ...]
    false_discovery_rate: float
    findings: tuple[Finding, ...]

    @property
    def changed(self) -> tuple[RobotDrift, ...]:
        """The robots that changed."""
        return tuple(robot for robot in self.robots if robot.changed)

    def as_document(self) -> dict[str, Any]:
        """Return it as plain data."""
        return {
            "ledger": self.ledger,
            "since": self.since,
            "robots": make_plain(self.robots),
            "types": make_plain(self.types),
            "false_discovery_rate": self.false_discovery_rate,
            "warnings": list_warnings(self.findings),
            "findings": [finding.as_dict() for finding in self.findings],
        }


def fleet_drift(
    ledger: Ledger | str | Path,
    *,
    since: datetime | None = None,
    options: FleetDriftOptions | None = None,
    progress: Progress | None = None,
) -> FleetDrift:
    """Find the robots of a fleet that changed.

    Each robot is compared with itself before. Natural variation from day to day is estimated from
    all robots of its type, so the false discovery rate holds over the fleet (Benjamini & Hochberg,
    1995).

    Parameters
    ----------
    ledger
        A ledger, its folder or URL.
    since
        Look for changes on this date (UTC) or later; None: at any time. Earlier logs are the
        reference.
    options
        How to look.
    progress
        Called with a text and the fraction done.

    Raises
    ------
    UsageError
        If there is no ledger, or no robot in it.
    """
    opened = open_ledger(ledger)
    types = opened.types()
    groups: dict[TypeSettings, list[str]] = {}
    for robot_id in opened.robot_ids():
        names = opened.current_names(robot_id, types=types)
        if names:
            groups.setdefault(names[-1][1], []).append(robot_id)
    if not groups:
        raise UsageError(f"the ledger {opened.root} has no logs", value=opened.root)
    since = None if since is None else convert_to_utc(since)
    done = count(1)
    total = sum(map(len, groups.values()))
    report = progress or (lambda what, fraction: None)
    found: list[RobotDrift] = []
    kinds: list[TypeVariation] = []
    for settings, robot_ids in groups.items():

        def read(robot_id: str, own: TypeSettings = settings) -> tuple[Day, ...]:
            entries = opened.entries(robot_id, types=types)
            return merge_by_day(make_day(entry) for entry in entries if entry.settings is own)

        rows, kind = scan_type(
            settings.robot_type,
            FleetColumns.of(settings),
            robot_ids,
            read,
            since,
            lambda robot_id: report(f"{robot_id} read", next(done) / (total + 1)),
        )
        found += rows
        kinds.append(kind)
    return conclude_drift(
        opened.root, since, found, kinds, options or FleetDriftOptions(), opened.findings
    )


def scan_type(
    robot_type: str,
    columns: FleetColumns,
    robot_ids: Sequence[str],
    read: Callable[[str], tuple[Day, ...]],
    since: datetime | None = None,
    tick: Callable[[str], None] | None = None,
) -> tuple[list[RobotDrift], TypeVariation]:
    """Scan the robots of one type; `changed` is not decided yet.

    Parameters
    ----------
    robot_type, columns
        The type.
    robot_ids, read
        Its robots, and what returns the days of each; only a few are in memory at once.
    since
        Date from which a change counts.
    tick
        Called with each robot that was read.
    """
    with use_one_blas_thread():
        step = -(-len(robot_ids) // EXAMPLES)
        examples = {robot_id: read(robot_id) for robot_id in robot_ids[::step]}
        sound = [days for days in examples.values() if days]
        if not sound:
            return [], TypeVariation(robot_type, 0, 0, 0, 0.0, (), ())
        directions = find_directions(columns, sound)
        dates: dict[str, tuple[Day, ...]] = {}
        histories: dict[str, History] = {}
        names = sorted({name for days in sound for day in days for name in day.covariates})
        for robot_id in robot_ids:
            days = examples[robot_id] if robot_id in examples else read(robot_id)
            if days:
                histories[robot_id] = _build_history(directions, days, names)
                # What takes memory goes: the dates stay.
                dates[robot_id] = tuple(
                    replace(day, equations=replace(day.equations, grams=()), covariates={})
                    for day in days
                )
            if tick is not None:
                tick(robot_id)
        variation = estimate_variation(list(histories.values()))
        rows = [
            _scan_robot(
                robot_id,
                robot_type,
                directions,
                variation,
                float(inflation),
                histories[robot_id],
                dates[robot_id],
                since,
                read,
            )
            for robot_id, inflation in zip(histories, variation.inflations, strict=True)
        ]
    return rows, TypeVariation(
        robot_type,
        len(histories),
        sum(history.n_days for history in histories.values()),
        directions.count,
        variation.autocorrelation,
        _measure_variation_torque(directions, variation, sound),
        columns.joint_units,
    )


PLAUSIBLE = 0.05
"""Probability up to which a change is explained before the fleet's rate decides."""
FEWEST_DAYS = 20
"""Days of a type, in addition to one of each robot, below which its variation is uncertain."""


def conclude_drift(
    ledger: str,
    since: datetime | None,
    robots: Sequence[RobotDrift],
    types: Sequence[TypeVariation],
    options: FleetDriftOptions,
    findings: Sequence[Finding] = (),
) -> FleetDrift:
    """Decide which robots changed, at the false discovery rate over all of them."""
    tested = {robot.id: robot.p_value for robot in robots if robot.p_value is not None}
    rates = benjamini_hochberg(list(tested.values())).tolist()
    rate_of = dict(zip(tested, rates, strict=True))
    level = options.false_discovery_rate
    decided = [_decide_change(robot, rate_of.get(robot.id), level) for robot in robots]
    decided.sort(key=lambda robot: (robot.rank, robot.id))
    few = [robot.id for robot in robots if robot.p_value is None]
    found = [*findings]
    if few:
        shown = ", ".join(few[:5]) + (" ..." if len(few) > 5 else "")
        found.append(
            Finding(
                "drift_too_few_days",
                "info",
                f"{len(few)} robots have logs of too few days to look for changes ({shown});"
                f" {DAYS_BEFORE} before and {DAYS_AFTER} after are needed",
            )
        )
    found += [
        Finding(
            "drift_variation_uncertain",
            "warning",
            f"the natural variation of {kind.robot_type} comes from few days; changes that are not"
            " large are not found",
        )
        for kind in types
        if 0 < kind.n_days - kind.n_robots < FEWEST_DAYS
    ]
    return FleetDrift(
        ledger,
        None if since is None else since.isoformat(),
        tuple(decided),
        tuple(types),
        level,
        rank_findings(found),
    )


def _decide_change(robot: RobotDrift, rate: float | None, level: float) -> RobotDrift:
    if rate is None or rate > level:
        return replace(robot, when=None, what=(), false_discovery=rate)
    return replace(robot, changed=True, false_discovery=rate)


def _build_history(directions: Directions, days: Sequence[Day], names: Sequence[str]) -> History:
    covariates = [[day.covariates.get(name, np.nan) for name in names] for day in days]
    return History(
        *directions.scores(days, directions.reference(days)),
        np.array(covariates).reshape(len(days), len(names)),
    )


def _scan_robot(
    robot_id: str,
    robot_type: str,
    directions: Directions,
    variation: Variation,
    inflation: float,
    history: History,
    dates: Sequence[Day],
    since: datetime | None,
    read: Callable[[str], tuple[Day, ...]],
) -> RobotDrift:
    first = 0 if since is None else sum(day.last < since for day in dates)
    adjusted = history.without(variation.coefficients)
    found = scan(
        adjusted.information,
        adjusted.score,
        variation.covariance,
        null=variation.null,
        inflation=inflation,
        first=first,
    )
    what: tuple[FoundEffect, ...] = ()
    if found is not None and found.p_value <= PLAUSIBLE:
        days = read(robot_id)
        what = explain_change(directions, variation, days, found.place, inflation)
        about = directions.reference(days[: found.place])
        adjusted = History(*directions.scores(days, about), history.covariates).without(
            variation.coefficients
        )
    return RobotDrift(
        robot_id,
        robot_type,
        sum(day.n_logs for day in dates),
        dates[0].date.isoformat(),
        dates[-1].last.isoformat(),
        False,
        None if found is None else dates[found.place].date.isoformat(),
        None if found is None else found.p_value,
        None,
        what,
        tuple(f"{day.date.astimezone(UTC):%Y-%m-%d}" for day in dates),
        _measure_distances(adjusted, variation, None if found is None else found.place),
    )


def _measure_distances(
    history: History, variation: Variation, place: int | None
) -> tuple[float, ...]:
    """Return the distance of each day from the median of those before the change."""
    y = history.estimates
    e = y - np.median(y[: max(place or 0, DAYS_BEFORE)], axis=0)
    r = y.shape[1]
    S = variation.covariance + np.linalg.inv(history.information + WEAK * np.eye(r))
    squares = np.einsum("dr,dr->d", e, np.linalg.solve(S, e[..., None])[..., 0])
    return tuple(np.round(np.sqrt(np.maximum(squares, 0.0) / r), 3).tolist())


def _measure_variation_torque(
    directions: Directions, variation: Variation, robots: Sequence[Sequence[Day]]
) -> tuple[float, ...]:
    """Return the RMS torque of the variation at each joint, over the days of some robots."""
    values, axes = np.linalg.eigh(variation.covariance)
    modes = directions.basis @ (axes * np.sqrt(np.maximum(values, 0.0)))
    days = [days[0] for days in robots[:3]]
    total: Array = np.zeros(directions.columns.n_joints)
    for day in days:
        equations = directions.columns.about(day.equations, directions.beta)
        for mode in modes.T:
            total += equations.energy(mode, torque=0.0)
    return tuple(np.sqrt(total / sum(day.n_samples for day in days)).tolist())
