"""A model that stands in for the identified one, such as the nearest that real bodies have.

What it costs on the recordings themselves.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from asbuilt.arrays import Array
from asbuilt.tables import Cell, Column, Shown, Table, significant
from asbuilt.tables import share as percentage
from asbuilt.validation.comparison.comparison import recording_name
from asbuilt.validation.prediction import torque_units

if TYPE_CHECKING:
    from asbuilt.identification.result.result import IdentificationResult


BADLY = 1.5
"""Error of a joint, in multiples of that of the identified model, from which a stand-in predicts it
badly,
"""
NOTICEABLE = 0.1
"""unless it is below this part of the joint's own torque."""


@dataclass(frozen=True, slots=True, eq=False)
class StandIn:
    """Hold RMS torques and errors of every joint, each (n,) [N m or N], of the identified model and
    of the one that stands in.

    `identified`, `stand_in` and `cad` are errors on what the result was `judged_by`; `torque` is
    the torque measured there; `identified_fitted` and `stand_in_fitted` are errors on the data
    used.
    """

    joint_names: tuple[str, ...]
    units: tuple[str, ...]
    judged_by: str
    torque: Array
    identified: Array
    stand_in: Array
    cad: Array
    identified_fitted: Array
    stand_in_fitted: Array

    @property
    def bad(self) -> tuple[int, ...]:
        """The joints, counted from 0, that the stand-in predicts badly."""
        badly = (self.stand_in > BADLY * self.identified) & (
            self.stand_in > NOTICEABLE * self.torque
        )
        return tuple(np.flatnonzero(badly).tolist())

    @property
    def worse_than_cad(self) -> bool:
        """Whether CAD predicts the recording better than the stand-in, all joints together."""
        return bool(np.linalg.norm(self.stand_in) > np.linalg.norm(self.cad))

    def complaint(self) -> str:
        """Say which joints it predicts badly; empty where none."""
        said = [
            f"{self.joint_names[k]}: {significant(self.stand_in[k])} {self.units[k]} RMS in place"
            f" of {significant(self.identified[k])} (of {significant(self.torque[k])})"
            for k in self.bad
        ]
        if not said and self.worse_than_cad:
            return "CAD itself predicts the recording better"
        return "; ".join(said)

    def table(self) -> Table:
        """Return the errors of both, and of CAD, beside the torque, joint by joint."""
        heads = [
            Column("RMS torque error"),
            *(
                Column(name, unit, "decimal", width=16)
                for name, unit in zip(self.joint_names, self.units, strict=True)
            ),
        ]
        heads.append(Column("of the torque", align="right"))
        whole = float(np.linalg.norm(self.torque))
        rows: list[tuple[Cell, ...]] = []
        for what, errors in (
            ("as identified", self.identified),
            ("as written", self.stand_in),
            ("CAD", self.cad),
            ("the torque itself", self.torque),
        ):
            cells = [Shown(float(error), significant(float(error))) for error in errors]
            part = float(np.linalg.norm(errors)) / whole if whole else None
            rows.append((what, *cells, Shown(part, percentage(part))))
        return Table(tuple(heads), tuple(rows), title=f"On {self.judged_by}")

    def as_document(self) -> dict[str, Any]:
        """Return plain numbers and lists, ready for JSON."""
        fields = ("torque", "identified", "stand_in", "cad", "identified_fitted", "stand_in_fitted")
        lists = {name: getattr(self, name).tolist() for name in fields}
        return {
            "judged_by": self.judged_by,
            "joints": list(self.joint_names),
            **lists,
            "bad_joints": [self.joint_names[k] for k in self.bad],
        }


def stand_in(result: IdentificationResult, beta: ArrayLike) -> StandIn | None:
    """Hold other base parameters (p,) against those of a result, on the motions that it was
    identified from and judged by; None where it carries no cause data.
    """
    cause_data = result.cause_data
    if cause_data is None:
        return None
    places = cause_data.places(result.base.names)
    fitted, judged = (
        [
            np.column_stack([factor[:, places], factor[:, -1]]) / np.sqrt(n)
            for factor in cause_data.whole(factors)
        ]
        for factors, n in (
            (cause_data.fitted, cause_data.n_fitted),
            (cause_data.judged, cause_data.n_judged),
        )
    )
    values = np.asarray(beta, dtype=np.float64)

    def error(rows: list[Array], parameters: Array) -> Array:
        return np.array([np.linalg.norm(row[:, -1] - row[:, :-1] @ parameters) for row in rows])

    return StandIn(
        joint_names=result.joint_names,
        units=torque_units(result.model),
        judged_by=recording_name(cause_data.judged_by),
        torque=error(judged, np.zeros(len(values))),
        identified=error(judged, result.estimates),
        stand_in=error(judged, values),
        cad=error(judged, np.nan_to_num(result.cad_values, nan=0.0)),
        identified_fitted=error(fitted, result.estimates),
        stand_in_fitted=error(fitted, values),
    )
