"""Text of the changes of a fleet."""

from __future__ import annotations

from collections.abc import Callable

from asbuilt.findings import Finding
from asbuilt.tables import Column, Table, share, wrapped
from asbuilt.validation.comparison.significance import probability_text
from asbuilt.workflow.fleet.drift.drift import FleetDrift, RobotDrift
from asbuilt.writers.tables.fleet_tables import finding_lines

MOST = 12
"""Robots that changed shown without `full`."""


def drift_verdict(drift: FleetDrift) -> str:
    """Return the outcome in a sentence."""
    n, tested = len(drift.changed), sum(each.p_value is not None for each in drift.robots)
    since = "" if drift.since is None else f" since {drift.since[:10]}"
    return (
        f"{n} of {tested} robots changed{since} beyond natural variation (false discovery rate"
        f" {share(drift.false_discovery_rate, 0)})."
    )


def drift_text(
    drift: FleetDrift, finding_text: Callable[[Finding], str], *, full: bool = False
) -> str:
    """Return what `asbuilt fleet drift` prints."""
    lines = [wrapped(f"{drift.ledger}: {drift_verdict(drift)}")]
    changed = drift.changed if full else drift.changed[:MOST]
    rows = tuple((each.id, each.n_logs, (each.when or "")[:10], _p(each)) for each in changed)
    if rows:
        heads = (
            Column("robot"),
            Column("logs", align="right"),
            Column("changed on"),
            Column("p", align="right"),
        )
        lines += ["", Table(heads, rows).as_text(full).rstrip(), ""]
        for each in changed:
            for change in each.what:
                lines.append(wrapped(f"{each.id}: {change.text}"))
    if len(changed) < len(drift.changed):
        lines.append(f"... {len(drift.changed) - len(changed)} more robots")
    for kind in drift.types:
        if kind.torque:
            most = max(range(len(kind.torque)), key=lambda k: kind.torque[k])
            lines += [
                "",
                wrapped(
                    f"{kind.robot_type}: {kind.n_robots} robots, {kind.n_days} days; natural"
                    f" variation from day to day is at most {kind.torque[most]:.2g}"
                    f" {kind.torque_units[most]} RMS (joint {most + 1})"
                ),
            ]
    return "\n".join([*lines, *finding_lines(drift.findings, finding_text, full)]) + "\n"


def _p(each: RobotDrift) -> str:
    return "" if each.p_value is None else probability_text(each.p_value)
