"""Summary of an identification: heading, findings, joints, parameters, notes."""

from __future__ import annotations

import html
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import PurePath

import numpy as np

from asbuilt.description.plausibility import explain_implausible_links
from asbuilt.experiment.signal.samples import RECORDINGS
from asbuilt.findings import Cure, Finding, rank_findings
from asbuilt.identification.bodies.consistency import non_passive_drives
from asbuilt.identification.calibration.encoders import describe_encoders
from asbuilt.identification.effects.effect import FoundEffect
from asbuilt.identification.estimators.methods import method_title
from asbuilt.identification.result.determination import determination
from asbuilt.identification.result.feasible import FeasibleInterval
from asbuilt.identification.result.result import IdentificationResult, IdentifiedParameter
from asbuilt.identification.screen import compose_screen
from asbuilt.tables import (
    WIDTH,
    Cell,
    Column,
    Shown,
    Table,
    format_deviation,
    format_estimate,
    format_share,
    number_notes,
    preformat,
    round_beside,
    round_significant,
    wrap_text,
)

EXPRESSION_WIDTH = 34
MOST_PARAMETERS = 10
AS_BUILT = "as built"
DROPPED = "dropped"
"""Text for the error of a parameter that the estimator set to zero."""


@dataclass(frozen=True, slots=True)
class Summary:
    """Hold a summary for text, HTML and CSV.

    The text has no date, no colour and no terminal width: equal results have equal summaries.

    Parameters
    ----------
    title
        Robot, estimator and number of parameters.
    heading
        Pairs of label and value.
    findings
        What is wrong, or worth knowing, the worst first.
    parameters, joints
        All parameters with their CAD values, and the torque errors of all joints.
    notes
        Assumptions: the standard errors, what is determined, then the estimator's decisions.
    verdict
        Whether to use the model, in a sentence with its number; empty for a result alone.
    found_effects
        What CAD lacks and the recordings show, in the model or not.
    encoders
        What lies between two encoders, in a sentence; empty without them.
    """

    title: str
    heading: tuple[tuple[str, str], ...]
    findings: tuple[Finding, ...]
    parameters: Table
    joints: Table
    notes: tuple[str, ...]
    verdict: str = ""
    found_effects: tuple[FoundEffect, ...] = ()
    encoders: str = ""

    def __str__(self) -> str:
        return self.as_text()

    def _repr_html_(self) -> str:
        """Return the text of one screen for notebooks; `as_html` has everything."""
        return preformat(self.as_text())

    def as_text(self, full: bool = False, cure_text: Callable[[Cure], str] = str) -> str:
        """Return the summary in fixed-width characters, lines ending in a newline.

        Parameters
        ----------
        full
            Show all findings, parameters and notes; else one screen: verdict, effects, joints and
            the first findings.
        cure_text
            Function that writes a cure, for an interface that adds the names of its options.
        """
        if not full:
            opening = "\n".join(filter(None, (self.verdict or self.title, self.encoders)))
            return compose_screen(
                opening, self.found_effects, self.joints, self.findings, cure_text
            )
        rule = "-" * WIDTH
        parts = [wrap_text(self.verdict), ""] if self.verdict else []
        parts += [wrap_text(self.title), *_format_heading(self.heading)]
        parts += [wrap_text(text, f"{label:<14} ") for label, text in self.effects]
        parts += [wrap_text(self.encoders)] if self.encoders else []
        parts += [rule, *format_ranked_findings(self.findings, cure_text)] if self.findings else []
        parts += [rule, self.joints.as_text(full).rstrip("\n")]
        parts += [rule, self.parameters.as_text(full).rstrip("\n"), *number_notes(self.notes)]
        return "\n".join(parts) + "\n"

    @property
    def effects(self) -> tuple[tuple[str, str], ...]:
        """Where each effect is, in the model or not, with its sentence."""
        return tuple(
            ("in the model" if effect.in_model else "not in model", effect.text)
            for effect in self.found_effects
        )

    def as_html(self) -> str:
        """Return a fragment: heading, findings, both tables and the notes, every text escaped."""
        pairs = "".join(
            f"<dt>{html.escape(label)}</dt><dd>{html.escape(text)}</dd>"
            for label, text in (*self.heading, *self.effects)
        )
        findings, notes = (
            "".join(f"<li>{html.escape(text)}</li>" for text in texts)
            for texts in ((finding.text for finding in self.findings), self.notes)
        )
        verdict = f'<p class="verdict"><strong>{html.escape(self.verdict)}</strong></p>\n'
        return (
            f'<section class="summary">{verdict if self.verdict else ""}'
            f"<h2>{html.escape(self.title)}</h2>\n<dl>{pairs}</dl>\n"
            f'<ul class="findings">{findings}</ul>\n{self.joints.as_html("joints")}\n'
            f'{self.parameters.as_html("parameters")}\n<ol class="notes">{notes}</ol></section>\n'
        )

    def with_mass(self, total: FeasibleInterval, links: Sequence[FeasibleInterval] = ()) -> Summary:
        """Return the summary with masses: of all links together, and of each of `links`."""
        of_links = "; ".join(
            f"{link.quantity.partition(':')[2]} {_format_mass(link)}" for link in links
        )
        more = (("each link [kg]", of_links),) if len(links) > 1 else ()
        whole = ("mass of links", _format_mass(total, " kg"))
        return replace(self, heading=(*self.heading, whole, *more))

    def as_csv(self) -> str:
        """Return the table of parameters as CSV, numbers in full."""
        return self.parameters.as_csv()


