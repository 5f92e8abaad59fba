"""Errors that a verdict goes by: of the fitted model, of what exports carry, and of CAD."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from asbuilt.arrays import Array
from asbuilt.errors import DescriptionError, IdentifiabilityError
from asbuilt.experiment.signal.samples import Samples
from asbuilt.identification import (
    IdentificationResult,
    StandardParameters,
    as_built_parameters,
)
from asbuilt.identification.result.torque_prediction import pair_with_measured, parameter_torque
from asbuilt.validation.prediction import Validation
from asbuilt.validation.rollout.position_errors import RolloutErrors
from asbuilt.validation.rollout.rollout import Rollout

Measure = Literal["torque", "rollout"]


@dataclass(frozen=True, slots=True)
class VerdictError:
    """Hold the errors of the fitted model, of the robot that exports carry, and of CAD.

    Shares of the torque, or position errors of rollouts [rad or m]; None where there is no such
    robot, or its simulation diverges.
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

    Its links have the standard parameters closest to CAD within the standard errors, its drives all
    identified terms. Nothing is added if there are no physically consistent links.
    """
    exported = export_parameters(result)
    if exported is None:
        return validation
    torque = np.zeros(samples.q.shape)
    for span in samples.spans():
        state = samples.q[span], samples.qd[span], samples.qdd[span]
        torque[span] = parameter_torque(result.model, result.base.drive, exported, *state)[1]
    return replace(
        validation, metrics_exported=pair_with_measured(result.model, samples, torque).metrics()
    )


def export_parameters(result: IdentificationResult) -> Array | None:
    """Return the standard parameters (n_standard,) of the exported robot; None without one."""
    found = find_as_built(result)
    return found.parameters if found and found.consistent else None


def find_as_built(result: IdentificationResult) -> StandardParameters | None:
    """Return the standard parameters as built; None if no robot has them."""
    try:
        return as_built_parameters(result)
    except (IdentifiabilityError, DescriptionError):
        return None


def find_worst_torque_error(
    result: IdentificationResult, validations: Sequence[Validation]
) -> VerdictError:
    """Return the errors on the recording that is predicted worst, else on the training data."""
    # A CAD without masses predicts nothing, and has no error to be better than.
    rows = [
        VerdictError(
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
        rows = [VerdictError(measured.relative_error, None, cad)]
    return max(rows, key=lambda row: row.decisive or 0.0)


def choose_decisive_rollout(rollouts: Sequence[Rollout]) -> Rollout | None:
    """Return the rollout of the longest windows that do not diverge as built; None without any."""
    longest = sorted(rollouts, key=lambda rollout: -rollout.horizon)
    whole = [rollout for rollout in longest if _read_finite_error(rollout.as_built) is not None]
    # The longest that does not diverge, else the shortest one.
    return (*whole, *reversed(longest), None)[0]


def summarise_rollout_error(rollout: Rollout) -> VerdictError:
    """Return the position errors of a rollout, whose robot as built is the exported one."""
    built = _read_finite_error(rollout.as_built)
    return VerdictError(built, built, _read_finite_error(rollout.cad))


def _read_finite_error(errors: RolloutErrors | None) -> float | None:
    return None if errors is None or errors.diverged else float(errors.rms_all)
