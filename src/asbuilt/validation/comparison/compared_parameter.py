"""One base parameter by design and as built.

Whether it differs, what that costs in torque, and the table of all.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from dataclasses import fields as dataclass_fields
from typing import Any, Literal

import numpy as np

from asbuilt.identification.result.summary import DROPPED
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
from asbuilt.validation.comparison.torque_cost import MATTERS

Verdict = Literal["differs", "agrees", "no CAD value", "not determined", "dropped"]


@dataclass(frozen=True, slots=True)
class ComparedParameter:
    """One base parameter by design and as built.

    `sigmas` is their difference in standard errors, None where it has no meaning.

    `words` say what the parameter is. `p_value` is of that difference alone; `false_discovery`
    (Benjamini and Hochberg) and `holm` allow for the number of tests. `torque` is what the
    difference costs every joint on the motion judged by, RMS, `torque_total` all joints together,
    `torque_own` the part that no other parameter could make up for; None without cause data.
    `matters` says whether some joint would notice that part; where it would notice only the whole,
    `shared_with` names the parameters that could make up for the rest, which the recording hardly
    tells apart. `"dropped"` is one that the estimator set to zero as needless: it has no error and
    is not tested.
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
    width: int | None = 28,
) -> Table:
    """Return the table of compared parameters, with how their `errors` were judged below.

    Text cuts expressions at `width` characters, HTML and CSV have them whole.
    """
    with_torque = any(parameter.torque_total is not None for parameter in parameters)
    heads = [
        Column("id", align="right"),
        Column("parameter", width=width),
        Column("what it is"),
        Column("unit"),
        Column("CAD", align="decimal"),
        Column("as built", align="decimal"),
        Column("std err", align="decimal"),
        Column("%", align="decimal"),
        Column("CAD vs built", align="right"),
    ]
    if with_torque:
        unit = "N m" if set(units) <= {"N m"} else "N m, N"
        heads += [
            Column("torque", unit, "decimal"),
            Column("its own", align="right"),
            Column("joint", align="right"),
            Column("matters"),
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
    notes = [
        f"DIFFERS: at a false discovery rate of {share(level, 0)} over all parameters (Benjamini"
        f" and Hochberg).{f' {errors}' if errors else ''}"
    ]
    if with_torque:
        notes.append(
            "torque: RMS over all joints that the difference costs on the motion judged by; its"
            " own: the part of it that no other parameter could make up for; joint: the one that"
            " notices most. A difference matters where its own part costs a joint"
            f" {share(MATTERS, 0)} or more of the error left as built. Shared: only the whole costs"
            " as much, and the parameters named could make up for the rest; this recording hardly"
            " tells them apart."
        )
    return Table(tuple(heads), tuple(rows), title="Base parameters", notes=tuple(notes))


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
    """Return what a table says of whether a difference matters.

    Yes, no, shared with others, or nothing where that is unknown.
    """
    if matters is None:
        return ""
    return "yes" if matters else f"shared with {', '.join(shared_with)}" if shared_with else "no"
