"""Sections made of tables: torque errors, masses, payload, causes of the CAD error."""

from __future__ import annotations

from typing import Any

from asbuilt.tables import Table
from asbuilt.writers.figures.comparison_figures import attribution_figure
from asbuilt.writers.figures.figure_style import figure_address
from asbuilt.writers.reports.page import image_markup, list_markup, paragraph_markup, table_markup
from asbuilt.writers.reports.section import Report, Section, sections
from asbuilt.writers.tables.mass_tables import exported_masses, mass_table
from asbuilt.writers.tables.payload_tables import payload_table, payload_torque_table

PARTS = "{% for part in parts %}{{ part }}\n{% endfor %}"


def _parts(tables: dict[str, Table], *before: Any) -> dict[str, Any]:
    return {"parts": [*before, *(table_markup(table, name) for name, table in tables.items())]}


def _comparison(report: Report) -> dict[str, Any]:
    found = report.study.comparison
    return _parts({"torque-table": found.torque_table()}, paragraph_markup(found.verdict(), ""))


def _masses(report: Report) -> dict[str, Any] | None:
    masses = exported_masses(report.study.result)
    return None if masses is None else _parts({"mass-table": mass_table(masses)})


def _payload(report: Report) -> dict[str, Any] | None:
    found = report.payload
    if found is None:
        return None
    tables = {"payload-values": payload_table(found), "payload-torque": payload_torque_table(found)}
    return _parts(tables)


def _causes(report: Report) -> dict[str, Any] | None:
    found = report.study.attribution
    if found is None:
        return None
    words = (
        "Shares of the squared CAD error by cause, joint by joint; the numbers are in the table"
        " below"
    )
    drawn = image_markup(figure_address(attribution_figure(found)), words)
    return _parts(
        {"shares": found.share_table()}, list_markup((*found.sentences, *found.findings)), drawn
    )


sections.register("masses", Section("Masses", 22, PARTS, _masses))
sections.register("comparison", Section("CAD and as built", 24, PARTS, _comparison))
sections.register("causes", Section("Causes of the CAD error", 40, PARTS, _causes, folded=True))
sections.register("payload", Section("Payload", 50, PARTS, _payload))
