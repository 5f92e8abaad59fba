"""Text, documents and page of fleets: what was added, what a ledger holds, what changed."""

from __future__ import annotations

import os
from collections.abc import Callable, Collection, Sequence
from datetime import date
from itertools import groupby
from operator import itemgetter
from pathlib import Path
from typing import Any

from markupsafe import Markup

from asbuilt.apps.fleet.drift.drift import FleetDrift, RobotDrift, TypeVariation
from asbuilt.apps.fleet.overview import Overview
from asbuilt.apps.fleet.reduction.add import Addition
from asbuilt.findings import Cure, list_findings, list_warnings
from asbuilt.tables import Column, Table, format_share, wrap_text
from asbuilt.validation import format_probability
from asbuilt.writers import (
    Block,
    Card,
    cards_markup,
    list_markup,
    render_page,
    section_markup,
    table_markup,
)
from asbuilt.writing import atomic_write

USUAL = 1.0
"""Distance of a day by natural variation."""


CHANGES = """\
<ul class="sentences">
<li>{{ verdict }}</li>
{% for row in rows if row.robot.changed %}
{% for change in row.robot.what %}
<li><a href="#robot-{{ row.robot.id | urlencode }}">{{ row.robot.id }}</a>: {{ change.text }}</li>
{% endfor %}
{% endfor %}
</ul>
"""
ROBOTS = '{% include "robots.html.j2" %}'


def write_fleet_report(path: str | os.PathLike[str], drift: FleetDrift) -> Path:
    """Write the page of a fleet: one file without scripts, which asks the network for nothing.

    Parameters
    ----------
    path
        File to write.
    drift
        What `fleet_drift` found.
    """
    return atomic_write(path, render_fleet(drift))


def render_fleet(drift: FleetDrift) -> str:
    """Return the page as text."""
    order = sorted(
        drift.robots, key=lambda robot: (robot.rank, -(robot.distances or (0.0,))[-1], robot.id)
    )
    rows = list(map(_build_row, order))
    changes = section_markup(CHANGES, {"verdict": describe_drift_outcome(drift), "rows": rows})
    return render_page(
        "Fleet",
        f"{len(drift.robots)} robots",
        [
            Block(
                "verdict",
                "Verdict",
                (
                    cards_markup(_make_cards(drift)),
                    changes,
                    list_markup((finding.severity, finding.text) for finding in drift.findings),
                ),
            ),
            Block(
                "robots",
                "Robots, those that changed first",
                (section_markup(ROBOTS, {"rows": rows}),),
                "Robots",
            ),
            Block("types", "Types", (table_markup(Table.of(drift.types, TYPES), "types-table"),)),
        ],
        title=f"Fleet of {len(drift.robots)} robots",
        subtitle=f"Ledger {drift.ledger}",
    )


def _format_torques(kind: TypeVariation) -> str:
    """Return the torque of each joint, neighbours of the same unit followed by it once."""
    each = zip(kind.torque_units, kind.torque, strict=True)
    return ", ".join(
        ", ".join(f"{torque:.2g}" for _, torque in some) + f" {unit}"
        for unit, some in groupby(each, key=itemgetter(0))
    )


TYPES = (
    Column("type", of="robot_type"),
    Column("robots", align="right", of="n_robots"),
    Column("days", align="right", of="n_days"),
    Column("directions", align="right", of="n_directions"),
    Column("natural variation, RMS torque of each joint", of=_format_torques),
)


def _make_cards(drift: FleetDrift) -> list[Card]:
    last = max((robot.last for robot in drift.robots), default="")[:10]
    return [
        Card(
            "neutral" if drift.changed else "good",
            f"{len(drift.changed)} of {len(drift.robots)}",
            "robots changed",
        ),
        Card("neutral", f"{sum(robot.n_logs for robot in drift.robots)}", "logs"),
        Card("neutral", last, "last log"),
        Card(
            "neutral",
            format_share(drift.false_discovery_rate, 0),
            "of the robots named may be wrong",
        ),
    ]


def _build_row(robot: RobotDrift) -> dict[str, Any]:
    """Return what the page shows of a robot."""
    quiet = "too few days" if robot.p_value is None else "no change"
    return {
        "robot": robot,
        "status": f"changed {(robot.when or '')[:10]}" if robot.changed else quiet,
        "p_value": "" if robot.p_value is None else format_probability(robot.p_value),
        "span": f"{robot.first[:10]} to {robot.last[:10]}",
        "small": _draw_history(robot, 220, 40, labels=False),
        "large": _draw_history(robot, 640, 150, labels=True),
    }


