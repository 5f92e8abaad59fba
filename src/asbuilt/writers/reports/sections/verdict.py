"""Sections of the verdict, and of what is in the model that CAD lacks, as bars of torque error."""

from __future__ import annotations

from typing import Any

from asbuilt.identification.effects.found_effect import FoundEffect
from asbuilt.identification.screen import effect_text
from asbuilt.tables import significant
from asbuilt.writers.reports.cards import MOODS, study_cards
from asbuilt.writers.reports.section import Report, Section, sections

VERDICT = """\
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
EFFECTS = """\
<p class="quiet">Torque error on held-out groups of different motion without an effect (grey) and\
 with it (colour). An effect that is not in the model is named only.</p>
<div class="effects">
{% for effect in effects %}
<div class="effect{{ "" if effect.in_model else " named" }}">
<div>{{ effect.text }}{{ "" if effect.in_model else ", not in the model" }}</div>
<div class="track" role="img" aria-label="{{ effect.before }} without, {{ effect.after }} with it">
<i class="before" style="width: {{ effect.wide }}%"></i>
<i class="after" style="width: {{ effect.narrow }}%"></i></div>
<div class="number">{{ effect.before }} &rarr; {{ effect.after }}</div>
</div>
{% endfor %}
</div>
"""


def _verdict(report: Report) -> dict[str, Any]:
    study = report.study
    said = [each for each in study.findings if each.severity != "info"]
    return {
        "text": study.verdict.text,
        "mood": MOODS[study.verdict.use],
        "cards": study_cards(study),
        "findings": said[:MOST_FINDINGS],
    }


def _effects(report: Report) -> dict[str, Any] | None:
    found = sorted(
        report.study.result.effects,
        key=lambda each: (not each.in_model, each.error_after - each.error_before),
    )
    if not found:
        return None
    largest = max(max(each.error_before, each.error_after) for each in found) or 1.0
    return {"effects": [_row(each, largest) for each in found]}


def _row(each: FoundEffect, largest: float) -> dict[str, Any]:
    before, after = each.error_before, each.error_after
    return {
        "text": effect_text(each),
        "in_model": each.in_model,
        "before": f"{significant(100.0 * before, 2)} %",
        "after": f"{significant(100.0 * after, 2)} %",
        "wide": round(100.0 * before / largest, 2),
        "narrow": round(100.0 * after / largest, 2),
    }


sections.register("verdict", Section("Verdict", 10, VERDICT, _verdict))
sections.register("effects", Section("What CAD lacks", 12, EFFECTS, _effects))
