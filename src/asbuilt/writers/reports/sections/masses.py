"""Section: masses of the links by CAD and as built."""

from __future__ import annotations

from typing import Any

from asbuilt.writers.reports.page import table_markup
from asbuilt.writers.reports.section import Report, Section, sections
from asbuilt.writers.tables.mass_table import exported_masses, mass_table

TEMPLATE = """\
<div class="scroll">{{ table }}</div>
"""


def _context(report: Report) -> dict[str, Any] | None:
    masses = exported_masses(report.study.result)
    return None if masses is None else {"table": table_markup(mass_table(masses), "mass-table")}


sections.register("masses", Section("Masses", 22, TEMPLATE, _context))
