"""One base parameter by design and as built, and the table of all."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from dataclasses import fields as dataclass_fields
from typing import Any, Literal

import numpy as np

from asbuilt.identification.result.summary import DROPPED, EXPRESSION_WIDTH, MOST_PARAMETERS
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
from asbuilt.validation.comparison.torque_change import MATTERS

Verdict = Literal["differs", "agrees", "no CAD value", "not determined", "dropped"]


@dataclass(frozen=True, slots=True)
class ComparedParameter:
    """Hold one base parameter by design and as built; what is unknown is None.

    | attribute | meaning |
    |---|---|
    | `sigmas` | difference in standard errors |
    | `p_value` | probability of as large a difference by chance (Student) |
    | `degrees_of_freedom` | of the standard error; None: many |
    | `false_discovery`, `holm` | the same for as many tests (Benjamini and Hochberg; Holm) |
    | `torque` | RMS torque of the difference at every joint, on the validation motion |
    | `torque_total` | the same over all joints |
    | `torque_own` | part of it that no other parameter can make up for |
    | `matters` | whether that part is large beside the error of some joint |
    | `shared_with` | parameters that could make up for the rest, if only all of it is large |
    | `words` | description of the parameter |
    """

    id: int
    name: str
    expression: str
    unit: str
    cad: float | None
    estimate: float
    std_error: float | None
    sigmas: float | None
    verdict: Verdict
    p_value: float | None = None
    false_discovery: float | None = None
    holm: float | None = None
    torque: tuple[float, ...] | None = None
    torque_total: float | None = None
    torque_own: float | None = None
    matters: bool | None = None
    words: str = ""
    shared_with: tuple[str, ...] = ()
    degrees_of_freedom: float | None = None

    @property
    def interval(self) -> tuple[float, float] | None:
        """The 95 % interval of the value as built."""
        return (
            None
            if self.std_error is None
            else (self.estimate - 1.96 * self.std_error, self.estimate + 1.96 * self.std_error)
        )

    def as_dict(self) -> dict[str, Any]:
        """Return plain numbers and texts, ready for JSON."""
        fields: dict[str, Any] = {f.name: getattr(self, f.name) for f in dataclass_fields(self)}
        return fields | {
            "interval": None if self.interval is None else list(self.interval),
            "torque": None if self.torque is None else list(self.torque),
            "shared_with": list(self.shared_with),
        }


def parameter_table(
    parameters: Sequence[ComparedParameter],
    *,
    level: float,
    errors: str = "",
    units: Sequence[str] = (),
) -> Table:
    """Return the table of compared parameters; its short text has the ten that matter most."""
    with_torque = any(parameter.torque_total is not None for parameter in parameters)
    heads = [
        Column("id", align="right"),
        Column("parameter", width=EXPRESSION_WIDTH),
        Column("description", detail=True),
        Column("unit"),
        Column("CAD", align="decimal"),
        Column("as built", align="decimal"),
        Column("std err", align="decimal"),
        Column("%", align="decimal", detail=True),
        Column("vs CAD", align="right"),
    ]
    if with_torque:
        unit = "N m" if set(units) <= {"N m"} else "N m, N"
        heads += [
            Column("torque", unit, "decimal"),
            Column("its own", align="right", detail=True),
            Column("joint", align="right", detail=True),
            Column("matters", detail=True),
        ]
    rows = []
    for parameter in parameters:
        shown, error = rounded(parameter.estimate, parameter.std_error)
        cad = (
            None
            if parameter.cad is None
            else Shown(parameter.cad, beside(parameter.cad, parameter.std_error))
        )
        outcome = _outcome(parameter)
        relative = None
        if parameter.std_error is not None and parameter.estimate:
            relative = 100.0 * abs(parameter.std_error / parameter.estimate)
        row: list[Cell] = [
            parameter.id,
            parameter.expression,
            parameter.words,
            parameter.unit,
            cad,
            Shown(parameter.estimate, shown),
            Shown(parameter.std_error, DROPPED if parameter.verdict == "dropped" else error),
            Shown(relative, percent(parameter.estimate, parameter.std_error)),
            Shown(parameter.sigmas, outcome) if parameter.sigmas is not None else outcome,
        ]
        if with_torque:
            row += _torque_cells(parameter)
        rows.append(tuple(row))
    rule = (
        f"DIFFERS: false discovery rate of {share(level, 0)} over all parameters (Benjamini and"
        " Hochberg)."
    )
    details = [errors] if errors else []
    if with_torque:
        details.append(
            "torque: RMS over all joints of the torque of the difference on the validation motion;"
            " its own: the part that no other parameter can make up for; joint: the one with the"
            " largest. A difference matters if its own part is at least"
            f" {share(MATTERS, 0)} of a joint's error as built. Shared: only the whole is, and the"
            " parameters named could make up for the rest."
        )
    return Table(
        tuple(heads),
        tuple(rows),
        title="Base parameters",
        notes=(rule,),
        details=tuple(details),
        important=_important(parameters),
    )


def _important(parameters: Sequence[ComparedParameter]) -> tuple[int, ...]:
    """Return the places of the parameters that differ most: by their own torque, or by sigmas."""
    most = sorted(
        range(len(parameters)),
        key=lambda k: (
            parameters[k].verdict != "differs",
            -(parameters[k].torque_own or 0.0),
            -abs(parameters[k].sigmas or 0.0),
        ),
    )
    return tuple(most[:MOST_PARAMETERS])


def _torque_cells(parameter: ComparedParameter) -> list[Cell]:
    if parameter.torque is None or parameter.torque_total is None or parameter.torque_own is None:
        return [None, None, "", ""]
    own = parameter.torque_own / parameter.torque_total if parameter.torque_total else None
    felt = f"{1 + int(np.argmax(parameter.torque))}" if parameter.torque_total else ""
    return [
        Shown(parameter.torque_total, significant(parameter.torque_total)),
        Shown(own, share(own, 0)),
        felt,
        matters_text(parameter.matters, parameter.shared_with),
    ]


def _outcome(parameter: ComparedParameter) -> str:
    if parameter.verdict == "differs":
        return "DIFFERS"
    return (
        deviation(parameter.sigmas, np.inf) if parameter.verdict == "agrees" else parameter.verdict
    )


def matters_text(matters: bool | None, shared_with: Sequence[str]) -> str:
    """Return whether a difference matters: yes, no, shared with others, or nothing if unknown."""
    if matters is None:
        return ""
    return "yes" if matters else f"shared with {', '.join(shared_with)}" if shared_with else "no"
