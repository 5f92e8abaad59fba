"""Torque of a change of all parameters at each joint, and what standard errors explain of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from asbuilt.arrays import Array, Indices, Mask
from asbuilt.dynamics.base.base_parameters import BaseParameters
from asbuilt.errors import ResultError
from asbuilt.identification import CauseData, IdentificationResult, TorqueMetrics
from asbuilt.scaled import Scaled
from asbuilt.tables import Cell, Column, Shown, Table, format_share, round_significant
from asbuilt.validation.comparison.significance import format_probability, holm, size_probability
from asbuilt.validation.prediction import torque_units


@dataclass(frozen=True, slots=True)
class JointChange:
    """Hold the RMS torque of all changes together at one joint [N m or N], on a validation motion.

    `torque` is the change's torque, `by_chance` what the errors of both results explain,
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


def derive_joint_changes(
    result: IdentificationResult,
    names: Sequence[str],
    difference: Array,
    covariance: Array,
    degrees_of_freedom: float = np.inf,
) -> tuple[JointChange, ...]:
    """Return the torque of differences of named parameters, with their covariance, at every joint.

    Each variance has `degrees_of_freedom`.

    Raises ResultError if the result has no cause data.
    """
    cause_data = result.cause_data
    if cause_data is None:
        raise ResultError(f"the result of {result.robot} carries no cause data; identify again")
    places = cause_data.places(names)
    rows = [
        factor[:, [*places, -1]] / np.sqrt(cause_data.n_judged)
        # Divided by the root of the samples, so that lengths of rows are RMS.
        for factor in cause_data.whole(cause_data.judged)
    ]
    # Errors of the parameters as torque, rotated like the rows.
    spreads = [row[:, :-1] @ covariance @ row[:, :-1].T for row in rows]
    chances = [
        size_probability(row[:, :-1] @ difference, spread, degrees_of_freedom)
        for row, spread in zip(rows, spreads, strict=True)
    ]
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
            holm(chances),
            strict=True,
        )
    )


def describe_torque_changes(
    joints: tuple[JointChange, ...], level: float, *, of_models: bool = False
) -> tuple[str, ...]:
    """Return at which joints the torque changed significantly."""
    changes = [
        f"{change.joint} by {round_significant(change.torque)} {change.unit} RMS (by chance"
        f" {round_significant(change.by_chance)})"
        for change in joints
        if change.holm <= level
    ]
    changed = "differs" if of_models else "changed"
    where = f": {', '.join(changes)}" if changes else " significantly at no joint"
    return (f"The torque of the same motion {changed}{where}.",) if joints else ()


