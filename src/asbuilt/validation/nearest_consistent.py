"""What the nearest consistent model costs in torque error on the recordings themselves."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from asbuilt.arrays import Array
from asbuilt.codec import make_plain
from asbuilt.tables import Column, Table, round_significant
from asbuilt.tables import format_share as percentage
from asbuilt.validation.comparison.comparison import recording_name
from asbuilt.validation.prediction import torque_units

if TYPE_CHECKING:
    from asbuilt.identification.result.result import IdentificationResult


@dataclass(frozen=True, slots=True)
class PoorPrediction:
    """Say when a joint is predicted poorly; own choices.

    Its error exceeds `error` times the identified model's error and `noticeable` of its torque.
    """

    error: float = 1.5
    noticeable: float = 0.1


POOR = PoorPrediction()


@dataclass(frozen=True, slots=True, eq=False)
class NearestModel:
    """Hold RMS torques and errors of every joint, each (n,) [N m or N].

    `identified`, `nearest` and `cad` are errors of the three models on the validation data named
    by `judged_by`, or else on the training data; `torque` is the torque measured there.
    `identified_fitted` and `nearest_fitted` are errors on the training data.
    """

    joint_names: tuple[str, ...]
    units: tuple[str, ...]
    judged_by: str
    torque: Array
    identified: Array
    nearest: Array
    cad: Array
    identified_fitted: Array
    nearest_fitted: Array

    @property
    def bad(self) -> tuple[int, ...]:
        """The joints, counted from 0, that the nearest model predicts poorly."""
        poor = (self.nearest > POOR.error * self.identified) & (
            self.nearest > POOR.noticeable * self.torque
        )
        return tuple(np.flatnonzero(poor).tolist())

    @property
    def worse_than_cad(self) -> bool:
        """Whether CAD predicts the recording better, all joints together."""
        return bool(np.linalg.norm(self.nearest) > np.linalg.norm(self.cad))

    def objection(self) -> str:
        """Return which joints it predicts poorly; empty if none."""
        poor = [
            f"{self.joint_names[k]}: {round_significant(self.nearest[k])} {self.units[k]} RMS in"
            " place"
            f" of {round_significant(self.identified[k])} (of {round_significant(self.torque[k])})"
            for k in self.bad
        ]
        if not poor and self.worse_than_cad:
            return "CAD predicts the recording better"
        return "; ".join(poor)

    def table(self) -> Table:
        """Return the errors of both, and of CAD, with the torque, joint by joint."""
        joints = zip(self.joint_names, self.units, strict=True)
        columns = (
            Column("RMS torque error"),
            *(Column(name, unit, "decimal", 3, width=16) for name, unit in joints),
            Column("of the torque", align="right", style=percentage),
        )
        whole = float(np.linalg.norm(self.torque))
        errors = {
            "as identified": self.identified,
            "as written": self.nearest,
            "CAD": self.cad,
            "measured torque": self.torque,
        }
        rows = (
            (what, *each.tolist(), float(np.linalg.norm(each)) / whole if whole else None)
            for what, each in errors.items()
        )
        return Table(columns, tuple(rows), title=f"On {self.judged_by}")

    def as_document(self) -> dict[str, Any]:
        """Return plain numbers and lists, ready for JSON."""
        errors = {
            "torque": self.torque,
            "identified": self.identified,
            "stand_in": self.nearest,
            "cad": self.cad,
            "identified_fitted": self.identified_fitted,
            "stand_in_fitted": self.nearest_fitted,
        }
        return {
            "judged_by": self.judged_by,
            "joints": list(self.joint_names),
            **make_plain(errors),
            "bad_joints": [self.joint_names[k] for k in self.bad],
        }


def compare_with_nearest(result: IdentificationResult, beta: ArrayLike) -> NearestModel | None:
    """Compare other base parameters (p,) with a result's on its own recordings.

    None if the result has no cause data.
    """
    cause_data = result.cause_data
    if cause_data is None:
        return None
    places = cause_data.places(result.base.names)
    fitted, held_out = (
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

    return NearestModel(
        joint_names=result.joint_names,
        units=torque_units(result.model),
        judged_by=recording_name(cause_data.judged_by),
        torque=error(held_out, np.zeros(len(values))),
        identified=error(held_out, result.estimates),
        nearest=error(held_out, values),
        cad=error(held_out, np.nan_to_num(result.cad_values, nan=0.0)),
        identified_fitted=error(fitted, result.estimates),
        nearest_fitted=error(fitted, values),
    )