def summarise(
    result: IdentificationResult,
    *,
    findings: Sequence[Finding] | None = None,
    verdict: str = "",
) -> Summary:
    """Summarise a result.

    Parameters
    ----------
    result
        The result.
    findings
        Findings of the study; None: findings of the result.
    verdict
        The verdict of the study.
    """
    shown = rank_findings(result.findings if findings is None else findings)
    n_drive = int(np.sum(result.base.columns >= 10 * result.model.n_links))
    drives = f" + {n_drive} drive" if n_drive else ""
    return Summary(
        title=(
            f"{result.robot} - {method_title(result.method)},"
            f" {result.n_base - n_drive} base{drives} parameters"
        ),
        heading=_build_heading(result),
        findings=shown,
        parameters=_build_parameter_table(result),
        joints=_build_joint_table(result),
        notes=(
            result.errors_sentence,
            determination(result, motions=False).in_short,
            *result.notes,
        ),
        verdict=verdict,
        found_effects=result.effects,
        encoders=describe_encoders(result.encoders),
    )


def _format_mass(mass: FeasibleInterval, unit: str = "") -> str:
    """Return the interval of a mass, what was chosen in it, and CAD."""
    cad = round_significant(mass.cad)
    # Values that no body has are no choice.
    chosen = "" if mass.chosen is None else f", chosen {round_significant(mass.chosen)}{unit}"
    return f"{mass.text.replace(' kg', unit)}{chosen} (CAD {cad}{unit})"


def format_ranked_findings(
    findings: Sequence[Finding], cure_text: Callable[[Cure], str] = str
) -> list[str]:
    """Return ranked findings, whole, as lines of 80 columns."""
    return [
        wrap_text(finding.advised(cure_text), f"{finding.severity.upper():<7}  ")
        for finding in findings
    ]


def _build_heading(result: IdentificationResult) -> tuple[tuple[str, str], ...]:
    held_out = [format_share(metrics.relative_error) for metrics in result.validation]
    negative = ", ".join(non_passive_drives(result.base, result.estimates))
    inconsistent = f"NEGATIVE {negative}" if negative else "PHYSICALLY INCONSISTENT"
    late = ", ".join(dict.fromkeys(each.text for each in result.delay if each.delays))
    absurd = len(explain_implausible_links(result.model))
    consistent = f"OK, {absurd} links of CAD IMPLAUSIBLE" if absurd else "OK"
    condition = (
        f"{round_significant(result.condition_number)} (scaled"
        f" {round_significant(result.scaled_condition_number)})"
        if np.isfinite(result.condition_number)
        else "infinite"
    )
    return (
        ("samples", f"{result.n_samples} x {result.model.n_joints} joints"),
        ("condition number", condition),
        ("rank", f"{result.rank} of {result.n_base}"),
        (
            "relative error",
            format_share(result.train.relative_error)
            + (f" (held out {', '.join(held_out)})" if held_out else ""),
        ),
        (
            "consistency",
            {True: consistent, False: inconsistent, None: "not checked"}[
                result.physically_consistent
            ],
        ),
        *([("torque delay", late)] if late else []),
    )


