"""Section: distribution, autocorrelation and friction of the torque error."""

from __future__ import annotations

from typing import Any

import numpy as np

from asbuilt.tables import Column, Shown, Table, significant
from asbuilt.validation.prediction import Validation
from asbuilt.writers.reports.page import table_markup
from asbuilt.writers.reports.section import Report, Section, sections

TEMPLATE = """\
<div class="grid">
<figure><figcaption>Distribution in standard deviations; the line is a normal distribution\
</figcaption><div id="histogram-plot" class="plot"></div></figure>
<figure><figcaption>Autocorrelation; the band is the 95 % interval of white noise</figcaption>\
<div id="correlation-plot" class="plot"></div></figure>
<figure><figcaption>Torque of the drive against velocity</figcaption>\
<div id="friction-plot" class="plot"></div></figure>
</div>
{% for table in tables %}
<div class="scroll residuals" data-recording="{{ loop.index0 }}">{{ table }}</div>
{% endfor %}
"""

WHITE = 0.05
"""Smallest p value of a residual that counts as white (usual level)."""


def _context(report: Report) -> dict[str, Any] | None:
    tables = [
        table_markup(_residual_table(label, validation), f"residuals-{number}")
        for number, (label, validation) in enumerate(report.predictions)
    ]
    return {"tables": tables} if tables else None


def _residual_table(label: str, validation: Validation) -> Table:
    built, cad, analysis = (
        validation.metrics_as_built,
        validation.metrics_cad,
        validation.residuals(),
    )
    numbers = ("RMS, CAD", "RMS, as built", "largest")
    columns = (
        Column("joint"),
        Column("unit"),
        *(Column(name, align="right") for name in numbers),
        Column("of its torque", "%", "right", ".1f"),
        Column("R²", align="right", style=".4f"),
        Column("mean", align="right"),
        Column("Durbin-Watson", align="right", style=".2f"),
        Column("white"),
        Column("independent samples", align="right"),
    )
    rows = []
    for k, (name, unit) in enumerate(zip(validation.joint_names, validation.units, strict=True)):
        values = (cad.rms[k], built.rms[k], built.max_abs[k])
        rows.append(
            (
                name,
                unit,
                *(Shown(float(value), significant(float(value))) for value in values),
                100.0 * float(built.relative_error_per_joint[k]),
                float(built.r_squared[k]) if np.isfinite(built.r_squared[k]) else None,
                Shown(float(analysis.mean[k]), significant(float(analysis.mean[k]), 2)),
                float(analysis.durbin_watson[k]),
                "yes" if analysis.probability_white[k] > WHITE else "no",
                significant(float(analysis.effective_samples[k])),
            )
        )
    return Table(columns, tuple(rows), title=label)


sections.register(
    "error", Section("Error of the prediction as built", 30, TEMPLATE, _context, folded=True)
)
