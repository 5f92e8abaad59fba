"""Section: the verdict, its numbers and the first findings."""

from __future__ import annotations

from typing import Any

from asbuilt.writers.reports.report_verdict import MOODS, verdict
from asbuilt.writers.reports.section import Report, Section, sections

TEMPLATE = """\
<p class="verdict {{ mood }}">{{ text }}</p>
{% include "cards.html.j2" %}
{% if findings %}
<ul class="sentences" id="findings-shown">
{% for finding in findings %}
<li class="{{ finding.severity }}">{{ finding.text }}</li>
{% endfor %}
</ul>
{% endif %}
"""
MOST_FINDINGS = 5
"""Findings beside the verdict, the first of the study; all are in a section of their own."""


def _context(report: Report) -> dict[str, Any]:
    study = report.study
    said = [each for each in study.findings if each.severity != "info"]
    return {
        "text": study.verdict.text,
        "mood": MOODS[study.verdict.use],
        "cards": verdict(study),
        "findings": said[:MOST_FINDINGS],
    }


sections.register("verdict", Section("Verdict", 10, TEMPLATE, _context))
