"""Sections made of tables: torque errors, masses, payload, causes of the CAD error."""

from __future__ import annotations

from typing import Any

import numpy as np

from asbuilt.identification import feasible_intervals
from asbuilt.identification.calibration.encoders import EncoderPair
from asbuilt.tables import Column, Table, format_plus_minus, round_significant
from asbuilt.writers.reports.compare_files import draw_shares
from asbuilt.writers.reports.interval_bars import draw_intervals
from asbuilt.writers.reports.page import (
    list_markup,
    paragraph_markup,
    table_markup,
)
from asbuilt.writers.reports.section import Report, Section, sections
from asbuilt.writers.tables.mass_tables import exported_masses, feasible_table, mass_table
from asbuilt.writers.tables.payload_tables import tabulate_payload, tabulate_payload_torques

PARTS = "{% for part in parts %}{{ part }}\n{% endfor %}"


def _collect_parts(tables: dict[str, Table], *before: Any) -> dict[str, Any]:
    return {"parts": [*before, *(table_markup(table, name) for name, table in tables.items())]}


def _collect_comparison(report: Report) -> dict[str, Any]:
    found = report.study.comparison
    return _collect_parts(
        {"torque-table": found.torque_table()}, paragraph_markup(found.verdict(), "")
    )


def _collect_masses(report: Report) -> dict[str, Any] | None:
    result = report.study.result
    recovery = report.recovery
    masses = exported_masses(result)
    if masses is None:
        return None
    truth = {} if recovery is None else recovery.true_values
    tables = {"mass-table": mass_table(masses)}
    bars = {"Masses": (*masses.links, masses.total)}
    if "armature" in result.base.drive.keys:
        bars["Armatures"] = feasible_intervals(result, ("armature",))
        tables["armature-table"] = feasible_table(bars["Armatures"])
    if recovery is not None:
        tables["truth-table"] = recovery.interval_table()
    drawn = [draw_intervals(bar, truth, title) for title, bar in bars.items()]
    return _collect_parts(tables, *drawn)


def _collect_payload(report: Report) -> dict[str, Any] | None:
    found = report.payload
    if found is None:
        return None
    return _collect_parts(
        {
            "payload-values": tabulate_payload(found),
            "payload-torque": tabulate_payload_torques(found),
        }
    )


def _collect_causes(report: Report) -> dict[str, Any] | None:
    found = report.study.attribution
    if found is None:
        return None
    sentences = list_markup((*found.sentences, *found.findings))
    return _collect_parts({"shares": found.share_table()}, sentences, draw_shares(found))


sections.register("masses", Section("Masses", 22, PARTS, _collect_masses))
sections.register("comparison", Section("CAD and as built", 24, PARTS, _collect_comparison))
sections.register(
    "causes", Section("Causes of the CAD error", 40, PARTS, _collect_causes, folded=True)
)
sections.register("payload", Section("Payload", 50, PARTS, _collect_payload))

TEMPLATE = """\
<p class="quiet">Lag of the link's encoder, and the spring between motor and link. The rotor is\
 the inertia that the motor's torque moves without the link; hysteresis is what the difference of\
 the encoders changes by as the joint reverses. A dash: not determined.</p>
{{ table | safe }}
"""


def _collect_encoders(report: Report) -> dict[str, Any] | None:
    pairs = report.study.result.encoders
    if not pairs:
        return None
    return {
        "table": Table(
            (
                Column("joint"),
                Column("lag", "ms", "right"),
                Column("stiffness", "N m/rad, N/m", "right"),
                Column("damping", "N m s/rad, N s/m", "right"),
                Column("rotor", "kg m^2, kg", "right"),
                Column("hysteresis", "mdeg, um", "right"),
                Column("rest", "mdeg, um", "right"),
            ),
            tuple(map(_build_row, pairs)),
        ).as_html("encoders")
    }


def _build_row(pair: EncoderPair) -> tuple[str, ...]:
    scale = 1e3 * float(np.rad2deg(1.0)) if pair.revolute else 1e6
    rotor = None if pair.rotor is None else (pair.rotor, pair.rotor_error or 0.0)
    return (
        pair.joint,
        format_plus_minus(1e3 * pair.lag, 1e3 * pair.lag_error),
        *(
            "-" if each is None else format_plus_minus(*each)
            for each in (pair.stiffness, pair.damping, rotor)
        ),
        format_plus_minus(scale * pair.hysteresis, scale * pair.hysteresis_error),
        round_significant(scale * pair.rest, 2),
    )


sections.register("encoders", Section("Two encoders", 14, TEMPLATE, _collect_encoders))
