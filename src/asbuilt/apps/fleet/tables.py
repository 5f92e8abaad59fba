"""Text and documents of fleets: what was added to a ledger, what it holds, what changed."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from typing import Any

from asbuilt.apps.fleet.drift.drift import FleetDrift
from asbuilt.apps.fleet.overview import Overview
from asbuilt.apps.fleet.reduction.add import Addition
from asbuilt.findings import Cure, list_findings
from asbuilt.tables import Column, Table, format_share, wrap_text
from asbuilt.validation import format_probability

MOST = 10
"""Failed logs and robots shown without `full`."""
MOST_CHANGED = 12
"""Robots that changed shown without `full`."""
CHANGED = (
    Column("robot", of="id"),
    Column("logs", align="right", of="n_logs"),
    Column("changed on", of=lambda each: (each.when or "")[:10]),
    Column(
        "p",
        align="right",
        of=lambda each: "" if each.p_value is None else format_probability(each.p_value),
    ),
)


def addition_document(done: Addition) -> dict[str, Any]:
    """Return what `asbuilt fleet add --json` prints."""
    return {
        "ledger": done.ledger,
        "added": [each.log for each in done.added],
        "skipped": [each.log for each in done.skipped],
        "failed": [
            {
                "log": each.log,
                "id": each.robot_id,
                "why": each.problem,
                "hint": None if each.cure is None else str(each.cure),
            }
            for each in done.failed
        ],
        "seconds": done.seconds,
        "n_samples": sum(each.n_samples for each in done.added),
        "recorded_seconds": sum(each.seconds for each in done.added),
        "entries": [
            {"log": each.log, "id": each.robot_id, "file": each.entry.path}
            for each in (*done.added, *done.skipped)
            if each.entry is not None
        ],
        "types": [
            {"type": setting.robot_type, "settings": setting.digest} for setting in done.settings
        ],
        "dashboard": done.dashboard,
        "warnings": [{"code": finding.code, "message": finding.text} for finding in done.findings],
        "findings": [finding.as_dict() for finding in done.findings],
    }


def addition_text(
    done: Addition,
    cure_text: Callable[[Cure], str],
    *,
    full: bool = False,
) -> str:
    """Return what `asbuilt fleet add` prints."""
    robots = {each.robot_id for each in (*done.added, *done.skipped)}
    hours = sum(each.seconds for each in done.added) / 3600.0
    lines = [
        f"{done.ledger}: {_word_count(done.added, 'log')} added, {len(done.skipped)} skipped (in"
        f" the ledger already), {len(done.failed)} failed",
        f"{_word_count(robots, 'robot')}, {hours:.3g} h recorded, {done.seconds:.3g} s taken",
        *([f"dashboard of the cluster: {done.dashboard}"] if done.dashboard else []),
    ]
    for each in done.failed if full else done.failed[:MOST]:
        cure = f"; {cure_text(each.cure)}" if each.cure else ""
        why = each.problem or ""
        name = "" if each.log in why else f"{each.log}: "
        lines.append(wrap_text(f"FAILED {name}{why}{cure}"))
    lines += _count_hidden(done.failed, full, "failed logs")
    return "\n".join([*lines, *_set_off(list_findings(done.findings, cure_text, full=full))]) + "\n"


def overview_text(seen: Overview, cure_text: Callable[[Cure], str], *, full: bool = False) -> str:
    """Return what `asbuilt fleet show` prints."""
    logs = sum(robot.n_logs for robot in seen.robots)
    lines = [f"{seen.ledger}: {_word_count(seen.robots, 'robot')}, {logs} logs", ""]
    names = {each.robot_type: each.model.name for each in seen.types}
    heads = [
        Column("robot", of="id"),
        Column("type", of=lambda each: names[each.robot_type]),
        Column("logs", of="n_logs"),
        Column("first", of=lambda each: each.first[:10]),
        Column("last", of=lambda each: each.last[:10]),
        Column("recorded", "h", "decimal", of=lambda each: (each.seconds or 0.0) / 3600.0),
    ]
    if all(robot.seconds is None for robot in seen.robots):
        heads.pop()
    if seen.robots:
        shown = seen.robots if full else seen.robots[: 2 * MOST]
        lines.append(Table.of(shown, heads).as_text(full).rstrip())
    lines += _count_hidden(seen.robots, full, "robots", 2 * MOST)
    for each in seen.types:
        lines += [
            "",
            f"{each.model.name}: {each.base.n_base} base parameters, torque from"
            f" {each.torque_source}",
            wrap_text(f"fixed: {each.chosen[0]}"),
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
            wrap_text(f"{each.id}: {effect.text}") for each in changed for effect in each.what
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
