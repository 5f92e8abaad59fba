"""What a change of all parameters together does to the torque of each joint, and whether errors
alone would do as much.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from asbuilt.errors import ResultError
from asbuilt.tables import Cell, Column, Shown, Table, significant
from asbuilt.validation.comparison.significance import holm, probability_text, size_probability
from asbuilt.validation.prediction import torque_units

if TYPE_CHECKING:
    from asbuilt.identification.result.result import IdentificationResult

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class JointChange:
    """What all changes together do to the torque of one joint, on the motion that the later result
    was judged by, RMS [N m or N].

    `torque` is the change, `by_chance` what the errors of both results alone would make,
    `torque_of_motion` the torque itself, `p_value` the probability of a change of the torque's size
    by chance, and `holm` the same allowing for the number of joints. It does not matter here which
    parameters trade off with each other.
    """

    joint: str
    unit: str
    torque: float
    by_chance: float
    torque_of_motion: float
    p_value: float
    holm: float


def joint_changes(
    result: IdentificationResult, names: Sequence[str], difference: Array, covariance: Array
) -> tuple[JointChange, ...]:
    """Return what differences of named parameters, of that covariance, do to the torque of every
    joint on the motion that a result was judged by.

    Raises ResultError where the result carries no cause data.
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
        size_probability(row[:, :-1] @ difference, spread)
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
    """Say at which joints the torque changed beyond doubt."""
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
            f" {changed}{': ' + ', '.join(said) if said else ' at no joint beyond doubt'}."
        ),
    )


def joint_table(joints: Sequence[JointChange], level: float, *, of_models: bool = False) -> Table:
    """Return what all changes together do to the torque of each joint.

    Those at most as likely as `level` by chance have changed.
    """
    change = "difference" if of_models else "change"
    heads = (
        Column("joint", width=20),
        Column("unit"),
        *(Column(name, align="decimal") for name in ("torque", change, "by chance")),
        Column("p", align="right"),
        Column("", align="left"),
    )
    rows: list[tuple[Cell, ...]] = []
    for each in joints:
        rms = (
            Shown(value, significant(value))
            for value in (each.torque_of_motion, each.torque, each.by_chance)
        )
        rows.append(
            (
                each.joint,
                each.unit,
                *rms,
                Shown(each.holm, probability_text(each.holm)),
                ("DIFFERS" if of_models else "CHANGED") if each.holm <= level else "-",
            )
        )
    note = (
        f"RMS on the motion the {'second' if of_models else 'later'} result was judged by."
        f" {change}: how far the two results predict differently there; by chance: how far their"
        " errors alone would let them; p allows for the number of joints (Holm). What neither"
        " model has, such as a tilt or other friction, can read as change where the motions"
        " differ."
    )
    return Table(heads, tuple(rows), title=f"Torque that the {change}s make", notes=(note,))