def _draw_history(robot: RobotDrift, width: int, height: int, *, labels: bool) -> Markup:
    """Return the distances over the days as SVG, on a linear scale of their own."""
    points = _thin_distances(robot)
    if not points:
        return Markup("")
    left, bottom, top, right = (34, 20, 8, width - 10) if labels else (2, 2, 2, width - 4)
    first = points[0][0]
    last = points[-1][0]
    # Distance at the upper edge of a quiet history.
    most = max([3.0, *(y for _, y in points)])

    def x(day: int) -> float:
        return left + (right - left) * (day - first) / max(last - first, 1)

    def y(value: float) -> float:
        return height - bottom - (height - bottom - top) * value / most

    path = [f"{x(day):.1f},{y(value):.1f}" for day, value in points]
    cx, cy = path[-1].split(",")
    change = ""
    if robot.changed and robot.when:
        at = x(date.fromisoformat(robot.when[:10]).toordinal())
        change = f'<line class="change" x1="{at:.1f}" x2="{at:.1f}" y1="{top}" y2="{y(0):.1f}"/>'
    named = [
        f'<text x="{left - 5}" y="{y(most) + 4:.1f}" class="end">{most:.3g}</text>',
        f'<text x="{left - 5}" y="{y(USUAL) + 4:.1f}" class="end">1</text>',
        f'<text x="{left}" y="{height - 5}">{robot.days[0]}</text>',
        f'<text x="{right}" y="{height - 5}" class="end">{robot.days[-1]}</text>',
    ]
    parts = [
        f'<line class="usual" x1="{left}" x2="{right}" y1="{y(USUAL):.1f}" y2="{y(USUAL):.1f}"/>',
        change,
        f'<polyline points="{" ".join(path)}"/>',
        f'<circle cx="{cx}" cy="{cy}" r="2.2"/>',
        *(named if labels else []),
    ]
    title = f"Distance from the reference, day by day; the last is {points[-1][1]:.2g}"
    return Markup(
        f'<svg class="history {"changed" if robot.changed else "quiet"}"'
        f' viewBox="0 0 {width} {height}" role="img" aria-label="{title}">{"".join(parts)}</svg>'
    )


