"""Section: payload."""

from __future__ import annotations

from typing import Any

from asbuilt.writers.reports.page import table_markup
from asbuilt.writers.reports.section import Report, Section, sections
from asbuilt.writers.tables.payload_tables import payload_table, payload_torque_table

TEMPLATE = """\
{% for table in tables %}
<div class="scroll">{{ table }}</div>
{% endfor %}
"""


def _context(report: Report) -> dict[str, Any] | None:
    if report.payload is None:
        return None
    return {
        "tables": (
            table_markup(payload_table(report.payload), "payload-values"),
            table_markup(payload_torque_table(report.payload), "payload-torque"),
        )
    }


sections.register("payload", Section("Payload", 50, TEMPLATE, _context))
