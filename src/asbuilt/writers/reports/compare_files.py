"""Texts, documents and files of `asbuilt compare`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from asbuilt.identification.result.determination import Determination
from asbuilt.tables import wrapped
from asbuilt.validation.attribution.attribution import Attribution
from asbuilt.validation.comparison.comparison import Comparison
from asbuilt.validation.comparison.drift import Drift
from asbuilt.workflow.controller_model import ControllerComparison
from asbuilt.writers.figures.cause_figures import attribution_figure, difference_figure
from asbuilt.writers.figures.figure_style import save_figure
from asbuilt.writers.files import atomic_write, path_texts
from asbuilt.writers.reports.compare_report import NO_CAUSES, compare_headline, comparison_html
from asbuilt.writers.reports.drift_report import drift_html

if TYPE_CHECKING:
    from asbuilt.identification.result.result import IdentificationResult


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
        comparison, found = self.comparison, self.attribution
        parts = [wrapped(self.headline), comparison.heading(full)]
        if found is None or full:
            parts += [comparison.torque_table().as_text(full)] if comparison.torque else []
        if found is None:
            parts.append(wrapped(NO_CAUSES) + "\n")
        elif full:
            parts.append(found.as_text(full))
        else:
            said = [wrapped(line, lines=2) for line in found.findings[:3]]
            table = found.joint_table(comparison.torque[0][1].rms)
            parts.append("\n".join([*said, "", table.as_text()]))
        parts.append(comparison.parameter_table().as_text(full))
        if full:
            said = [wrapped(line, "  ") for line in self.determination.sentences]
            parts.append("\n".join(["What the recording determines:", *said]) + "\n")
        return "\n".join(parts)

    @property
    def headline(self) -> str:
        """What a user decides by, in a sentence."""
        return compare_headline(self.comparison, self.attribution)

    def as_document(self) -> dict[str, Any]:
        """Return plain numbers, lists and None, ready for JSON."""
        return self.comparison.as_document() | {
            "headline": self.headline,
            "attribution": None if self.attribution is None else self.attribution.as_document(),
            "determination": self.determination.as_dict(),
        }


def write_comparison(
    folder: Path, result: IdentificationResult, verdict: CadVerdict
) -> dict[str, Path]:
    """Write comparison.csv, .txt and .html, and with causes attribution.csv and figures.

    Returns the paths by kind.
    """
    files = {
        "comparison": atomic_write(
            folder / "comparison.csv", verdict.comparison.parameter_table().as_csv()
        ),
        "text": atomic_write(folder / "comparison.txt", verdict.as_text(full=True)),
        "report": atomic_write(
            folder / "comparison.html",
            comparison_html(result, verdict.comparison, verdict.attribution, verdict.determination),
        ),
    }
    if verdict.attribution is not None:
        files["attribution"] = atomic_write(
            folder / "attribution.csv", verdict.attribution.share_table().as_csv()
        )
        files["attribution_figure"] = save_figure(
            attribution_figure(verdict.attribution), folder / "attribution.png"
        )
        files["difference_figure"] = save_figure(
            difference_figure(verdict.comparison), folder / "differences.png"
        )
    return files


def write_drift(folder: Path, compared: Drift | ControllerComparison) -> dict[str, Path]:
    """Write drift.csv, drift.txt and drift.html; return the paths by kind."""
    drift = compared if isinstance(compared, Drift) else compared.difference
    return {
        "comparison": atomic_write(folder / "drift.csv", drift.table().as_csv()),
        "text": atomic_write(folder / "drift.txt", compared.as_text(full=True)),
        "report": atomic_write(folder / "drift.html", drift_html(compared)),
    }


def with_files(document: dict[str, Any], files: Mapping[str, Path]) -> dict[str, Any]:
    """Return the document with the paths of what was written."""
    return {**document, "files": path_texts(files)}
