"""Report of an identification: one self-contained HTML page made of registered sections.

The page asks the network for nothing; every name in it may come from a stranger's file and is
escaped.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup

from asbuilt.arrays import Array
from asbuilt.codec import make_plain
from asbuilt.identification.calibration.payload import Payload
from asbuilt.registry import Registry
from asbuilt.validation import Recovery, ResidualAnalysis, Validation, VelocityCurve, recording_name
from asbuilt.workflow.study_result import Study
from asbuilt.writers.figures.figure_style import thin_curves
from asbuilt.writers.reports.page import Block, read_resource, render_page
from asbuilt.writing import atomic_write


def write_report(
    path: str | os.PathLike[str],
    study: Study,
    *,
    payload: Payload | None = None,
    command: Sequence[str] = (),
    recovery: Recovery | None = None,
) -> Path:
    """Write the report of a study.

    Parameters
    ----------
    path
        File to write.
    study
        The study; it is shown as it is, and nothing is computed again.
    payload
        The payload identified with it.
    command
        Command line that repeats the study.
    recovery
        The comparison with the truth, of a virtual robot.

    Returns
    -------
    Path
        The file written.
    """
    text = report_html(study, payload=payload, command=command, recovery=recovery)
    return atomic_write(path, text)


def report_html(
    study: Study,
    *,
    payload: Payload | None = None,
    command: Sequence[str] = (),
    recovery: Recovery | None = None,
) -> str:
    """Return the report of a study as text; see `write_report`."""
    report = Report(study, payload, command, recovery)
    blocks = [
        Block(identifier, section.title, section.parts(report), folded=section.folded)
        for identifier, section in sorted(sections.items(), key=lambda item: item[1].order)
    ]
    robot = study.result.robot
    sources = ", ".join(recording_name(source) for source in study.result.sources)
    return render_page(
        robot,
        "as built",
        blocks,
        title=f"{robot}, as built",
        subtitle=f"Identified from {sources}",
        data=make_plain(plot_data(report)),
        script=read_resource("plot.js") + read_resource("report.js"),
    )


def plot_data(report: Report) -> dict[str, Any]:
    """Return what the page's script draws, ready for JSON."""
    result = report.study.result
    predictions = [each for _, each in report.predictions]
    joints = max(1, len(predictions) * len(result.joint_names))
    # 90 000 points of all four curves of each joint together keep the page below 2 MB.
    points = int(np.clip(90_000 / joints / 4, 300, 2000))
    return {
        "joints": list(result.joint_names),
        "recordings": [_collect_recording_data(prediction, points) for prediction in predictions],
        "singular_values": _round_values(result.singular_values),
        "rank": result.rank,
    }


def _collect_recording_data(validation: Validation, points: int) -> dict[str, Any]:
    curves = validation.friction_curves()
    analysis = validation.residuals()
    return {
        "n_samples": len(validation.t),
        "joints": [
            _collect_joint_data(validation, analysis, curves[k], k, points)
            for k in range(len(validation.joint_names))
        ],
    }


def _collect_joint_data(
    validation: Validation, analysis: ResidualAnalysis, friction: VelocityCurve, k: int, points: int
) -> dict[str, Any]:
    measured, built, cad = (
        torque[:, k]
        for torque in (validation.measured, validation.predicted, validation.predicted_cad)
    )
    error = measured - built
    t, *curves = thin_curves(validation.t, measured, built, cad, error, points=points)
    spread = float(np.std(error)) or 1.0
    clipped = np.clip((error - error.mean()) / spread, -5, 5)
    counts, edges = np.histogram(
        clipped[np.isfinite(clipped)], bins=51, range=(-5, 5), density=bool(np.isfinite(spread))
    )
    step = max(1, len(analysis.lags) // 200)
    dots = np.linspace(0, len(validation.t) - 1, min(len(validation.t), 500)).astype(int)
    order = dots[np.argsort(validation.velocity[dots, k])]
    return {
        "unit": validation.units[k],
        "speed_unit": "rad/s" if validation.units[k] == "N m" else "m/s",
        "rms": float(f"{validation.metrics_as_built.rms[k]:.3g}"),
        "rms_cad": float(f"{validation.metrics_cad.rms[k]:.3g}"),
        "t": _round_values(t, 6),
        "measured": _round_values(curves[0]),
        "built": _round_values(curves[1]),
        "cad": _round_values(curves[2]),
        "histogram": {
            "z": _round_values(0.5 * (edges[1:] + edges[:-1])),
            "density": _round_values(counts),
            "spread": float(f"{spread:.3g}"),
        },
        "lags": _round_values(analysis.lags[::step]),
        "correlation": _round_values(analysis.autocorrelation[::step, k], 3),
        "band": float(f"{1.96 / math.sqrt(analysis.n_samples):.4g}"),
        "friction": {
            "speed": _round_values(validation.velocity[order, k], 4),
            "torque": _round_values(error[order] + validation.drive[order, k], 4),
            "law": _round_values(validation.drive[order, k], 4),
            "bin": _round_values(friction.velocity, 4),
            "median": _round_values(friction.median, 4),
        },
    }


def _round_values(values: Array, digits: int = 5) -> list[float | None]:
    return [
        float(f"{value:.{digits}g}") if math.isfinite(value) else None for value in values.tolist()
    ]


@dataclass(frozen=True, eq=False)
class Report:
    """Hold what a report shows: a study, the payload identified with it, and the command line.

    `recovery` compares the result with the truth of a virtual robot.
    """

    study: Study
    payload: Payload | None = None
    command: Sequence[str] = ()
    recovery: Recovery | None = None

    @cached_property
    def predictions(self) -> tuple[tuple[str, Validation], ...]:
        """Predictions with their names: of validation data, then of training data."""
        return (
            *(
                (recording_name(validation.source), validation)
                for validation in self.study.validations
            ),
            *(
                (f"{recording_name(validation.source)}, training", validation)
                for validation in self.study.training
            ),
        )


@dataclass(frozen=True, slots=True)
class Section:
    """Describe one section of a report.

    Parameters
    ----------
    title
        Heading, and name in the contents.
    order
        Place on the page; sections with smaller numbers come first.
    parts
        Function from a `Report` to drawings, lists and tables, one after another; without any the
        section is left out.
    folded
        Whether a reader opens it: what is no part of the decision.
    """

    title: str
    order: float
    parts: Callable[[Report], Sequence[Markup]]
    folded: bool = False


sections: Registry[Section] = Registry(
    "report section", "asbuilt.writers.reports.sections", "asbuilt.report_sections"
)
"""Sections by identifier; another distribution adds its own by this entry point group."""
