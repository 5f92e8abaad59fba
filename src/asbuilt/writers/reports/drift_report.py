"""Page of two results of one robot, or of a result and the model of its controller."""

from __future__ import annotations

from asbuilt.tables import share, significant
from asbuilt.validation.comparison.drift import Drift
from asbuilt.validation.comparison.torque_change import joint_table
from asbuilt.workflow.controller_model import ControllerComparison
from asbuilt.writers.figures.drift_figure import drift_figure
from asbuilt.writers.figures.figure_style import figure_address
from asbuilt.writers.reports.page import page, table_markup
from asbuilt.writers.reports.report_verdict import Card


def drift_html(compared: Drift | ControllerComparison) -> str:
    """Return the page as text."""
    controller = None if isinstance(compared, Drift) else compared
    drift = compared if isinstance(compared, Drift) else compared.difference
    n_changed, n = drift.n_changed, len(drift.parameters)
    contents = [("verdict", "Verdict"), ("torque", "Torque"), ("parameters", "Parameters")]
    return page(
        "drift.html.j2",
        title=f"{drift.robot}: {drift.after} against {drift.before}",
        heading=drift.robot,
        subject=f"{drift.after} against {drift.before}",
        subtitle="",
        contents=[each for each in contents if drift.joints or each[0] != "torque"],
        drift=drift,
        cards=[*([] if controller is None else [_prediction_card(controller)]), *_cards(drift)],
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
        changed_table=table_markup(drift.table(changed=True), "changed") if n_changed else "",
        other_table=table_markup(drift.table(changed=False), "others") if n_changed < n else "",
    )


def _prediction_card(controller: ControllerComparison) -> Card:
    built, maker = controller.as_built.relative_error, controller.controller.relative_error
    return Card(
        "good" if built < maker else "neutral",
        share(built),
        f"torque error as built, controller's model {share(maker)}",
    )


def _cards(drift: Drift) -> list[Card]:
    verb = "differ" if drift.of_models else "changed"
    tested = sum(parameter.sigmas is not None for parameter in drift.parameters)
    found = [
        Card(
            "neutral" if drift.n_changed else "good",
            f"{drift.n_changed} of {tested}",
            f"parameters {verb} significantly",
        )
    ]
    if drift.joints:
        changed = [joint for joint in drift.joints if joint.holm <= drift.level]
        found.append(
            Card(
                "neutral" if changed else "good",
                f"{len(changed)} of {len(drift.joints)}",
                f"joints {verb} in the torque of the same motion",
            )
        )
        if changed:
            most = max(changed, key=lambda joint: joint.torque)
            found.append(
                Card(
                    "neutral",
                    f"{significant(most.torque)} {most.unit}",
                    f"largest, at {most.joint}, of"
                    f" {significant(most.torque_of_motion)} {most.unit} RMS torque",
                )
            )
    return found
