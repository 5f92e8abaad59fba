"""Margins of a motion to the limits of the robot as text."""

from __future__ import annotations

from asbuilt.excitation.limits import LimitReport
from asbuilt.tables import Column, Table, share, significant


def verdict(limits: LimitReport) -> str:
    """Return whether the limits are kept, and the smallest margin."""
    margins = [margin for margin in limits.worst.values() if margin is not None]
    if not margins:
        return "NO LIMITS: the description gives none"
    worst = min(margins, key=lambda margin: margin.margin)
    place = f"{worst.quantity} of {worst.joint} at {worst.time:.2f} s"
    if limits.violations:
        return f"LIMITS VIOLATED: margin {share(worst.margin)}, {place}"
    return f"limits kept, smallest margin {share(worst.margin)} ({place})"


def margin_table(limits: LimitReport) -> Table:
    """Return the smallest margin of each quantity, with its joint and time."""
    rows = tuple(
        (
            quantity,
            margin.joint,
            margin.time,
            significant(margin.value, 4),
            significant(margin.limit, 4),
            margin.unit,
            100 * margin.margin,
        )
        for quantity, margin in limits.worst.items()
        if margin is not None
    )
    heads = (
        Column("limit"),
        Column("nearest joint", width=24),
        Column("time", "s", "decimal", ".3f"),
        Column("value", align="decimal"),
        Column("allowed", align="decimal"),
        Column("unit"),
        Column("margin", "%", "decimal", ".1f"),
    )
    return Table(heads, rows)