def tabulate_joint_changes(
    joints: Sequence[JointChange], level: float, *, of_models: bool = False
) -> Table:
    """Return the torque of all changes together joint by joint, with a significance test."""
    change = "difference" if of_models else "change"
    unit = joints[0].unit if len({change.unit for change in joints}) == 1 else ""
    beyond_doubt = "DIFFERS" if of_models else "CHANGED"
    columns = (
        Column("joint", width=20, of="joint"),
        *([] if unit else [Column("unit", of="unit")]),
        Column("torque", unit, "decimal", 3, of="torque_of_motion"),
        Column(change, unit, "decimal", 3, of="torque"),
        Column("by chance", unit, "decimal", 3, of="by_chance"),
        Column("p", "", "right", format_probability, of="holm"),
        Column("verdict", of=lambda change: beyond_doubt if change.holm <= level else "-"),
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


def tabulate_named_errors(
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
    relative = (Shown(e.relative_error, format_share(e.relative_error)) for _, e in predictions)
    rows.append(("relative error", *([""] if mixed else []), *relative))
    return Table(heads, tuple(rows), title=title, notes=notes)


MATTERS = 0.5
"""Torque of a difference, relative to a joint's error as built, from which it matters: the error
would grow by an eighth; own choice."""
ABLE = 0.25
"""Smallest part of the squared torque, or of what another partner leaves, of a named partner."""
MOST_PARTNERS = 2
SEVERAL = "several others"


@dataclass(frozen=True, slots=True, eq=False)
class TorqueCost:
    r"""Hold RMS torques of p differences at n joints on the validation motion.

    | attribute | meaning |
    |---|---|
    | `torque` | (p, n) = \|W_kj d_j\| / sqrt(N) at every joint k |
    | `total` | (p,) = \|W_j d_j\| / sqrt(N) over all joints |
    | `own` | (p,) part of it that no change of the other parameters can make up for |
    | `partners` | places of the parameters that could make up for most of the rest, best first |
    """

    torque: Array
    total: Array
    own: Array
    partners: tuple[tuple[int, ...], ...]

    @property
    def own_part(self) -> Array:
        """The part of each difference's torque that is its own, (p,)."""
        return np.divide(self.own, self.total, out=np.zeros_like(self.own), where=self.total > 0)

    def noticed(self, left: Array, *, alone: bool = False) -> Mask:
        """Return whether a difference matters against the errors `left` (n,) of some joint, (p,).

        `alone` counts only its own part.
        """
        torque = self.torque * self.own_part[:, None] if alone else self.torque
        return np.asarray(np.any(torque >= MATTERS * left, axis=1))

    def shared_with(self, j: int, left: Array, names: Sequence[str]) -> tuple[str, ...]:
        """Return the partners of a parameter whose difference matters as a whole but not alone."""
        shared = self.noticed(left)[j] and not self.noticed(left, alone=True)[j]
        return (tuple(names[k] for k in self.partners[j]) or (SEVERAL,)) if shared else ()


def evaluate_torque_cost(
    cause_data: CauseData, base: BaseParameters, difference: Array
) -> TorqueCost:
    """Return the torque of differences (p,) of base parameters; NaN counts as none."""
    places = cause_data.places(base.names)
    n = cause_data.n_judged
    d = np.nan_to_num(difference, nan=0.0)
    rows = [factor[:, places] for factor in cause_data.whole(cause_data.judged)]
    torque = np.array([np.linalg.norm(W, axis=0) for W in rows]).T * np.abs(d)[:, None] / np.sqrt(n)
    gram = sum((W.T @ W for W in rows), start=np.zeros((len(d), len(d))))
    whole = Scaled(gram)
    # 1 / (C^-1)_jj is what of a column's square the others leave.
    spread = np.sqrt(n * np.maximum(whole.inverse_diagonal, 1e-300))
    # An undetermined parameter has no torque of its own.
    own = np.where(whole.determined, np.abs(d) / spread, 0.0)
    present = np.flatnonzero(whole.present)
    alike = (gram / np.outer(whole.size, whole.size))[np.ix_(present, present)]
    return TorqueCost(
        torque=torque,
        total=np.sqrt(np.sum(torque**2, axis=1)),
        own=own,
        partners=_find_partners(present, alike, len(d)),
    )


def _find_partners(present: Indices, gram: Array, p: int) -> tuple[tuple[int, ...], ...]:
    """Return for each column those that together replace it best, from the Gram matrix.

    Orthogonal matching pursuit: the next column is the one most correlated with what the others
    leave (Pati, Rezaiifar and Krishnaprasad, Asilomar 1993).
    """
    found: list[tuple[int, ...]] = [()] * p
    for j, place in enumerate(present):
        chosen = list[int]()
        left = 1.0
        weights: Array = np.zeros(0)
        for _ in range(MOST_PARTNERS):
            correlation = np.abs(gram[:, j] - gram[:, chosen] @ weights)
            # Neither itself nor those chosen already.
            correlation[[j, *chosen]] = 0.0
            together = [*chosen, int(np.argmax(correlation))]
            inner = gram[np.ix_(together, together)]
            weights = np.asarray(np.linalg.lstsq(inner, gram[together, j])[0], dtype=np.float64)
            remaining = 1.0 - float(gram[j, together] @ weights)
            # One more that replaces little is no partner to name.
            if left - remaining < ABLE * left:
                break
            chosen = together
            left = remaining
        found[place] = tuple(int(present[k]) for k in chosen)
    return tuple(found)
