"""Section: torque errors of CAD and as built, joint by joint."""

from __future__ import annotations

from typing import Any

from asbuilt.writers.reports.page import table_markup
from asbuilt.writers.reports.section import Report, Section, sections

TEMPLATE = """\
<p>{{ text }}</p>
<div class="scroll">{{ table }}</div>
"""


def _context(report: Report) -> dict[str, Any]:
    comparison = report.study.comparison
    return {
        "text": comparison.verdict(),
        "table": table_markup(comparison.torque_table(), "torque-table"),
    }


sections.register("comparison", Section("CAD and as built", 24, TEMPLATE, _context))
