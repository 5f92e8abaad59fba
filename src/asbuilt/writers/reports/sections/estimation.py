"""Sections of the estimation: what was found, what the recordings determine, provenance."""

from __future__ import annotations

import shlex
from typing import Any

from markupsafe import Markup

from asbuilt.identification import FoundEffect, IdentificationResult, method_title
from asbuilt.identification.screen import format_effect
from asbuilt.tables import format_share, round_significant
from asbuilt.validation.comparison.compared_parameter import describe_drive
from asbuilt.writers.reports.cards import MOODS, make_study_cards
from asbuilt.writers.reports.page import (
    cards_markup,
    facts_markup,
    list_markup,
    paragraph_markup,
    section_markup,
)
from asbuilt.writers.reports.report import Report, Section, sections

SINGULAR_VALUES = """\
<div id="singular-plot" class="plot"></div>
<p class="quiet">Singular values of the weighted observation matrix with columns scaled to unit\
 length; the recordings determine {} of {} directions.</p>"""
PROVENANCE = """\
<ol>
{% for line in provenance %}
<li>{{ line }}</li>
{% endfor %}
</ol>
{% if citation_of_robot %}<p>Robot description: {{ citation_of_robot }}</p>{% endif %}
{{ notes }}
{% if command %}
<h3>To repeat</h3>
<pre><code>{{ command }}</code></pre>
{% endif %}
"""


def _make_estimation(report: Report) -> list[Markup]:
    study = report.study
    n = len(study.findings)
    findings = (
        (finding.severity, Markup("{} <code>{}</code>").format(finding.text, finding.code))
        for finding in study.findings
    )
    return [
        list_markup(findings, f"{n} finding{'s' if n > 1 else ''}"),
        facts_markup(_list_facts(study.result)),
        list_markup(study.result.notes, "How the estimate was chosen"),
    ]


def _list_facts(result: IdentificationResult) -> list[tuple[str, str]]:
    relative = f"{format_share(result.train.relative_error)} on the training data"
    if result.validation:
        held_out = (format_share(metrics.relative_error) for metrics in result.validation)
        relative += f", {', '.join(held_out)} held out"
    consistency = {True: "OK", False: "PHYSICALLY INCONSISTENT", None: "not checked"}
    return [
        ("method", method_title(result.method)),
        ("drive terms", describe_drive(result.base.drive)),
        (
            "samples",
            f"{result.n_samples} x {len(result.joint_names)} joints at {result.rate:g} Hz,"
            f" {result.duration:.1f} s",
        ),
        ("standard errors", result.errors.kind),
        ("independent samples", round_significant(result.effective_samples)),
        (
            "rank",
            f"{result.rank} of {result.n_base} base parameters ({result.n_standard} standard)",
        ),
        (
            "condition number",
            f"{round_significant(result.condition_number)} (columns scaled"
            f" {round_significant(result.scaled_condition_number)})",
        ),
        ("relative error", relative),
        ("consistency", consistency[result.physically_consistent]),
    ]


def _make_identifiability(report: Report) -> list[Markup]:
    result = report.study.result
    return [
        Markup(SINGULAR_VALUES).format(result.rank, result.n_base),
        list_markup(report.study.determination.sentences),
        list_markup(
            (Markup("<code>{}</code>").format(direction) for direction in result.undetermined),
            "Undetermined directions",
        ),
    ]


def _make_provenance(report: Report) -> list[Markup]:
    result = report.study.result
    fields = {
        "provenance": result.provenance,
        "citation_of_robot": result.model.citation,
        "notes": list_markup(result.model.notes, "Notes of the description"),
        "command": shlex.join(report.command),
    }
    return [section_markup(PROVENANCE, fields)]


for identifier, section in {
    "estimation": Section("Findings and estimation", 35, _make_estimation, folded=True),
    "identifiability": Section("Identifiability", 70, _make_identifiability, folded=True),
    "provenance": Section("Provenance", 80, _make_provenance, folded=True),
}.items():
    sections.register(identifier, section)

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


def _make_verdict(report: Report) -> list[Markup]:
    study = report.study
    verdict = study.verdict
    findings = [
        (finding.severity, finding.text) for finding in study.findings if finding.severity != "info"
    ]
    return [
        paragraph_markup(verdict.text, f"verdict {MOODS[verdict.use]}"),
        cards_markup(make_study_cards(study)),
        # The first ones; all are in a section of their own.
        list_markup(findings[:5]),
    ]


def _make_effects(report: Report) -> list[Markup]:
    effects = sorted(
        report.study.result.effects,
        key=lambda effect: (not effect.in_model, effect.error_after - effect.error_before),
    )
    if not effects:
        return []
    largest = max(max(effect.error_before, effect.error_after) for effect in effects) or 1.0
    rows = [_build_row(effect, largest) for effect in effects]
    return [section_markup(EFFECTS, {"effects": rows})]


def _build_row(effect: FoundEffect, largest: float) -> dict[str, Any]:
    before = effect.error_before
    after = effect.error_after
    return {
        "text": format_effect(effect),
        "in_model": effect.in_model,
        "before": f"{round_significant(100.0 * before, 2)} %",
        "after": f"{round_significant(100.0 * after, 2)} %",
        "wide": round(100.0 * before / largest, 2),
        "narrow": round(100.0 * after / largest, 2),
    }


sections.register("verdict", Section("Verdict", 10, _make_verdict))
sections.register("effects", Section("What CAD lacks", 12, _make_effects))
