"""Section: causes of the torque error of CAD."""

from __future__ import annotations

from typing import Any

from asbuilt.writers.figures.cause_figures import attribution_figure
from asbuilt.writers.figures.figure_style import figure_address
from asbuilt.writers.reports.page import table_markup
from asbuilt.writers.reports.section import Report, Section, sections

TEMPLATE = """\
<ul class="sentences">
{% for line in sentences %}
<li>{{ line }}</li>
{% endfor %}
</ul>
<img class="drawn" src="{{ image }}" alt="Shares of the squared CAD error by cause, joint by joint;\
 the numbers are in the table below">
<div class="scroll">{{ table }}</div>
"""


def _context(report: Report) -> dict[str, Any] | None:
    found = report.study.attribution
    if found is None:
        return None
    return {
        "sentences": (*found.sentences, *found.findings),
        "image": figure_address(attribution_figure(found)),
        "table": table_markup(found.share_table(), "shares"),
    }


sections.register("causes", Section("Causes of the CAD error", 40, TEMPLATE, _context, folded=True))
