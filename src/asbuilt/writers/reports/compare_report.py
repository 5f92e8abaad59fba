"""One self-contained HTML page that holds CAD against the robot as built.

Where it differs, what that costs, why, and what the recording can tell.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from asbuilt.identification.result.determination import Determination
from asbuilt.tables import share
from asbuilt.validation.attribution.attribution import Attribution
from asbuilt.validation.comparison.compared_parameter import parameter_table
from asbuilt.validation.comparison.comparison import Comparison, recording_name
from asbuilt.writers.figures.cause_figures import attribution_figure, difference_figure
from asbuilt.writers.figures.figure_style import figure_address
from asbuilt.writers.reports.page import page, table_markup
from asbuilt.writers.reports.report_verdict import Finding

if TYPE_CHECKING:
    from asbuilt.identification.result.result import IdentificationResult


UNTOLD = (
    "Why CAD is off, and what differences cost in torque, is not told: the result carries no"
    " cause data (too short, or identified without a study)."
)
"""Said where there is no attribution."""


def comparison_html(
    result: IdentificationResult,
    comparison: Comparison,
    attribution: Attribution | None,
    determination: Determination,
) -> str:
    """Return the page as text; it asks the network for nothing, and every name in it is escaped."""
    return page(
        "comparison.html.j2",
        title=f"{result.robot}: CAD against as built",
        robot=result.robot,
        cad=comparison.cad_source,
        sources=", ".join(recording_name(source) for source in result.sources),
        findings=_findings(comparison, attribution, determination),
        tests=(*comparison.tests(), *((UNTOLD,) if attribution is None else ())),
        comparison=comparison,
        attribution=attribution,
        determination=determination,
        torque_table=(
            table_markup(comparison.torque_table(), "torque-table") if comparison.torque else ""
        ),
        joint_table=(
            ""
            if attribution is None
            else table_markup(attribution.joint_table(comparison.torque[0][1].rms), "joint-table")
        ),
        share_table=(
            "" if attribution is None else table_markup(attribution.share_table(), "shares")
        ),
        step_table="" if attribution is None else table_markup(attribution.step_table(), "steps"),
        parameter_table=table_markup(
            parameter_table(
                comparison.ranked,
                level=comparison.level,
                errors=comparison.errors,
                units=comparison.units,
                width=None,
            ),
            "parameters-by-torque",
        ),
        attribution_image=(
            "" if attribution is None else figure_address(attribution_figure(attribution))
        ),
        difference_image=(
            "" if attribution is None else figure_address(difference_figure(comparison))
        ),
    )


def _findings(
    comparison: Comparison, attribution: Attribution | None, determination: Determination
) -> list[Finding]:
    found = []
    if comparison.torque:
        cad, built = comparison.torque[0]
        better = cad is not None and built.relative_error < cad.relative_error
        against = "" if cad is None else f", against {share(cad.relative_error)} by CAD"
        found.append(
            Finding(
                "good" if better else "neutral",
                share(built.relative_error),
                f"of the torque is off as built{against}",
                "",
            )
        )
    matter = (
        ""
        if comparison.n_mattering is None
        else f", {comparison.n_mattering} of them noticeably in torque"
    )
    found.append(
        Finding(
            "neutral",
            f"{comparison.n_differing} of {comparison.n_compared}",
            f"parameters differ from CAD{matter}",
            "",
        )
    )
    if attribution is not None:
        energy = attribution.rms_cad**2
        left = float(attribution.unexplained @ energy / energy.sum())
        found.append(
            Finding(
                "good" if left < 0.1 else "bad",
                share(1.0 - left),
                "of the squared CAD error explained by named causes",
                "",
            )
        )
    total = sum(
        len(names)
        for names in (
            determination.well,
            determination.fairly,
            determination.hardly,
            determination.not_at_all,
        )
    )
    found.append(
        Finding(
            "neutral",
            f"{len(determination.well)} of {total}",
            "parameters known to 10 % or better",
            "",
        )
    )
    return found
