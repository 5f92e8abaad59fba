"""Section: measured and predicted torque over time."""

from __future__ import annotations

from typing import Any

from asbuilt.writers.reports.section import Report, Section, sections

TEMPLATE = """\
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


def _context(report: Report) -> dict[str, Any] | None:
    labels = [label for label, _ in report.predictions]
    return {"labels": labels, "joints": report.study.result.joint_names} if labels else None


sections.register("torque", Section("Torque", 20, TEMPLATE, _context))
