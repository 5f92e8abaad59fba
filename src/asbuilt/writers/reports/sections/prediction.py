"""Sections of the prediction: torque over time, and the error in itself."""

from __future__ import annotations

from typing import Any

from asbuilt.tables import Column, Table, significant
from asbuilt.validation.prediction import Validation
from asbuilt.writers.reports.page import table_markup
from asbuilt.writers.reports.section import Report, Section, sections

TORQUE = """\
<div class="controls">
<label>Recording <select id="recording">{% for label in labels %}\
<option value="{{ loop.index0 }}">{{ label }}</option>{% endfor %}</select></label>
<div id="joints" role="group" aria-label="Joint">{% for joint in joints %}\
<button type="button" data-joint="{{ loop.index0 }}" aria-pressed="false">{{ joint }}</button>\
{% endfor %}</div>
</div>
<h3 id="torque-title"></h3>
<div id="torque-plot" class="plot tall"></div>
<p class="quiet" id="torque-note"></p>
"""
ERROR = """\
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


def _torque(report: Report) -> dict[str, Any] | None:
    labels = [label for label, _ in report.predictions]
    return {"labels": labels, "joints": report.study.result.joint_names} if labels else None


def _error(report: Report) -> dict[str, Any] | None:
    tables = [
        table_markup(_residual_table(label, validation), f"residuals-{number}")
        for number, (label, validation) in enumerate(report.predictions)
    ]
    return {"tables": tables} if tables else None


def _residual_table(label: str, validation: Validation) -> Table:
    built, cad = validation.metrics_as_built, validation.metrics_cad
    analysis = validation.residuals()
    columns = (
        Column("joint", of=lambda k: validation.joint_names[k]),
        Column("unit", of=lambda k: validation.units[k]),
        Column("RMS, CAD", "", "right", 3, of=lambda k: cad.rms[k]),
        Column("RMS, as built", "", "right", 3, of=lambda k: built.rms[k]),
        Column("largest", "", "right", 3, of=lambda k: built.max_abs[k]),
        Column(
            "of its torque",
            "%",
            "right",
            ".1f",
            of=lambda k: 100.0 * built.relative_error_per_joint[k],
        ),
        Column("R²", "", "right", ".4f", of=lambda k: built.r_squared[k]),
        Column("mean", "", "right", 2, of=lambda k: analysis.mean[k]),
        Column("Durbin-Watson", "", "right", ".2f", of=lambda k: analysis.durbin_watson[k]),
        Column("white", of=lambda k: "yes" if analysis.probability_white[k] > WHITE else "no"),
        Column(
            "independent samples",
            align="right",
            of=lambda k: significant(analysis.effective_samples[k]),
        ),
    )
    return Table.of(range(len(validation.joint_names)), columns, label)


sections.register("torque", Section("Torque", 20, TORQUE, _torque))
sections.register(
    "error", Section("Error of the prediction as built", 30, ERROR, _error, folded=True)
)
