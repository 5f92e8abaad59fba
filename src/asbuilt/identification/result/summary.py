"""An identification on one screen.

Verdict first, then every parameter beside its CAD value, then every joint.
"""

from __future__ import annotations

import html
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from asbuilt.identification.bodies.consistency import non_passive_drives
from asbuilt.identification.estimators.methods import method_title
from asbuilt.identification.result.determination import determination
from asbuilt.tables import (
    Cell,
    Column,
    Shown,
    Table,
    beside,
    deviation,
    percent,
    rounded,
    share,
    significant,
)

if TYPE_CHECKING:
    from asbuilt.identification.result.result import IdentificationResult, IdentifiedParameter

EXPRESSION_WIDTH = 34
DROPPED = "dropped"
"""What stands for the error of a parameter that was set to zero as needless."""


@dataclass(frozen=True, slots=True)
class Summary:
    """Hold the heading (pairs of label and text), the table of parameters, the table of joints and
    the numbered notes.

    The text holds no date, no colour and no terminal width: the same result always reads the same.
    """

    title: str
    heading: tuple[tuple[str, str], ...]
    parameters: Table
    joints: Table
    notes: tuple[str, ...]

    def __str__(self) -> str:
        return self.as_text()

    def as_text(self) -> str:
        """Return the summary in fixed-width characters, lines ending in a newline."""
        left, right = self.heading[::2], self.heading[1::2]
        width = max(len(text) for _, text in left) + 4
        lines = [self.title]
        for (label, text), (second, other) in zip(left, right, strict=True):
            lines.append(f"{label:<13}{text:<{width}}{second:<19}{other}".rstrip())
        body, joints = self.parameters.as_text().splitlines(), self.joints.as_text().splitlines()
        rule = "-" * max(len(line) for line in body + lines)
        lines += [
            rule,
            body[0],
            *[line for line in body[1:] if not line.startswith("---")],
            rule,
            *joints,
        ]
        lines += [f"[{number}] {note}" for number, note in enumerate(self.notes, start=1)]
        return "\n".join(lines) + "\n"

    def as_html(self) -> str:
        """Return a fragment: heading, both tables and the notes; every text is escaped."""
        pairs = "".join(
            f"<dt>{html.escape(label)}</dt><dd>{html.escape(text)}</dd>"
            for label, text in self.heading
        )
        notes = "".join(f"<li>{html.escape(note)}</li>" for note in self.notes)
        tables = self.parameters.as_html("parameters") + "\n" + self.joints.as_html("joints")
        return (
            "<section"
            f' class="summary"><h2>{html.escape(self.title)}</h2>\n<dl>{pairs}</dl>\n{tables}\n<ol'
            f' class="notes">{notes}</ol></section>\n'
        )

    def as_csv(self) -> str:
        """Return the table of parameters as CSV, numbers in full."""
        return self.parameters.as_csv()


def summarise(result: IdentificationResult) -> Summary:
    """Return the summary of a result."""
    n_drive = int(np.sum(result.base.columns >= 10 * result.model.n_joints))
    method = method_title(result.method)
    drives = f" + {n_drive} drive" if n_drive else ""
    held_out = (
        f" (held out {', '.join(share(metrics.relative_error) for metrics in result.validation)})"
        if result.validation
        else ""
    )
    non_passive = ", ".join(non_passive_drives(result.base, result.estimates))
    impossible = f"{non_passive} BELOW ZERO" if non_passive else "IMPOSSIBLE FOR REAL BODIES"
    consistency = {True: "OK", False: impossible, None: "not decided"}[result.physically_consistent]
    condition = (
        f"{significant(result.condition_number)} (scaled"
        f" {significant(result.scaled_condition_number)})"
        if np.isfinite(result.condition_number)
        else "infinite"
    )
    heading = (
        ("samples", f"{result.n_samples} x {result.model.n_joints} joints"),
        ("condition number", condition),
        ("rank", f"{result.rank} of {result.n_base}"),
        ("relative error", share(result.train.relative_error) + held_out),
        ("consistency", consistency),
        ("status", _status(result)),
    )
    return Summary(
        title=f"{result.robot} - {method}, {result.n_base - n_drive} base{drives} parameters",
        heading=heading,
        parameters=_parameter_table(result),
        joints=_joint_table(result),
        notes=_notes(result),
    )


def _status(result: IdentificationResult) -> str:
    verdicts = []
    if result.undetermined:
        verdicts.append(_counted(len(result.undetermined), "DIRECTION", "NOT EXCITED"))
    poor = sum(parameter.poorly_determined for parameter in result.parameters)
    if poor:
        verdicts.append(_counted(poor, "PARAMETER", "POORLY DETERMINED"))
    if not verdicts and result.warnings:
        verdicts.append(_counted(len(result.warnings), "WARNING", "").strip())
    return ", ".join(verdicts) or "OK"


def _counted(count: int, noun: str, verdict: str) -> str:
    return f"{count} {noun}{'' if count == 1 else 'S'} {verdict}"


def _parameter_table(result: IdentificationResult) -> Table:
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
    return Table(columns, tuple(_parameter_row(parameter) for parameter in result.parameters))


def _parameter_row(parameter: IdentifiedParameter) -> tuple[Cell, ...]:
    estimate, error = rounded(parameter.estimate, parameter.std_error)
    sigmas = parameter.difference_in_sigmas
    if parameter.dropped:
        error = DROPPED
    return (
        parameter.id,
        parameter.expression,
        parameter.unit,
        Shown(parameter.cad, beside(parameter.cad, parameter.std_error) if parameter.cad else "0"),
        Shown(parameter.estimate, estimate),
        Shown(parameter.std_error, error),
        Shown(100.0 * parameter.relative_error, percent(parameter.estimate, parameter.std_error)),
        Shown(
            sigmas,
            (
                DROPPED
                if parameter.dropped
                else deviation(sigmas)
                if parameter.determined
                else "NOT EXCITED"
            ),
        ),
    )


def _joint_table(result: IdentificationResult) -> Table:
    held_out = [
        Column(
            f"RMS held out {i}" if len(result.validation) > 1 else "RMS held out", align="decimal"
        )
        for i in range(1, len(result.validation) + 1)
    ]
    cad = "RMS CAD" if result.cad.source == result.train.source else "RMS CAD held out"
    columns = (
        Column("joint"),
        Column("RMS", align="decimal"),
        *held_out,
        Column(cad, align="decimal"),
        Column("R2", align="decimal", style=".4f"),
    )
    rows: list[tuple[Cell, ...]] = []
    for k, name in enumerate(result.joint_names):
        errors = [
            result.train.rms[k],
            *[metrics.rms[k] for metrics in result.validation],
            result.cad.rms[k],
        ]
        rows.append(
            (
                name,
                *[Shown(float(error), significant(float(error))) for error in errors],
                float(result.train.r_squared[k]),
            )
        )
    return Table(columns, tuple(rows))


def _notes(result: IdentificationResult) -> tuple[str, ...]:
    return (
        *result.notes,
        result.errors_sentence,
        determination(result, motions=False).in_short,
        *[warning.message for warning in result.warnings],
    )
