"""Errors of the three models of a study: as fitted, as exported, and CAD."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from asbuilt.arrays import Array
from asbuilt.codec import make_plain
from asbuilt.errors import DescriptionError, IdentifiabilityError
from asbuilt.experiment.signal.samples import Samples
from asbuilt.identification import (
    IdentificationResult,
    StandardParameters,
    as_built_parameters,
)
from asbuilt.identification.result.torque_prediction import pair_with_measured, parameter_torque
from asbuilt.tables import Column, Table, round_significant
from asbuilt.tables import format_share as percentage
from asbuilt.validation.comparison.comparison import recording_name
from asbuilt.validation.prediction import Validation, torque_units
from asbuilt.validation.rollout.position_errors import RolloutErrors
from asbuilt.validation.rollout.rollout import Rollout

Measure = Literal["torque", "rollout"]


@dataclass(frozen=True, slots=True)
class ModelErrors:
    """Hold the errors of the fitted model, of the robot that exports carry, and of CAD.

    Shares of the torque, or position errors of rollouts [rad or m]; None where there is no such
    robot, or its simulation diverges. `as_built`, as stored results name it, is the fitted model.
    """

    as_built: float | None
    exported: float | None
    cad: float | None

    @property
    def decisive(self) -> float | None:
        """The error of the exported robot; of the fitted model if nothing can be exported."""
        return self.as_built if self.exported is None else self.exported


def with_exported(
    result: IdentificationResult, validation: Validation, samples: Samples
) -> Validation:
    """Return a validation with the errors of the robot that exports of a result carry.

    Its links have the standard parameters closest to CAD within the noise of the data used, its
    drives all identified terms. Nothing is added if there are no physically consistent links.
    """
    exported = export_parameters(result)
    if exported is None:
        return validation
    torque = (
        parameter_torque(
            result.model,
            result.base.drive,
            exported,
            samples.q[span],
            samples.qd[span],
            samples.qdd[span],
        )[1]
        for span in samples.spans()
    )
    return replace(
        validation, metrics_exported=pair_with_measured(result.model, samples, torque).metrics()
    )


def export_parameters(result: IdentificationResult) -> Array | None:
    """Return the standard parameters (n_standard,) of the exported robot; None without one."""
    found = find_exported(result)
    return found.parameters if found and found.consistent else None


def find_exported(result: IdentificationResult) -> StandardParameters | None:
    """Return the robot that exports carry; None if no robot has the parameters of the fit."""
    try:
        return as_built_parameters(result)
    except (IdentifiabilityError, DescriptionError):
        return None


def find_worst_torque_error(
    result: IdentificationResult, validations: Sequence[Validation]
) -> ModelErrors:
    """Return the errors on the recording that is predicted worst, else on the training data."""
    # A CAD without masses predicts nothing, and has no error to be better than.
    rows = [
        ModelErrors(
            validation.metrics_as_built.relative_error,
            None
            if validation.metrics_exported is None
            else validation.metrics_exported.relative_error,
            validation.metrics_cad.relative_error if np.any(validation.predicted_cad) else None,
        )
        for validation in validations
    ]
    # Without predictions the result's own numbers decide.
    if not rows:
        measured = result.validation[0] if result.validation else result.train
        cad = result.cad.relative_error if np.any(np.nan_to_num(result.cad_values)) else None
        rows = [ModelErrors(measured.relative_error, None, cad)]
    return max(rows, key=lambda row: row.decisive or 0.0)


def choose_decisive_rollout(rollouts: Sequence[Rollout]) -> Rollout | None:
    """Return the rollout of the longest windows that do not diverge as built; None without any."""
    longest = sorted(rollouts, key=lambda rollout: -rollout.horizon)
    whole = [rollout for rollout in longest if _read_finite_error(rollout.as_built) is not None]
    # The longest that does not diverge, else the shortest one.
    return (*whole, *reversed(longest), None)[0]


def summarise_rollout_error(rollout: Rollout) -> ModelErrors:
    """Return the position errors of a rollout, whose robot as built is the exported one."""
    built = _read_finite_error(rollout.as_built)
    return ModelErrors(built, built, _read_finite_error(rollout.cad))


def _read_finite_error(errors: RolloutErrors | None) -> float | None:
    return None if errors is None or errors.diverged else float(errors.rms_all)


POOR_ERROR = 1.5
"""Error of a joint, in multiples of the identified model's, from which it is predicted poorly; own
choice."""
NOTICEABLE = 0.1
"""Share of its torque below which such an error does not count; own choice."""


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
        poor = (self.nearest > POOR_ERROR * self.identified) & (
            self.nearest > NOTICEABLE * self.torque
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
