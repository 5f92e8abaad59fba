"""Texts, documents, files and pages of `asbuilt compare`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from markupsafe import Markup

from asbuilt.findings import join_names
from asbuilt.identification import Determination, IdentificationResult
from asbuilt.identification.effects.effect import name_group
from asbuilt.tables import format_share, round_significant, wrap_text
from asbuilt.validation import Attribution, Comparison, Drift, recording_name
from asbuilt.validation.comparison.torque_change import tabulate_joint_changes
from asbuilt.workflow.controller_model import ControllerComparison
from asbuilt.writers.figures.comparison_figures import (
    draw_attribution,
    draw_differences,
    draw_drift,
)
from asbuilt.writers.figures.figure_style import encode_figure, save_figure
from asbuilt.writers.reports.cards import (
    make_determination_card,
    make_difference_card,
    make_torque_card,
)
from asbuilt.writers.reports.page import (
    Block,
    Card,
    Mood,
    cards_markup,
    image_markup,
    list_markup,
    paragraph_markup,
    render_page,
    table_markup,
)
from asbuilt.writing import atomic_write

NO_CAUSES = (
    "Causes of the CAD error, and the torque of differences, are unknown: the result has no cause"
    " data."
)
"""Sentence for a result without cause data."""


@dataclass(frozen=True, slots=True, eq=False)
class CadVerdict:
    """Hold a comparison with CAD, its causes (None without cause data) and what is determined."""

    comparison: Comparison
    attribution: Attribution | None
    determination: Determination

    def as_text(self, full: bool = False) -> str:
        """Return verdict, causes and parameters for a terminal.

        Parameters
        ----------
        full
            Show everything; else what fits one screen of 80 columns.
        """
        comparison = self.comparison
        found = self.attribution
        parts = [wrap_text(self.headline)]
        if full or comparison.tolerance is not None:
            parts.append(comparison.heading(full))
        if found is None or full:
            parts += [comparison.torque_table().as_text(full)] if comparison.torque else []
        if found is None:
            parts.append(wrap_text(NO_CAUSES) + "\n")
        elif full:
            parts.append(found.as_text(full))
        else:
            sentences = [wrap_text(line, lines=2) for line in found.findings[:3]]
            table = found.joint_table(comparison.torque[0][1].rms)
            parts.append("\n".join([*sentences, "", table.as_text()]))
        parts.append(comparison.parameter_table().as_text(full))
        if full:
            sentences = [wrap_text(line, "  ") for line in self.determination.sentences]
            parts.append("\n".join(["What the recording determines:", *sentences]) + "\n")
        return "\n".join(parts)

    @property
    def headline(self) -> str:
        """What a user decides by: how far off CAD is, and what explains that, in a sentence."""
        comparison = self.comparison
        counts = (
            f"the log contradicts {comparison.n_differing} of {comparison.n_compared} base"
            " parameters"
        )
        if not comparison.torque:
            return f"{counts[0].upper()}{counts[1:]}; the result has no torques to compare."
        cad, built = comparison.torque[0]
        error = format_share(built.relative_error)
        source = recording_name(built.source)
        if cad is None:
            return f"As built the torque error is {error} on {source}; {counts}."
        causes = () if self.attribution is None else self.attribution.chosen[:2]
        why = f", most by {join_names([name_group(key) for key in causes])}" if causes else ""
        return (
            f"{comparison.cad_source} is off by {format_share(cad.relative_error)} of the torque"
            " (as built"
            f" {error}){why}; {counts}."
        )

    def as_document(self) -> dict[str, Any]:
        """Return plain numbers, lists and None, ready for JSON."""
        return self.comparison.as_document() | {
            "headline": self.headline,
            "attribution": None if self.attribution is None else self.attribution.as_document(),
            "determination": self.determination.as_dict(),
        }

    def as_html(self, result: IdentificationResult) -> str:
        """Return the page as text: differences, their torque, their causes."""
        comparison = self.comparison
        found = self.attribution
        sources = ", ".join(recording_name(source) for source in result.sources)
        cards = [
            *([make_torque_card(comparison)] if comparison.torque else []),
            make_difference_card(comparison),
            make_determination_card(self.determination),
        ]
        sentences = (
            self.headline,
            *((NO_CAUSES,) if found is None else found.findings),
            *comparison.tests(),
        )
        joints = (
            comparison.torque_table()
            if found is None
            else found.joint_table(comparison.torque[0][1].rms)
        )
        table = comparison.parameter_table()
        parameters = [table_markup(table, "parameters-by-torque", "scroll parameters")]
        causes: list[Markup] = []
        if found is not None:
            mood: Mood = "good" if found.explained > 0.9 else "bad"
            label = "of the squared CAD error explained by causes"
            cards.insert(-1, Card(mood, format_share(found.explained), label))
            causes += [
                draw_shares(found),
                table_markup(found.share_table(), "shares"),
            ]
            words = "Torque of each difference; the numbers are in the table below"
            parameters.insert(0, image_markup(encode_figure(draw_differences(comparison)), words))
        return render_page(
            result.robot,
            f"as built against {comparison.cad_source}",
            [
                Block(
                    "verdict",
                    "Verdict",
                    (
                        cards_markup(cards),
                        list_markup(sentences),
                        table_markup(joints, "joint-table"),
                    ),
                ),
                Block("causes", "Causes of the CAD error", causes, "Causes"),
                Block(
                    "parameters",
                    "Parameters, those with the most torque first",
                    parameters,
                    "Parameters",
                ),
                Block(
                    "determination",
                    "What the recording determines",
                    (list_markup(self.determination.sentences),),
                    "Determination",
                ),
            ],
            title=f"{result.robot}: CAD and as built",
            subtitle=f"Identified from {sources}"
            + (f"; validated on {comparison.judged_by}" if comparison.judged_by else ""),
        )


def write_comparison(
    folder: Path, result: IdentificationResult, verdict: CadVerdict
) -> dict[str, Path]:
    """Write comparison.csv, .txt and .html, and with causes attribution.csv and figures.

    Returns the paths by kind.
    """
    comparison = verdict.comparison
    found = verdict.attribution
    files = {
        "comparison": atomic_write(
            folder / "comparison.csv", comparison.parameter_table().as_csv()
        ),
        "text": atomic_write(folder / "comparison.txt", verdict.as_text(full=True)),
        "report": atomic_write(folder / "comparison.html", verdict.as_html(result)),
    }
    if found is None:
        return files
    return files | {
        "attribution": atomic_write(folder / "attribution.csv", found.share_table().as_csv()),
        "attribution_figure": save_figure(draw_attribution(found), folder / "attribution.png"),
        "difference_figure": save_figure(draw_differences(comparison), folder / "differences.png"),
    }


def draw_shares(found: Attribution) -> Markup:
    """Return the drawing of the causes of the CAD error."""
    words = (
        "Shares of the squared CAD error by cause, joint by joint; the numbers are in the table"
        " below"
    )
    return image_markup(encode_figure(draw_attribution(found)), words)


def write_drift(folder: Path, compared: Drift | ControllerComparison) -> dict[str, Path]:
    """Write drift.csv, drift.txt and drift.html; return the paths by kind."""
    drift = compared if isinstance(compared, Drift) else compared.difference
    return {
        "comparison": atomic_write(folder / "drift.csv", drift.table().as_csv()),
        "text": atomic_write(folder / "drift.txt", compared.as_text(full=True)),
        "report": atomic_write(folder / "drift.html", render_drift(compared)),
    }


def render_drift(compared: Drift | ControllerComparison) -> str:
    """Return the page of two results of one robot, or of a result and its controller's model."""
    drift = compared if isinstance(compared, Drift) else compared.difference
    cards = _make_drift_cards(drift)
    sentences = [drift.verdict(), *drift.sentences]
    verdict: list[Markup] = []
    if isinstance(compared, ControllerComparison):
        cards.insert(0, _make_prediction_card(compared))
        sentences.insert(0, compared.verdict())
        verdict.append(table_markup(compared.torque_table(), "torque-table"))
    drawn: list[Markup] = []
    if drift.joints:
        words = (
            "Torque of the changes at every joint next to what standard errors explain; the numbers"
            " are in the table below"
        )
        joints = tabulate_joint_changes(drift.joints, drift.level, of_models=drift.of_models)
        drawn = [
            image_markup(encode_figure(draw_drift(drift)), words),
            table_markup(joints, "joints-by-torque"),
        ]
    changed, others = (
        [table_markup(drift.table(changed=which), name, "scroll parameters")] if count else []
        for which, name, count in (
            (True, "changed", drift.n_changed),
            (False, "others", len(drift.parameters) - drift.n_changed),
        )
    )
    none = f"No parameter {'differs' if drift.of_models else 'changed'} significantly."
    order = "Parameters" + (", those with the most torque first" if drift.joints else "")
    return render_page(
        drift.robot,
        f"{drift.after} against {drift.before}",
        [
            Block("verdict", "Verdict", (cards_markup(cards), list_markup(sentences), *verdict)),
            Block("torque", "Torque, joint by joint", drawn, "Torque"),
            Block(
                "parameters", order, (*(changed or [paragraph_markup(none)]), *others), "Parameters"
            ),
        ],
    )


def _make_prediction_card(controller: ControllerComparison) -> Card:
    built = controller.as_built.relative_error
    maker = controller.controller.relative_error
    label = f"torque error as built, controller's model {format_share(maker)}"
    return Card("good" if built < maker else "neutral", format_share(built), label)


def _make_drift_cards(drift: Drift) -> list[Card]:
    verb = "differ" if drift.of_models else "changed"
    changed = [joint for joint in drift.joints if joint.holm <= drift.level]
    counts = [
        (drift.n_changed, drift.n_compared, f"parameters {verb} significantly"),
        (len(changed), len(drift.joints), f"joints {verb} in the torque of the same motion"),
    ]
    cards = [
        Card("neutral" if part else "good", f"{part} of {whole}", label)
        for part, whole, label in (counts if drift.joints else counts[:1])
    ]
    if changed:
        most = max(changed, key=lambda joint: joint.torque)
        figure, of = map(round_significant, (most.torque, most.torque_of_motion))
        label = f"largest, at {most.joint}, of {of} {most.unit} RMS torque"
        cards.append(Card("neutral", f"{figure} {most.unit}", label))
    return cards