def _thin_distances(robot: RobotDrift) -> list[tuple[int, float]]:
    """Return days as ordinals and distances, the largest of neighbours where there are many."""
    points = [
        (date.fromisoformat(day).toordinal(), value)
        for day, value in zip(robot.days, robot.distances, strict=True)
    ]
    # Most points of a history.
    step = -(-len(points) // 240) or 1
    return [
        max(points[k : k + step], key=lambda point: point[1]) for k in range(0, len(points), step)
    ]


MOST = 10
"""Failed logs and robots shown without `full`."""
MOST_CHANGED = 12
"""Robots that changed shown without `full`."""
CHANGED = (
    Column("robot", of="id"),
    Column("logs", align="right", of="n_logs"),
    Column("changed on", of=lambda robot: (robot.when or "")[:10]),
    Column(
        "p",
        align="right",
        of=lambda robot: "" if robot.p_value is None else format_probability(robot.p_value),
    ),
)


def addition_document(done: Addition) -> dict[str, Any]:
    """Return what `asbuilt fleet add --json` prints."""
    return {
        "ledger": done.ledger,
        "added": [report.log for report in done.added],
        "skipped": [report.log for report in done.skipped],
        "failed": [
            {
                "log": report.log,
                "id": report.robot_id,
                "why": report.problem,
                "hint": None if report.cure is None else str(report.cure),
            }
            for report in done.failed
        ],
        "seconds": done.seconds,
        "n_samples": sum(report.n_samples for report in done.added),
        "recorded_seconds": sum(report.seconds for report in done.added),
        "entries": [
            {"log": report.log, "id": report.robot_id, "file": report.entry.path}
            for report in (*done.added, *done.skipped)
            if report.entry is not None
        ],
        "types": [
            {"type": setting.robot_type, "settings": setting.digest} for setting in done.settings
        ],
        "dashboard": done.dashboard,
        "warnings": list_warnings(done.findings),
        "findings": [finding.as_dict() for finding in done.findings],
    }


def addition_text(
    done: Addition,
    cure_text: Callable[[Cure], str],
    *,
    full: bool = False,
) -> str:
    """Return what `asbuilt fleet add` prints."""
    robots = {report.robot_id for report in (*done.added, *done.skipped)}
    hours = sum(report.seconds for report in done.added) / 3600.0
    lines = [
        f"{done.ledger}: {_word_count(done.added, 'log')} added, {len(done.skipped)} skipped (in"
        f" the ledger already), {len(done.failed)} failed",
        f"{_word_count(robots, 'robot')}, {hours:.3g} h recorded, {done.seconds:.3g} s taken",
        *([f"dashboard of the cluster: {done.dashboard}"] if done.dashboard else []),
    ]
    for report in done.failed if full else done.failed[:MOST]:
        cure = f"; {cure_text(report.cure)}" if report.cure else ""
        why = report.problem or ""
        name = "" if report.log in why else f"{report.log}: "
        lines.append(wrap_text(f"FAILED {name}{why}{cure}"))
    lines += _count_hidden(done.failed, full, "failed logs")
    return "\n".join([*lines, *_set_off(list_findings(done.findings, cure_text, full=full))]) + "\n"


def overview_text(seen: Overview, cure_text: Callable[[Cure], str], *, full: bool = False) -> str:
    """Return what `asbuilt fleet show` prints."""
    logs = sum(robot.n_logs for robot in seen.robots)
    lines = [f"{seen.ledger}: {_word_count(seen.robots, 'robot')}, {logs} logs", ""]
    names = {settings.robot_type: settings.model.name for settings in seen.types}
    heads = [
        Column("robot", of="id"),
        Column("type", of=lambda robot: names[robot.robot_type]),
        Column("logs", of="n_logs"),
        Column("first", of=lambda robot: robot.first[:10]),
        Column("last", of=lambda robot: robot.last[:10]),
        Column("recorded", "h", "decimal", of=lambda robot: (robot.seconds or 0.0) / 3600.0),
    ]
    if all(robot.seconds is None for robot in seen.robots):
        heads.pop()
    if seen.robots:
        shown = seen.robots if full else seen.robots[: 2 * MOST]
        lines.append(Table.of(shown, heads).as_text(full).rstrip())
    lines += _count_hidden(seen.robots, full, "robots", 2 * MOST)
    for settings in seen.types:
        lines += [
            "",
            f"{settings.model.name}: {settings.base.n_base} base parameters, torque from"
            f" {settings.torque_source}",
            wrap_text(f"fixed: {settings.chosen[0]}"),
        ]
    return "\n".join([*lines, *_set_off(list_findings(seen.findings, cure_text, full=full))]) + "\n"


def describe_drift_outcome(drift: FleetDrift) -> str:
    """Return the outcome in a sentence."""
    n = len(drift.changed)
    tested = sum(robot.p_value is not None for robot in drift.robots)
    since = "" if drift.since is None else f" since {drift.since[:10]}"
    return (
        f"{n} of {tested} robots changed{since} beyond natural variation (false discovery rate"
        f" {format_share(drift.false_discovery_rate, 0)})."
    )


def drift_text(drift: FleetDrift, cure_text: Callable[[Cure], str], *, full: bool = False) -> str:
    """Return what `asbuilt fleet drift` prints."""
    lines = [wrap_text(f"{drift.ledger}: {describe_drift_outcome(drift)}")]
    changed = drift.changed if full else drift.changed[:MOST_CHANGED]
    if changed:
        lines += ["", Table.of(changed, CHANGED).as_text(full).rstrip(), ""]
        lines += [
            wrap_text(f"{robot.id}: {effect.text}") for robot in changed for effect in robot.what
        ]
    lines += _count_hidden(drift.changed, full, "robots", MOST_CHANGED)
    for kind in drift.types:
        if kind.torque:
            most = max(range(len(kind.torque)), key=lambda k: kind.torque[k])
            lines += [
                "",
                wrap_text(
                    f"{kind.robot_type}: {kind.n_robots} robots, {kind.n_days} days; natural"
                    f" variation from day to day is at most {kind.torque[most]:.2g}"
                    f" {kind.torque_units[most]} RMS (joint {most + 1})"
                ),
            ]
    findings = _set_off(list_findings(drift.findings, cure_text, full=full))
    return "\n".join([*lines, *findings]) + "\n"


def _set_off(lines: list[str]) -> list[str]:
    """Return lines with an empty one before them, if there are any."""
    return ["", *lines] if lines else []


def _count_hidden(items: Sequence[Any], full: bool, what: str, most: int = MOST) -> list[str]:
    hidden = 0 if full else len(items) - most
    return [f"... {hidden} more {what}"] if hidden > 0 else []


def _word_count(items: Collection[Any], what: str) -> str:
    return f"{len(items)} {what}" + ("" if len(items) == 1 else "s")
