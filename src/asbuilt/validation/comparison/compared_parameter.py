"""One base parameter by design and as built, and the table of all."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import numpy as np

from asbuilt.codec import make_plain
from asbuilt.identification.result.summary import DROPPED, EXPRESSION_WIDTH, MOST_PARAMETERS
from asbuilt.tables import (
    Cell,
    Column,
    Shown,
    Table,
    format_deviation,
    format_estimate,
    format_share,
    round_beside,
)
from asbuilt.validation.comparison.significance import RESOLUTION
from asbuilt.validation.comparison.torque_change import MATTERS

Verdict = Literal["differs", "agrees", "no CAD value", "not determined", "dropped"]


@dataclass(frozen=True, slots=True, kw_only=True)
class ParameterTest:
    """Hold one base parameter and the test of a difference; what is unknown is None.

    | attribute | meaning |
    |---|---|
    | `words` | description of the parameter |
    | `sigmas` | difference in standard errors |
    | `p_value` | probability of as large a difference by chance (Student) |
    | `false_discovery`, `holm` | the same for as many tests (Benjamini and Hochberg; Holm) |
    | `torque_total` | RMS torque of the difference over all joints, on the validation motion |
    | `matters` | whether the part that is its own is large compared with some joint's error |
    | `shared_with` | parameters that could make up for the rest, if only all of it is large |
    """

    id: int
    name: str
    expression: str
    unit: str
    words: str = ""
    sigmas: float | None
    p_value: float | None = None
    false_discovery: float | None = None
    holm: float | None = None
    torque_total: float | None = None
    matters: bool | None = None
    shared_with: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class ComparedParameter(ParameterTest):
    """Hold one base parameter by design and as built; what is unknown is None.

    | attribute | meaning |
    |---|---|
    | `degrees_of_freedom` | of the standard error; None: many |
    | `torque` | RMS torque of the difference at every joint, on the validation motion |
    | `torque_own` | part of `torque_total` that no other parameter can make up for |
    """

    cad: float | None
    estimate: float
    std_error: float | None
    verdict: Verdict
    torque: tuple[float, ...] | None = None
    torque_own: float | None = None
    degrees_of_freedom: float | None = None

    @property
    def interval(self) -> tuple[float, float] | None:
        """The 95 % interval of the value as built."""
        if self.std_error is None:
            return None
        return self.estimate - 1.96 * self.std_error, self.estimate + 1.96 * self.std_error

    def as_dict(self) -> dict[str, Any]:
        """Return plain numbers and texts, ready for JSON."""
        return dict(make_plain(self)) | {"interval": make_plain(self.interval)}


def _show_std_error(parameter: ComparedParameter) -> Cell:
    if parameter.verdict == "dropped":
        return Shown(parameter.std_error, DROPPED)
    return format_estimate(parameter.estimate, parameter.std_error)[1]


def _show_outcome(parameter: ComparedParameter) -> Cell:
    """Return the verdict, or the standard errors by which a parameter that agrees is off."""
    agreeing = format_deviation(parameter.sigmas, np.inf)
    # Agreement is said by its distance: no verdict hides a near miss.
    outcome = {"differs": "DIFFERS", "agrees": agreeing}.get(parameter.verdict, parameter.verdict)
    return outcome if parameter.sigmas is None else Shown(parameter.sigmas, outcome)


COLUMNS = (
    Column("id", align="right", of="id"),
    Column("parameter", width=EXPRESSION_WIDTH, of="expression"),
    Column("description", detail=True, of="words"),
    Column("unit", of="unit"),
    Column(
        "CAD",
        align="decimal",
        of=lambda p: None if p.cad is None else Shown(p.cad, round_beside(p.cad, p.std_error)),
    ),
    Column("as built", align="decimal", of=lambda p: format_estimate(p.estimate, p.std_error)[0]),
    Column("std err", align="decimal", of=_show_std_error),
    Column(
        "%", align="decimal", detail=True, of=lambda p: format_estimate(p.estimate, p.std_error)[2]
    ),
    Column("vs CAD", align="right", of=_show_outcome),
)
TORQUE_COLUMNS = (
    Column(
        "its own",
        "",
        "right",
        partial(format_share, digits=0),
        detail=True,
        # A change without torque has no part of its own.
        of=lambda p: p.torque_own / p.torque_total if p.torque_total else None,
    ),
    Column(
        "joint",
        align="right",
        detail=True,
        of=lambda p: f"{1 + int(np.argmax(p.torque))}" if p.torque_total else "",
    ),
    Column("matters", detail=True, of=lambda p: describe_relevance(p.matters, p.shared_with)),
)
"""Further columns where the torque of differences is known."""


def tabulate_parameters(
    parameters: Sequence[ComparedParameter],
    *,
    level: float,
    errors: str = "",
    units: Sequence[str] = (),
) -> Table:
    """Return the table of compared parameters; its short text has the ten that matter most."""
    columns: tuple[Column, ...] = COLUMNS
    details = [errors] if errors else []
    if any(parameter.torque_total is not None for parameter in parameters):
        unit = "N m" if set(units) <= {"N m"} else "N m, N"
        torque = Column("torque", unit, "decimal", 3, of="torque_total")
        columns = (*COLUMNS, torque, *TORQUE_COLUMNS)
        details.append(
            "torque: RMS over all joints of the torque of the difference on the validation motion;"
            " its own: the part that no other parameter can make up for; joint: the one with the"
            " largest. A difference matters if its own part is at least"
            f" {format_share(MATTERS, 0)} of a joint's error as built. Shared: only the whole is,"
            " and the"
            " parameters named could make up for the rest."
        )
    rule = (
        f"DIFFERS: off by more than {format_share(RESOLUTION, 0)} of CAD's value, at a false"
        f" discovery rate of {format_share(level, 0)} over all parameters."
    )
    # Those that differ most are important: by their own torque, or by standard errors.
    most = sorted(
        range(len(parameters)),
        key=lambda k: (
            parameters[k].verdict != "differs",
            -(parameters[k].torque_own or 0.0),
            -abs(parameters[k].sigmas or 0.0),
        ),
    )
    return Table.of(
        parameters,
        columns,
        "Base parameters",
        notes=(rule,),
        details=tuple(details),
        important=tuple(most[:MOST_PARAMETERS]),
    )


def describe_relevance(matters: bool | None, shared_with: Sequence[str]) -> str:
    """Return whether a difference matters: yes, no, shared with others, or nothing if unknown."""
    if matters is None:
        return ""
    return "yes" if matters else f"shared with {', '.join(shared_with)}" if shared_with else "no"
