"""Section: what the recordings determine."""

from __future__ import annotations

from typing import Any

from asbuilt.writers.reports.section import Report, Section, sections

TEMPLATE = """\
<div id="singular-plot" class="plot"></div>
<p class="quiet">Singular values of the weighted observation matrix with columns scaled to unit\
 length; the recordings determine {{ rank }} of {{ n_base }} directions.</p>
<ul class="sentences">
{% for line in sentences %}
<li>{{ line }}</li>
{% endfor %}
</ul>
{% if undetermined %}
<h3>Undetermined directions</h3>
<ul>
{% for direction in undetermined %}
<li><code>{{ direction }}</code></li>
{% endfor %}
</ul>
{% endif %}
"""


def _context(report: Report) -> dict[str, Any]:
    result = report.study.result
    return {
        "rank": result.rank,
        "n_base": result.n_base,
        "sentences": report.study.determination.sentences,
        "undetermined": result.undetermined,
    }


sections.register(
    "identifiability", Section("Identifiability", 70, TEMPLATE, _context, folded=True)
)
