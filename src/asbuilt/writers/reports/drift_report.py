"""One self-contained HTML page of two results of one robot, or of a result and its controller's
model: what changed, and what that does to the torque.
"""

from __future__ import annotations

from asbuilt.tables import share, significant
from asbuilt.validation.comparison.drift import Drift
from asbuilt.validation.comparison.torque_change import joint_table
from asbuilt.workflow.controller_model import ControllerComparison
from asbuilt.writers.figures.drift_figure import drift_figure
from asbuilt.writers.figures.figure_style import figure_address
from asbuilt.writers.reports.page import page, table_markup
from asbuilt.writers.reports.report_verdict import Finding


def drift_html(compared: Drift | ControllerComparison) -> str:
    """Return the page as text; it asks the network for nothing, and every name in it is escaped."""
    controller = None if isinstance(compared, Drift) else compared
    drift = compared if isinstance(compared, Drift) else compared.difference
    return page(
        "drift.html.j2",
        title=f"{drift.robot}: {drift.after} against {drift.before}",
        drift=drift,
        findings=[*([] if controller is None else [_prediction(controller)]), *_findings(drift)],
        sentences=(
            *(() if controller is None else (controller.verdict(),)),
            drift.verdict(),
            *drift.sentences,
        ),
        joint_table=(
            table_markup(
                joint_table(drift.joints, drift.level, of_models=drift.of_models),
                "joints-by-torque",
            )
            if drift.joints
            else ""
        ),
        joint_image=figure_address(drift_figure(drift)) if drift.joints else "",
        error_table=(
            "" if controller is None else table_markup(controller.torque_table(), "torque-table")
        ),
        changed_table=table_markup(drift.table(changed=True), "changed") if drift.n_changed else "",
        other_table=(
            table_markup(drift.table(changed=False), "others")
            if drift.n_changed < len(drift.parameters)
            else ""
        ),
    )


def _prediction(controller: ControllerComparison) -> Finding:
    built, maker = controller.as_built.relative_error, controller.controller.relative_error
    label = f"of the torque is off as built, against {share(maker)} by the controller's model"
    return Finding("good" if built < maker else "neutral", share(built), label, "")


def _findings(drift: Drift) -> list[Finding]:
    verb = "differ" if drift.of_models else "changed"
    tested = sum(parameter.sigmas is not None for parameter in drift.parameters)
    found = [
        Finding(
            "neutral" if drift.n_changed else "good",
            f"{drift.n_changed} of {tested}",
            f"parameters {verb} beyond doubt",
            "",
        )
    ]
    if drift.joints:
        changed = [joint for joint in drift.joints if joint.holm <= drift.level]
        label = f"joints {verb} in the torque of the same motion"
        found.append(
            Finding(
                "neutral" if changed else "good",
                f"{len(changed)} of {len(drift.joints)}",
                label,
                "",
            )
        )
        if changed:
            most = max(changed, key=lambda joint: joint.torque)
            beside = (
                f"largest, at {most.joint}, where the motion takes"
                f" {significant(most.torque_of_motion)} {most.unit}"
            )
            found.append(Finding("neutral", f"{significant(most.torque)} {most.unit}", beside, ""))
    return found
