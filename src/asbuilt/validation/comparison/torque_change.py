"""Torque of a change of all parameters at each joint, beside what standard errors explain."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from asbuilt.arrays import Array
from asbuilt.errors import ResultError
from asbuilt.identification.result.metrics import TorqueMetrics
from asbuilt.tables import Cell, Column, Shown, Table, share, significant
from asbuilt.validation.comparison.significance import holm, probability_text, size_probability
from asbuilt.validation.prediction import torque_units

if TYPE_CHECKING:
    from asbuilt.identification.result.result import IdentificationResult


@dataclass(frozen=True, slots=True)
class JointChange:
    """Hold the RMS torque of all changes together at one joint [N m or N], on a validation motion.

    `torque` is that of the change, `by_chance` what the errors of both results explain,
    `torque_of_motion` the torque itself. `p_value` is the probability of as large a change by
    chance, and `holm` the same for as many joints.
    """

    joint: str
    unit: str
    torque: float
    by_chance: float
    torque_of_motion: float
    p_value: float
    holm: float


def joint_changes(
    result: IdentificationResult,
    names: Sequence[str],
    difference: Array,
    covariance: Array,
    degrees_of_freedom: float = np.inf,
) -> tuple[JointChange, ...]:
    """Return the torque of differences of named parameters, with their covariance, at every joint.

    `degrees_of_freedom` are those of a variance.

    Raises ResultError if the result has no cause data.
    """
    cause_data = result.cause_data
    if cause_data is None:
        raise ResultError(f"the result of {result.robot} carries no cause data; identify again")
    places = cause_data.places(names)
    rows = [
        factor[:, [*places, -1]] / np.sqrt(cause_data.n_judged)
        for factor in cause_data.whole(cause_data.judged)
    ]
    spreads = [row[:, :-1] @ covariance @ row[:, :-1].T for row in rows]
    chances = [
        size_probability(row[:, :-1] @ difference, spread, degrees_of_freedom)
        for row, spread in zip(rows, spreads, strict=True)
    ]
    strict = holm(chances)
    return tuple(
        JointChange(
            joint=name,
            unit=unit,
            torque=float(np.linalg.norm(row[:, :-1] @ difference)),
            by_chance=float(np.sqrt(np.trace(spread))),
            torque_of_motion=float(np.linalg.norm(row[:, -1])),
            p_value=chance,
            holm=float(adjusted),
        )
        for name, unit, row, spread, chance, adjusted in zip(
            result.joint_names,
            torque_units(result.model),
            rows,
            spreads,
            chances,
            strict,
            strict=True,
        )
    )


def torque_sentence(
    joints: tuple[JointChange, ...], level: float, *, of_models: bool = False
) -> tuple[str, ...]:
    """Return at which joints the torque changed significantly."""
    if not joints:
        return ()
    said = [
        f"{each.joint} by {significant(each.torque)} {each.unit} RMS (by chance"
        f" {significant(each.by_chance)})"
        for each in joints
        if each.holm <= level
    ]
    changed = "differs" if of_models else "changed"
    return (
        (
            "The torque of the same motion"
            f" {changed}{': ' + ', '.join(said) if said else ' significantly at no joint'}."
        ),
    )


def joint_table(joints: Sequence[JointChange], level: float, *, of_models: bool = False) -> Table:
    """Return the torque of all changes together joint by joint, with a significance test."""
    change = "difference" if of_models else "change"
    unit = joints[0].unit if len({each.unit for each in joints}) == 1 else ""
    beyond_doubt = "DIFFERS" if of_models else "CHANGED"
    columns = (
        Column("joint", width=20, of="joint"),
        *([] if unit else [Column("unit", of="unit")]),
        Column("torque", unit, "decimal", 3, of="torque_of_motion"),
        Column(change, unit, "decimal", 3, of="torque"),
        Column("by chance", unit, "decimal", 3, of="by_chance"),
        Column("p", "", "right", probability_text, of="holm"),
        Column("verdict", of=lambda each: beyond_doubt if each.holm <= level else "-"),
    )
    note = (
        f"RMS on the validation motion of the {'second' if of_models else 'later'} result."
        f" {change}: between the predictions of the two; by chance: expected from their standard"
        " errors; p allows for the number of joints (Holm). Effects that neither model has can"
        " appear as a change if the motions differ."
    )
    return Table.of(joints, columns, f"RMS torque of the {change}s", details=(note,))


MOST_COLUMNS = 4
"""Predictions in a short text."""


def torque_error_table(
    predictions: Sequence[tuple[str, TorqueMetrics]],
    units: Sequence[str],
    title: str,
    notes: tuple[str, ...] = (),
) -> Table:
    """Return the RMS errors of named predictions joint by joint, and their relative errors.

    Parameters
    ----------
    predictions
        Heads of columns with the errors below.
    units
        Torque unit of each joint.
    title, notes
        Title and notes of the table.
    """
    unit, mixed = ("", True) if len(set(units)) > 1 else (units[0], False)
    heads = (
        Column("joint", width=24),
        *([Column("unit")] if mixed else []),
        *(
            Column(name, unit, "decimal", 3, detail=k >= MOST_COLUMNS)
            for k, (name, _) in enumerate(predictions)
        ),
    )
    rows: list[tuple[Cell, ...]] = [
        (name, *([units[k]] if mixed else []), *(float(e.rms[k]) for _, e in predictions))
        for k, name in enumerate(predictions[0][1].joint_names)
    ]
    relative = (Shown(e.relative_error, share(e.relative_error)) for _, e in predictions)
    rows.append(("relative error", *([""] if mixed else []), *relative))
    return Table(heads, tuple(rows), title=title, notes=notes)
