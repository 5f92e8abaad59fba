"""One base parameter by design and as built: its text, its difference, and the table of all."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal, TypeVar

import numpy as np

from asbuilt.arrays import Array
from asbuilt.codec import make_plain
from asbuilt.description.inertia import PARAMETER_NAMES
from asbuilt.dynamics import BaseParameters, DriveSet, DriveTerm
from asbuilt.identification.result.result import IdentificationResult
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
from asbuilt.validation.comparison.torque_change import MATTERS, evaluate_torque_cost
from asbuilt.validation.prediction import name_torque_unit

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
    | `torque` | RMS torque of the difference at every joint, on the validation motion |
    | `torque_total` | the same over all joints |
    | `torque_own` | part of it that no other parameter can make up for |
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
    torque: tuple[float, ...] | None = None
    torque_total: float | None = None
    torque_own: float | None = None
    matters: bool | None = None
    shared_with: tuple[str, ...] = ()

    @property
    def felt_at(self) -> int | None:
        """The joint, from 1, with most of the torque of the difference; None without any."""
        return 1 + int(np.argmax(self.torque)) if self.torque and any(self.torque) else None


Tested = TypeVar("Tested", bound=ParameterTest)


@dataclass(frozen=True, slots=True, kw_only=True)
class ComparedParameter(ParameterTest):
    """Hold one base parameter by design and as built; what is unknown is None.

    | attribute | meaning |
    |---|---|
    | `degrees_of_freedom` | of the standard error; None: many |
    """

    cad: float | None
    estimate: float
    std_error: float | None
    verdict: Verdict
    degrees_of_freedom: float | None = None

    @property
    def interval(self) -> tuple[float, float] | None:
        """The 95 % interval of the value as built."""
        if self.std_error is None:
            return None
        return self.estimate - 1.96 * self.std_error, self.estimate + 1.96 * self.std_error

    @property
    def outcome(self) -> str:
        """The verdict, or the standard errors by which a parameter that agrees is off."""
        # Agreement is said by its distance: no verdict hides a near miss.
        shown = {"differs": "DIFFERS", "agrees": format_deviation(self.sigmas, np.inf)}
        return shown.get(self.verdict, self.verdict)

    def as_dict(self) -> dict[str, Any]:
        """Return plain numbers and texts, ready for JSON."""
        return dict(make_plain(self)) | {"interval": make_plain(self.interval)}


TESTS = ("sigmas", "p_value", "false_discovery", "holm")
"""Fields of a parameter in the order of `compare_each`."""


def list_tests(
    result: IdentificationResult, places: Sequence[int], difference: Array, tests: Array
) -> list[dict[str, Any]]:
    """Return the fields of `ParameterTest` of differences (m,) at places of a result's parameters.

    `tests` (4, m) are those of `compare_each`. The torque of a difference, on the validation motion
    of the result, is unknown without cause data, or if the difference is (NaN).
    """
    base = result.base
    texts = describe_parameters(base)
    fields: list[dict[str, Any]] = [
        {
            "id": int(base.ids[j]),
            "name": base.names[j],
            "expression": base.expressions[j],
            "unit": base.units[j],
            "words": texts[j],
            **dict(zip(TESTS, make_plain(tests[:, k]), strict=True)),
        }
        for k, j in enumerate(places)
    ]
    if result.cause_data is None:
        return fields
    # Together: what one difference takes from the torque of another counts.
    whole = np.zeros(result.n_base)
    whole[list(places)] = difference
    cost = evaluate_torque_cost(result.cause_data, base, whole)
    left = result.cause_data.error_of(base.names, result.estimates)
    alone = cost.noticed(left, alone=True)
    for k in np.flatnonzero(np.isfinite(difference)).tolist():
        j = places[k]
        fields[k] |= {
            "torque": tuple(cost.torque[j].tolist()),
            "torque_total": float(cost.total[j]),
            "torque_own": float(cost.own[j]),
            "matters": bool(alone[j]),
            "shared_with": cost.shared_with(j, left, base.names),
        }
    return fields


def _show_std_error(parameter: ComparedParameter) -> Cell:
    if parameter.verdict == "dropped":
        return Shown(parameter.std_error, DROPPED)
    return format_estimate(parameter.estimate, parameter.std_error)[1]


NAMES = (
    Column("id", align="right", of="id"),
    Column("parameter", width=EXPRESSION_WIDTH, of="expression"),
    Column("description", detail=True, of="words"),
    Column("unit", of="unit"),
)
"""Columns that say which parameter a row is of."""
FELT_AT = Column("joint", align="right", detail=True, of=lambda p: p.felt_at or "")
RELEVANCE = Column(
    "matters", detail=True, of=lambda p: describe_relevance(p.matters, p.shared_with)
)
COLUMNS = (
    *NAMES,
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
    Column(
        "vs CAD",
        align="right",
        of=lambda p: p.outcome if p.sigmas is None else Shown(p.sigmas, p.outcome),
    ),
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
    FELT_AT,
    RELEVANCE,
)
"""Further columns where the torque of differences is known."""


def tabulate_parameters(
    parameters: Sequence[ComparedParameter],
    *,
    level: float,
    errors: str,
    units: Sequence[str],
) -> Table:
    """Return the table of compared parameters; its short text has the ten that matter most."""
    columns: tuple[Column, ...] = COLUMNS
    details = [errors] if errors else []
    if any(parameter.torque_total is not None for parameter in parameters):
        columns = (*COLUMNS, make_torque_column(units), *TORQUE_COLUMNS)
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


def make_torque_column(units: Sequence[str]) -> Column:
    """Return the column of the torque of differences, for joints with these torque units."""
    return Column("torque", name_torque_unit(units), "decimal", 3, of="torque_total")


def rank_by_torque(parameters: Sequence[Tested]) -> tuple[Tested, ...]:
    """Return parameters, those whose difference has the most torque first."""
    return tuple(sorted(parameters, key=lambda p: (-(p.torque_total or 0.0), p.id)))


def describe_relevance(matters: bool | None, shared_with: Sequence[str]) -> str:
    """Return whether a difference matters: yes, no, shared with others, or nothing if unknown."""
    if matters is None:
        return ""
    return "yes" if matters else f"shared with {', '.join(shared_with)}" if shared_with else "no"


def describe_parameters(base: BaseParameters) -> tuple[str, ...]:
    """Return what each base parameter is, named by the kept column and the last link that enters.

    >>> from asbuilt.description.load import bundled_robot
    >>> from asbuilt.dynamics.base.base_parameters import find_base_parameters
    >>> from asbuilt.dynamics.drives.drive_set import DriveSet
    >>> base = find_base_parameters(bundled_robot("kuka-iiwa7-r800"), DriveSet.parse("coulomb"))
    >>> dict(zip(base.names, describe_parameters(base)))["mz4"]
    'first moment along z, links 4 to 7'
    >>> describe_parameters(base)[-1]
    'Coulomb friction, joint 7'
    """
    inertial = len(PARAMETER_NAMES) * base.n_links
    return tuple(
        (
            _describe_link_parameter(base, row, int(column), inertial)
            if column < inertial
            else _describe_drive_parameter(base, int(column) - inertial)
        )
        for row, column in enumerate(base.columns)
    )


def describe_drive(drive: DriveSet) -> str:
    """Return the terms of a set with the joints that have them and their nonlinear parameters.

    >>> describe_drive(DriveSet.parse("viscous:joints=2/3,offset,stribeck:velocity=0.1"))
    'viscous friction (joints 2, 3); Stribeck friction (velocity 0.1); torque offset'
    >>> describe_drive(DriveSet.parse("power:joints=1/3:exponent=0.7/0.5/0.6"))
    'power-law friction (joint 1: exponent 0.7; joint 3: exponent 0.6)'
    """
    return "; ".join(_describe_term(term) for term in drive.terms) or "none"


def _describe_term(term: DriveTerm) -> str:
    stated = {
        parameter.name: getattr(term, parameter.name)
        for parameter in term.nonlinear
        if getattr(term, parameter.name) is not None
    }
    several = [len(values) for values in stated.values() if isinstance(values, tuple)]
    if several:
        inside = "; ".join(
            f"joint {number}: {_list_nonlinear(term.at(number - 1), stated)}"
            # Joints that have the term, or all of them.
            for number in term.joints or range(1, several[0] + 1)
        )
    else:
        where = (
            []
            if term.joints is None
            else [f"joint{'s' if len(term.joints) > 1 else ''} {', '.join(map(str, term.joints))}"]
        )
        inside = "; ".join([*where, *([_list_nonlinear(term, stated)] if stated else [])])
    return term.title + (f" ({inside})" if inside else "")


def _list_nonlinear(term: DriveTerm, names: Iterable[str]) -> str:
    return ", ".join(f"{name} {term.value(name):.3g}" for name in names)


def _describe_link_parameter(base: BaseParameters, row: int, column: int, inertial: int) -> str:
    per_link = len(PARAMETER_NAMES)
    link = column // per_link
    name = PARAMETER_NAMES[column % per_link]
    entries = np.flatnonzero(base.regrouping[row])
    names_here = {
        PARAMETER_NAMES[j % per_link] for j in entries if j // per_link == link and j < inertial
    }
    # The last link that enters: a base parameter is of all up to it.
    last = max(int(j) // per_link for j in entries if j < inertial)
    kind = (
        "mass"
        if name == "m"
        else f"first moment along {name[1]}"
        if name[0] == "m"
        else _name_moment(name, names_here)
    )
    where = f"link {link + 1}" if last == link else f"links {link + 1} to {last + 1}"
    return f"{kind}, {where}{' with rotors' if entries[-1] >= inertial else ''}"


def _name_moment(name: str, own: set[str]) -> str:
    if name[1] != name[2]:
        return f"product of inertia {name[1:]}"
    less = sorted(
        # Regrouping leaves differences of two moments, such as Ixx - Iyy.
        other
        for other in own
        if other != name and other[0] == "I" and other[1] == other[2]
    )
    return f"inertia about {name[1]}" + "".join(f" less {other[1]}" for other in less)


def _describe_drive_parameter(base: BaseParameters, place: int) -> str:
    joint, column = divmod(place, base.drive.columns_per_joint)
    term = [term for term in base.drive.terms for _ in term.symbols][column]
    symbol = f" {base.drive.symbols[column]}" if len(term.symbols) > 1 else ""
    return f"{term.title}{symbol}, joint {joint + 1}"