def _format_heading(heading: Sequence[tuple[str, str]]) -> list[str]:
    """Return the pairs in two columns, a pair that does not fit on a line of its own."""
    lines: list[str] = []
    width = max((len(text) for _, text in heading[::2] if len(text) < WIDTH // 4), default=0) + 2
    open_line = ""
    for label, text in heading:
        right = f"{label:<18}{text}"
        if open_line and len(open_line) + len(right) <= WIDTH:
            lines[-1] = open_line + right
            open_line = ""
        else:
            lines.append(wrap_text(text, f"{label:<14} "))
            open_line = f"{label:<14} {text:<{width}}"
            open_line = open_line if len(open_line) < WIDTH // 2 + 2 else ""
    return [line.rstrip() for line in lines]


def _build_parameter_table(result: IdentificationResult) -> Table:
    columns = (
        Column("id", align="right"),
        Column("parameter", width=EXPRESSION_WIDTH),
        Column("unit"),
        Column("CAD", align="decimal"),
        Column("as built", align="decimal"),
        Column("std err", align="decimal"),
        Column("%", align="right"),
        Column("CAD vs built"),
    )
    rows = tuple(_build_parameter_row(parameter) for parameter in result.parameters)
    return Table(columns, rows, important=_select_important(result))


def _select_important(result: IdentificationResult) -> tuple[int, ...]:
    """Return the places of the parameters that differ most from CAD, or from zero without CAD.

    The difference in standard errors is the torque that no other parameter can make up for, in
    units of the noise.
    """
    cad = np.nan_to_num(result.cad_values, nan=0.0)
    error = result.std_errors
    sigmas = np.divide(
        np.abs(result.estimates - cad), error, out=np.zeros_like(error), where=error > 0
    )
    most = np.argsort(-np.nan_to_num(sigmas), kind="stable")[:MOST_PARAMETERS]
    return tuple(sorted(most.tolist()))


def _build_parameter_row(parameter: IdentifiedParameter) -> tuple[Cell, ...]:
    estimate, error, percentage = format_estimate(parameter.estimate, parameter.std_error)
    sigmas = parameter.difference_in_sigmas
    outcome = format_deviation(sigmas) if parameter.determined else "UNDETERMINED"
    return (
        parameter.id,
        parameter.expression,
        parameter.unit,
        Shown(
            parameter.cad,
            round_beside(parameter.cad, parameter.std_error) if parameter.cad else "0",
        ),
        estimate,
        Shown(parameter.std_error, DROPPED) if parameter.dropped else error,
        percentage,
        Shown(sigmas, DROPPED if parameter.dropped else outcome),
    )


def _build_joint_table(result: IdentificationResult) -> Table:
    """Return RMS torque errors of the data fitted and held out, and of CAD."""
    kinds = [joint.torque_unit for joint in result.model.joints]
    mixed = len(set(kinds)) > 1
    unit = "" if mixed else kinds[0]
    # The recording on which CAD is measured, which the verdict goes by, comes first.
    held_out = sorted(result.validation, key=lambda each: each.source != result.cad.source)
    shown = held_out[0] if held_out else result.train
    errors = {
        "training": result.train,
        **{f"as built {i}" if i > 1 else AS_BUILT: e for i, e in enumerate(held_out, 1)},
        "CAD": result.cad,
    }
    first = AS_BUILT if result.validation else "training"
    columns = (
        Column("joint", width=30),
        *([Column("unit")] if mixed else []),
        *(Column(name, unit, "decimal", 3, None, name not in (first, "CAD")) for name in errors),
        Column("of torque", "%", "decimal", ".1f"),
        Column("R2", "", "decimal", ".4f", detail=True),
    )
    rows = (
        (
            name,
            *([kinds[k]] if mixed else []),
            *(error.rms[k] for error in errors.values()),
            100.0 * shown.relative_error_per_joint[k],
            result.train.r_squared[k],
        )
        for k, name in enumerate(result.joint_names)
    )
    whole, _, rule = shown.source.partition(", held out ")
    held = ", left out" if rule == RECORDINGS else ", held out" if rule else ""
    source = f"{PurePath(whole).name}{held}"
    return Table(columns, tuple(rows), title=f"RMS torque error on {source}")
