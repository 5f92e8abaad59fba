"""Section: what lies between the two encoders of each joint."""

from __future__ import annotations

from typing import Any

import numpy as np

from asbuilt.identification.calibration.encoders import EncoderPair
from asbuilt.tables import Column, Table, plus_minus, significant
from asbuilt.writers.reports.section import Report, Section, sections

TEMPLATE = """\
<p class="quiet">Lag of the link's encoder, and the spring between motor and link. The rotor is\
 the inertia that the motor's torque moves without the link; hysteresis is what the difference of\
 the encoders changes by as the joint reverses. A dash: not determined.</p>
{{ table | safe }}
"""


def _context(report: Report) -> dict[str, Any] | None:
    pairs = report.study.result.encoders
    if not pairs:
        return None
    columns = (
        Column("joint"),
        Column("lag", "ms", "right"),
        Column("stiffness", "N m/rad, N/m", "right"),
        Column("damping", "N m s/rad, N s/m", "right"),
        Column("rotor", "kg m^2, kg", "right"),
        Column("hysteresis", "mdeg, um", "right"),
        Column("rest", "mdeg, um", "right"),
    )
    return {"table": Table(columns, tuple(map(_row, pairs))).as_html("encoders")}


def _row(pair: EncoderPair) -> tuple[str, ...]:
    scale = 1e3 * float(np.rad2deg(1.0)) if pair.revolute else 1e6
    rotor = None if pair.rotor is None else (pair.rotor, pair.rotor_error or 0.0)
    return (
        pair.joint,
        plus_minus(1e3 * pair.lag, 1e3 * pair.lag_error),
        *("-" if each is None else plus_minus(*each) for each in (pair.stiffness, pair.damping)),
        "-" if rotor is None else plus_minus(*rotor),
        plus_minus(scale * pair.hysteresis, scale * pair.hysteresis_error),
        significant(scale * pair.rest, 2),
    )


sections.register("encoders", Section("Two encoders", 14, TEMPLATE, _context))
