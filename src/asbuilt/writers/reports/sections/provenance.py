"""Section: how the result was made."""

from __future__ import annotations

import shlex
from typing import Any

from asbuilt.writers.reports.section import Report, Section, sections

TEMPLATE = """\
<ol>
{% for line in provenance %}
<li>{{ line }}</li>
{% endfor %}
</ol>
{% if citation_of_robot %}<p>Robot description: {{ citation_of_robot }}</p>{% endif %}
{% if notes %}
<h3>Notes of the description</h3>
<ul>
{% for note in notes %}
<li>{{ note }}</li>
{% endfor %}
</ul>
{% endif %}
{% if command %}
<h3>To repeat</h3>
<pre><code>{{ command }}</code></pre>
{% endif %}
"""


def _context(report: Report) -> dict[str, Any]:
    result = report.study.result
    return {
        "provenance": result.provenance,
        "citation_of_robot": result.model.citation,
        "notes": result.model.notes,
        "command": shlex.join(report.command),
    }


sections.register("provenance", Section("Provenance", 80, TEMPLATE, _context, folded=True))
