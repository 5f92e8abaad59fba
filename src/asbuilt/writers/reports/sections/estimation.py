"""Section: how the parameters were estimated, and everything that was found."""

from __future__ import annotations

from typing import Any

from asbuilt.identification.estimators.methods import method_title
from asbuilt.identification.result.result import IdentificationResult
from asbuilt.tables import share, significant
from asbuilt.validation.comparison.parameter_text import drive_text
from asbuilt.writers.reports.section import Report, Section, sections

TEMPLATE = """\
{% if findings %}
<h3>{{ findings | length }} finding{{ "s" if findings | length > 1 else "" }}</h3>
<ul class="sentences" id="findings">
{% for finding in findings %}
<li class="{{ finding.severity }}">{{ finding.text }} <code>{{ finding.code }}</code></li>
{% endfor %}
</ul>
{% endif %}
<dl class="facts">
{% for name, value in facts %}
<div><dt>{{ name }}</dt><dd>{{ value }}</dd></div>
{% endfor %}
</dl>
{% if notes %}
<h3>How the estimate was chosen</h3>
<ul class="sentences" id="decisions">
{% for note in notes %}
<li>{{ note }}</li>
{% endfor %}
</ul>
{% endif %}
"""


def _context(report: Report) -> dict[str, Any]:
    study = report.study
    return {
        "findings": study.findings,
        "facts": _facts(study.result),
        "notes": study.result.notes,
    }


def _facts(result: IdentificationResult) -> list[tuple[str, str]]:
    relative = f"{share(result.train.relative_error)} on the training data"
    if result.validation:
        held_out = (share(metrics.relative_error) for metrics in result.validation)
        relative += f", {', '.join(held_out)} held out"
    consistency = {True: "OK", False: "PHYSICALLY INCONSISTENT", None: "not checked"}
    return [
        ("method", method_title(result.method)),
        ("drive terms", drive_text(result.base.drive)),
        (
            "samples",
            f"{result.n_samples} x {len(result.joint_names)} joints at {result.rate:g} Hz,"
            f" {result.duration:.1f} s",
        ),
        ("standard errors", result.errors.kind),
        ("independent samples", significant(result.effective_samples)),
        (
            "rank",
            f"{result.rank} of {result.n_base} base parameters ({result.n_standard} standard)",
        ),
        (
            "condition number",
            f"{significant(result.condition_number)} (columns scaled"
            f" {significant(result.scaled_condition_number)})",
        ),
        ("relative error", relative),
        ("consistency", consistency[result.physically_consistent]),
    ]


sections.register(
    "estimation", Section("Findings and estimation", 35, TEMPLATE, _context, folded=True)
)
