"""What the nearest consistent model costs in torque error on the recordings themselves."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from asbuilt.arrays import Array
from asbuilt.codec import make_plain
from asbuilt.identification.result.result import IdentificationResult
from asbuilt.tables import Column, Table, round_significant
from asbuilt.tables import format_share as percentage
from asbuilt.validation.comparison.comparison import recording_name
from asbuilt.validation.prediction import torque_units


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
        # All joints together, each by its own torque.
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
            # Poor joints are named; a model that is only worse on the whole has none to name.
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
            (what, *errors_of.tolist(), float(np.linalg.norm(errors_of)) / whole if whole else None)
            for what, errors_of in errors.items()
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
    names = result.base.names
    values = np.asarray(beta, dtype=np.float64)
    # The same sums with fitted data in place of held-out ones.
    fitted = replace(cause_data, judged=cause_data.fitted, n_judged=cause_data.n_fitted)
    return NearestModel(
        joint_names=result.joint_names,
        units=torque_units(result.model),
        judged_by=recording_name(cause_data.judged_by),
        torque=cause_data.error_of(names, np.zeros(len(values))),
        identified=cause_data.error_of(names, result.estimates),
        nearest=cause_data.error_of(names, values),
        cad=cause_data.error_of(names, np.nan_to_num(result.cad_values, nan=0.0)),
        identified_fitted=fitted.error_of(names, result.estimates),
        nearest_fitted=fitted.error_of(names, values),
    )
