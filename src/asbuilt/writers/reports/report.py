"""One self-contained HTML page about an identification.

Verdict, tables, interactive torque plots, warnings, provenance.

The page carries everything it needs and asks the network for nothing; every name in it may come
from a stranger's file and is escaped.
"""

from __future__ import annotations

import math
import os
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup
from plotly.offline import get_plotlyjs

from asbuilt.arrays import Array
from asbuilt.identification.calibration.payload import Payload
from asbuilt.identification.result.determination import determination
from asbuilt.identification.result.result import IdentificationResult
from asbuilt.tables import beside, deviation, percent, rounded, share, significant
from asbuilt.validation.attribution.attribution import Attribution, attribute
from asbuilt.validation.comparison.compared_parameter import ComparedParameter
from asbuilt.validation.comparison.comparison import compare, recording_name
from asbuilt.validation.comparison.parameter_text import drive_text
from asbuilt.validation.prediction import Validation
from asbuilt.validation.residuals import ResidualAnalysis, VelocityCurve
from asbuilt.writers.figures.cause_figures import attribution_figure
from asbuilt.writers.figures.figure_style import figure_address
from asbuilt.writers.figures.thinning import thinned
from asbuilt.writers.files import atomic_write
from asbuilt.writers.reports.page import page, resource, table_markup
from asbuilt.writers.reports.report_verdict import verdict
from asbuilt.writers.tables.payload_tables import payload_table, payload_torque_table

CURVE_POINTS = 120_000
"""Points of all torque curves of a page together.

Each joint of each recording gets its share, 400 to 2500.
"""


def write_report(
    path: str | os.PathLike[str],
    result: IdentificationResult,
    validations: Sequence[Validation] = (),
    *,
    fitted: Sequence[Validation] = (),
    attribution: Attribution | None = None,
    payload: Payload | None = None,
    command: Sequence[str] = (),
) -> Path:
    """Write the report of a result; see `report_html`."""
    return atomic_write(
        path,
        report_html(
            result,
            validations,
            fitted=fitted,
            attribution=attribution,
            payload=payload,
            command=command,
        ),
    )


def report_html(
    result: IdentificationResult,
    validations: Sequence[Validation] = (),
    *,
    fitted: Sequence[Validation] = (),
    attribution: Attribution | None = None,
    payload: Payload | None = None,
    command: Sequence[str] = (),
) -> str:
    """Return the page as text.

    `validations` are predictions of data not used for fitting, by which the model is judged;
    `fitted` are predictions of the data used, which the plots show too. `attribution` says why CAD
    is off; it is worked out where none is given and the result carries the cause data. `payload` is
    what the flange carries, where that was identified too. `command` is the command line that
    repeats the identification.
    """
    comparison = compare(result, validation=validations or None)
    if attribution is None and result.cause_data is not None:
        attribution = attribute(result)
    shown = [*validations, *fitted]
    analyses = [item.residuals() for item in shown]
    labels = [
        recording_name(item.source) + ("" if place < len(validations) else ", used for fitting")
        for place, item in enumerate(shown)
    ]
    return page(
        "report.html.j2",
        title=f"{result.robot}, as built",
        robot=result.robot,
        result=result,
        facts=_facts(result),
        findings=verdict(result, comparison),
        comparison=comparison,
        parameters=[_parameter_row(parameter) for parameter in comparison.parameters],
        torque_table=table_markup(comparison.torque_table(), "torque-table"),
        sources=", ".join(recording_name(source) for source in result.sources),
        determination=determination(result),
        attribution=attribution,
        attribution_image=(
            "" if attribution is None else figure_address(attribution_figure(attribution))
        ),
        share_table=(
            "" if attribution is None else table_markup(attribution.share_table(), "shares")
        ),
        payload_tables=(
            ()
            if payload is None
            else (
                table_markup(payload_table(payload), "payload-values"),
                table_markup(payload_torque_table(payload), "payload-torque"),
            )
        ),
        labels=labels,
        residual_rows=[
            _residual_rows(item, analysis) for item, analysis in zip(shown, analyses, strict=True)
        ],
        data=_page_data(result, shown, analyses),
        command=shlex.join(command),
        robot_citation=result.model.citation,
        script=resource("report.js"),
        plotly=Markup(get_plotlyjs()),
    )


def _facts(result: IdentificationResult) -> list[tuple[str, str]]:
    relative = f"{share(result.train.relative_error)} on the data fitted"
    if result.validation:
        relative += (
            f", {', '.join(share(metrics.relative_error) for metrics in result.validation)}"
            " held out"
        )
    return [
        ("method", result.method),
        ("drive terms", drive_text(result.base.drive)),
        (
            "samples",
            (
                f"{result.n_samples} x {len(result.joint_names)} joints at {result.rate:g} Hz,"
                f" {result.duration:.1f} s"
            ),
        ),
        ("standard errors", result.errors.kind),
        ("independent samples", significant(result.effective_samples)),
        (
            "rank",
            f"{result.rank} of {result.n_base} base parameters ({result.n_standard} standard)",
        ),
        (
            "condition number",
            (
                f"{significant(result.condition_number)} (columns scaled"
                f" {significant(result.scaled_condition_number)})"
            ),
        ),
        ("relative error", relative),
        (
            "consistency",
            {True: "OK", False: "NOT CONSISTENT", None: "not checked"}[
                result.physically_consistent
            ],
        ),
    ]


