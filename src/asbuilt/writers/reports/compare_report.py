"""Page of a comparison with CAD: differences, their torque, their causes."""

from __future__ import annotations

from asbuilt.findings import joined
from asbuilt.identification.result.determination import Determination
from asbuilt.identification.result.result import IdentificationResult
from asbuilt.tables import share
from asbuilt.validation.attribution.attribution import Attribution
from asbuilt.validation.attribution.causes import CAUSES
from asbuilt.validation.comparison.comparison import Comparison, recording_name
from asbuilt.writers.figures.cause_figures import attribution_figure, difference_figure
from asbuilt.writers.figures.figure_style import figure_address
from asbuilt.writers.reports.page import page, table_markup
from asbuilt.writers.reports.report_verdict import (
    Card,
    determination_card,
    difference_card,
    torque_card,
)

NO_CAUSES = (
    "Causes of the CAD error, and the torque of differences, are unknown: the result has no cause"
    " data."
)
"""Sentence for a result without cause data."""


def comparison_html(
    result: IdentificationResult,
    comparison: Comparison,
    attribution: Attribution | None,
    determination: Determination,
) -> str:
    """Return the page as text."""
    cards = [
        *([torque_card(comparison)] if comparison.torque else []),
        difference_card(comparison),
        *([] if attribution is None else [_explained_card(attribution)]),
        determination_card(determination),
    ]
    causes = (NO_CAUSES,) if attribution is None else attribution.findings
    images = {}
    joint_table = comparison.torque_table()
    if attribution is not None:
        joint_table = attribution.joint_table(comparison.torque[0][1].rms)
        images = {
            "attribution_image": figure_address(attribution_figure(attribution)),
            "difference_image": figure_address(difference_figure(comparison)),
            "share_table": table_markup(attribution.share_table(), "shares"),
            "step_table": table_markup(attribution.step_table(), "steps"),
        }
    contents = [("verdict", "Verdict"), ("causes", "Causes"), ("parameters", "Parameters")]
    sources = ", ".join(recording_name(source) for source in result.sources)
    return page(
        "comparison.html.j2",
        title=f"{result.robot}: CAD and as built",
        heading=result.robot,
        subject=f"as built against {comparison.cad_source}",
        subtitle=f"Identified from {sources}"
        + (f"; validated on {comparison.judged_by}" if comparison.judged_by else ""),
        contents=[each for each in contents if attribution is not None or each[0] != "causes"]
        + [("determination", "Determination")],
        cards=cards,
        sentences=(
            compare_headline(comparison, attribution),
            comparison.verdict(),
            *causes,
            *comparison.tests(),
        ),
        attribution=attribution,
        determination=determination,
        joint_table=table_markup(joint_table, "joint-table"),
        parameter_table=table_markup(comparison.parameter_table(), "parameters-by-torque"),
        **({"difference_image": ""} | images),
    )


def compare_headline(comparison: Comparison, attribution: Attribution | None) -> str:
    """Return what a user decides by: how far off CAD is, and what explains that, in a sentence."""
    counts = f"{comparison.n_differing} of {comparison.n_compared} parameters differ"
    if not comparison.torque:
        return f"{counts}; the result has no torques to compare."
    cad, built = comparison.torque[0]
    error = share(built.relative_error)
    if cad is None:
        return f"As built the torque error is {error} on {recording_name(built.source)}; {counts}."
    causes = () if attribution is None else attribution.chosen[:2]
    why = f", most by {joined([CAUSES[cause] for cause in causes])}" if causes else ""
    return (
        f"{comparison.cad_source} is off by {share(cad.relative_error)} of the torque (as built"
        f" {error}){why}; {counts}."
    )


def _explained_card(attribution: Attribution) -> Card:
    explained = attribution.explained
    return Card(
        "good" if explained > 0.9 else "bad",
        share(explained),
        "of the squared CAD error explained by causes",
    )
