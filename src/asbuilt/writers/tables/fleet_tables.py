"""Text and documents of what was added to a ledger and what it holds."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from asbuilt.findings import Cure, Finding
from asbuilt.tables import Column, Table, wrapped
from asbuilt.workflow.fleet.overview import Overview
from asbuilt.workflow.fleet.reduction.add import Addition
from asbuilt.workflow.fleet.reduction.log_task import LogReport

MOST = 10
"""Failed logs, robots and findings shown without `full`."""


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
        "types": [{"type": each.robot_type, "settings": each.digest} for each in done.settings],
        "dashboard": done.dashboard,
        "warnings": [{"code": each.code, "message": each.text} for each in done.findings],
        "findings": [each.as_dict() for each in done.findings],
    }


def addition_text(
    done: Addition,
    finding_text: Callable[[Finding], str],
    cure_text: Callable[[Cure], str],
    *,
    full: bool = False,
) -> str:
    """Return what `asbuilt fleet add` prints."""
    counts = (
        f"{_count(done.added, 'log')} added, {len(done.skipped)} skipped (in the ledger already),"
        f" {len(done.failed)} failed"
    )
    robots = sorted({each.robot_id for each in (*done.added, *done.skipped)})
    hours = sum(each.seconds for each in done.added) / 3600.0
    lines = [
        f"{done.ledger}: {counts}",
        f"{_count(robots, 'robot')}, {hours:.3g} h recorded, {done.seconds:.3g} s taken",
    ]
    if done.dashboard:
        lines.append(f"dashboard of the cluster: {done.dashboard}")
    for each in done.failed if full else done.failed[:MOST]:
        cure = f"; {cure_text(each.cure)}" if each.cure else ""
        lines.append(wrapped(f"FAILED {_with_name(each)}{cure}"))
    lines += _left(done.failed, full, "failed logs")
    return "\n".join([*lines, *finding_lines(done.findings, finding_text, full)]) + "\n"


def overview_text(
    seen: Overview, finding_text: Callable[[Finding], str], *, full: bool = False
) -> str:
    """Return what `asbuilt fleet show` prints."""
    logs = sum(each.n_logs for each in seen.robots)
    lines = [f"{seen.ledger}: {_count(seen.robots, 'robot')}, {logs} logs", ""]
    thorough = any(each.seconds is not None for each in seen.robots)
    heads = [Column("robot"), Column("type"), Column("logs"), Column("first"), Column("last")]
    heads += [Column("recorded", "h", "decimal")] if thorough else []
    names = {each.robot_type: each.model.name for each in seen.types}
    rows: tuple[tuple[str | float, ...], ...] = tuple(
        (
            each.id,
            names[each.robot_type],
            each.n_logs,
            each.first[:10],
            each.last[:10],
            *([(each.seconds or 0.0) / 3600.0] if thorough else []),
        )
        for each in (seen.robots if full else seen.robots[: 2 * MOST])
    )
    if rows:
        lines.append(Table(tuple(heads), rows).as_text(full).rstrip())
    lines += _left(seen.robots, full, "robots", 2 * MOST)
    for each in seen.types:
        lines += [
            "",
            f"{each.model.name}: {each.base.n_base} base parameters, torque from"
            f" {each.torque_source}",
            wrapped(f"fixed: {each.chosen[0]}"),
        ]
    return "\n".join([*lines, *finding_lines(seen.findings, finding_text, full)]) + "\n"


def finding_lines(
    findings: Sequence[Finding], finding_text: Callable[[Finding], str], full: bool
) -> list[str]:
    """Return findings as wrapped lines, an empty one before; the first `MOST` unless `full`."""
    if not findings:
        return []
    shown = findings if full else findings[:MOST]
    return [
        "",
        *(wrapped(finding_text(each)) for each in shown),
        *_left(findings, full, "findings"),
    ]


def _with_name(report: LogReport) -> str:
    """Return why a log failed, with its name if the reason lacks it."""
    problem = report.problem or ""
    return problem if report.log in problem else f"{report.log}: {problem}"


def _left(items: Sequence[Any], full: bool, what: str, most: int = MOST) -> list[str]:
    hidden = 0 if full else len(items) - most
    return [f"... {hidden} more {what}"] if hidden > 0 else []


def _count(items: Sequence[Any], what: str) -> str:
    return f"{len(items)} {what}" + ("" if len(items) == 1 else "s")