def _parameter_row(parameter: ComparedParameter) -> dict[str, Any]:
    """Return the texts, sort keys and the little interval drawing of one parameter.

    The drawing spans -100 to 100.
    """
    half = 1.96 * (parameter.std_error or 0.0)
    scale = max(abs(parameter.estimate), abs(parameter.cad or 0.0), 0.8 * half) or 1.0
    shown, error = rounded(parameter.estimate, parameter.std_error)
    by_design = "-" if parameter.cad is None else beside(parameter.cad, parameter.std_error)
    at = 80.0 * parameter.estimate / scale
    reach = 80.0 * half / scale
    outcome = (
        "DIFFERS"
        if parameter.verdict == "differs"
        else (
            deviation(parameter.sigmas, math.inf)
            if parameter.verdict == "agrees"
            else parameter.verdict
        )
    )
    return {
        "id": parameter.id,
        "name": parameter.name,
        "expression": parameter.expression,
        "words": parameter.words,
        "unit": parameter.unit,
        "cad": by_design,
        "cad_value": parameter.cad,
        "built": shown,
        "built_value": parameter.estimate,
        "error": parameter.verdict if parameter.verdict == "dropped" else error,
        "error_value": parameter.std_error,
        "percent": percent(parameter.estimate, parameter.std_error),
        "percent_value": (
            None
            if parameter.std_error is None or not parameter.estimate
            else abs(parameter.std_error / parameter.estimate)
        ),
        "outcome": outcome,
        "sigmas": None if parameter.sigmas is None else abs(parameter.sigmas),
        "verdict": parameter.verdict,
        "sigma_text": "" if parameter.sigmas is None else f"{parameter.sigmas:+.1f} sigma",
        "x": round(at, 1),
        "low": round(max(at - reach, -100.0), 1),
        "high": round(min(at + reach, 100.0), 1),
        "x_cad": None if parameter.cad is None else round(80.0 * parameter.cad / scale, 1),
    }


def _residual_rows(validation: Validation, analysis: ResidualAnalysis) -> list[dict[str, Any]]:
    built, cad = validation.metrics_as_built, validation.metrics_cad
    return [
        {
            "joint": name,
            "unit": validation.units[k],
            "rms": significant(float(built.rms[k])),
            "rms_cad": significant(float(cad.rms[k])),
            "largest": significant(float(built.max_abs[k])),
            "relative": share(float(built.relative_error_per_joint[k])),
            "r2": f"{built.r_squared[k]:.4f}" if np.isfinite(built.r_squared[k]) else "-",
            "mean": significant(float(analysis.mean[k]), 2),
            "durbin_watson": f"{analysis.durbin_watson[k]:.2f}",
            "white": "yes" if analysis.probability_white[k] > 0.05 else "no",
            "effective": significant(float(analysis.effective_samples[k])),
        }
        for k, name in enumerate(validation.joint_names)
    ]


def _page_data(
    result: IdentificationResult,
    validations: Sequence[Validation],
    analyses: Sequence[ResidualAnalysis],
) -> dict[str, Any]:
    """Return what the page's script draws: curves per recording and joint, singular values.

    Numbers to five digits.
    """
    joints = max(1, sum(len(validation.joint_names) for validation in validations))
    points = int(np.clip(CURVE_POINTS / joints / 4, 400, 2500))
    return {
        "joints": list(result.joint_names),
        "recordings": [
            _recording_data(item, analysis, points)
            for item, analysis in zip(validations, analyses, strict=True)
        ],
        "singular_values": _listed(result.singular_values),
        "rank": result.rank,
    }


def _recording_data(
    validation: Validation, analysis: ResidualAnalysis, points: int
) -> dict[str, Any]:
    curves = validation.friction_curves()
    return {
        "n_samples": len(validation.t),
        "joints": [
            _joint_data(validation, analysis, curves[k], k, points)
            for k in range(len(validation.joint_names))
        ],
    }


def _joint_data(
    validation: Validation, analysis: ResidualAnalysis, friction: VelocityCurve, k: int, points: int
) -> dict[str, Any]:
    measured, built, cad = (
        torque[:, k]
        for torque in (validation.measured, validation.predicted, validation.predicted_cad)
    )
    t, *curves = thinned(validation.t, measured, built, cad, measured - built, points=points)
    error = measured - built
    spread = float(np.std(error)) or 1.0
    counts, edges = np.histogram(
        np.clip((error - error.mean()) / spread, -5, 5), bins=51, range=(-5, 5), density=True
    )
    step = max(1, len(analysis.lags) // 200)
    dots = np.linspace(0, len(validation.t) - 1, min(len(validation.t), 600)).astype(int)
    order = dots[np.argsort(validation.velocity[dots, k])]
    return {
        "unit": validation.units[k],
        "speed_unit": "rad/s" if validation.units[k] == "N m" else "m/s",
        "rms": float(f"{validation.metrics_as_built.rms[k]:.4g}"),
        "rms_cad": float(f"{validation.metrics_cad.rms[k]:.4g}"),
        "t": _listed(t, 7),
        "measured": _listed(curves[0]),
        "built": _listed(curves[1]),
        "cad": _listed(curves[2]),
        "histogram": {
            "z": _listed(0.5 * (edges[1:] + edges[:-1])),
            "density": _listed(counts),
            "spread": float(f"{spread:.3g}"),
        },
        "lags": _listed(analysis.lags[::step]),
        "correlation": _listed(analysis.autocorrelation[::step, k]),
        "band": float(f"{1.96 / math.sqrt(analysis.n_samples):.4g}"),
        "friction": {
            "speed": _listed(validation.velocity[order, k], 4),
            "torque": _listed(error[order] + validation.drive[order, k], 4),
            "law": _listed(validation.drive[order, k], 4),
            "bin": _listed(friction.velocity, 4),
            "median": _listed(friction.median, 4),
        },
    }


def _listed(values: Array, digits: int = 5) -> list[float | None]:
    return [
        float(f"{value:.{digits}g}") if math.isfinite(value) else None for value in values.tolist()
    ]
