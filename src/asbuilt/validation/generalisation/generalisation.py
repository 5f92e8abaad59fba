"""Whether a result carries over.

What the checks found, what was held out, and joints that stood still.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from asbuilt.experiment.quality.checks import RecordingCheck
from asbuilt.experiment.signal.samples import Samples
from asbuilt.identification.result.metrics import TorqueMetrics
from asbuilt.identification.result.result import IdentificationResult, IdentificationWarning
from asbuilt.validation.comparison.comparison import recording_name
from asbuilt.validation.generalisation.repeated_motion import repeated_share
from asbuilt.validation.generalisation.standstill import StandingErrors, standing_errors
from asbuilt.validation.prediction import Validation

STANDING_ERROR = 0.5
"""Share of a joint's squared error at standstill from which it is said so."""
OVERFIT = 2.0
"""Held-out error of a joint, in multiples of its error on the data used, from which the fit is said
not to generalise.
"""
NOTICEABLE = 0.1
"""Held-out error of a joint, as a fraction of its own torque, below which that is not said."""
REPEATED = 0.6
"""Share of held-out states that the motion fitted came near to from which it is said to be the same
motion; 0 to .2 for others, .5 for blocks of 2 s of a slow one.
"""
BEHIND_CAD = 1.05
"""Held-out error of a joint as built, in multiples of that of CAD, from which CAD is said to
predict better.
"""


def with_findings(
    result: IdentificationResult,
    checks: Sequence[RecordingCheck],
    validations: Sequence[Validation],
) -> IdentificationResult:
    """Return the result with its held-out metrics, the findings of the checks and the verdict on
    generalisation among its warnings.
    """
    found = [
        IdentificationWarning(
            finding.code, f"{recording_name(check.source)}: {finding.message}. {finding.cure}."
        )
        for check in checks
        for finding in check.warnings
    ]
    for validation in validations:
        found += _generalisation(result.train, validation) + _standstill(validation)
    if not validations:
        found.append(
            IdentificationWarning(
                "nothing_held_out",
                "No recording was held out: errors are those of the data used and flatter the fit."
                " Give --validate LOG or --holdout blocks:5s:3.",
            )
        )
    return replace(
        result,
        validation=tuple(validation.metrics_as_built for validation in validations),
        cad=validations[0].metrics_cad if validations else result.cad,
        warnings=(*result.warnings, *found),
    )


def with_repeats(
    result: IdentificationResult, fitted: Sequence[Samples], held_out: Sequence[Samples]
) -> IdentificationResult:
    """Return the result with a warning for held-out data whose motion is that of the data used."""
    found = [
        IdentificationWarning(
            "held_out_repeats",
            f"{recording_name(samples.source)} repeats the motion fitted ({100 * share:.0f} % of"
            " its states were there before): its errors say how well the robot repeats itself, not"
            " how well the model predicts another motion. Judge by another motion (--validate), or"
            " hold out part of a motion that does not come again.",
        )
        for samples in held_out
        if (share := repeated_share(fitted, samples)) > REPEATED
    ]
    return replace(result, warnings=(*result.warnings, *found))


def _standstill(validation: Validation) -> list[IdentificationWarning]:
    """Say where most of a joint's error falls on the time in which it stands still."""
    errors = standing_errors(validation)
    held = np.flatnonzero(_held(errors))
    if not held.size:
        return []
    listed = "; ".join(
        f"{errors.joint_names[k]}: {100 * errors.energy[k]:.0f} % of the squared error in the"
        f" {100 * errors.time[k]:.0f} % of the time it stands, RMS {errors.standing[k]:.3g} there"
        f" and {errors.moving[k]:.3g} ({100 * errors.relative_moving[k]:.1f} %) while it moves"
        for k in held
    )
    return [
        IdentificationWarning(
            "error_at_standstill",
            f"On {recording_name(validation.source)} static friction holds joints that stand while"
            " others move, and may take any value up to break-away, which no friction law in"
            f" velocity predicts. {listed}. Judge these joints by their motion.",
        )
    ]


def _held(errors: StandingErrors) -> NDArray[np.bool_]:
    """Tell the joints (n,) most of whose error is that of static friction at standstill, which says
    nothing of how the fit carries over.
    """
    return np.asarray(
        (errors.energy > STANDING_ERROR)
        & (errors.standing > 2.0 * errors.moving)
        & (errors.time > 0.05),
        dtype=np.bool_,
    )


def _generalisation(train: TorqueMetrics, validation: Validation) -> list[IdentificationWarning]:
    built, cad = validation.metrics_as_built, validation.metrics_cad
    found = []
    standing = standing_errors(validation)
    error = np.where(_held(standing), standing.moving, built.rms)
    worse = np.flatnonzero(
        (error > OVERFIT * train.rms) & (built.relative_error_per_joint > NOTICEABLE)
    )
    if worse.size:
        listed = ", ".join(
            f"{built.joint_names[k]} {error[k]:.3g} against {train.rms[k]:.3g}" for k in worse
        )
        found.append(
            IdentificationWarning(
                "does_not_generalise",
                f"Torque errors on {recording_name(built.source)} are more than {OVERFIT:g} times"
                f" those of the data used ({listed}): the recording is too short or too little"
                " varied for so many parameters. Record longer, add recordings, or use fewer drive"
                " terms.",
            )
        )
    behind = np.flatnonzero(built.rms > BEHIND_CAD * cad.rms)
    if behind.size:
        listed = ", ".join(
            f"{built.joint_names[k]} {built.rms[k]:.3g} against {cad.rms[k]:.3g}" for k in behind
        )
        found.append(
            IdentificationWarning(
                "cad_predicts_better",
                f"On {recording_name(built.source)} the CAD values predict these joints better than"
                f" the fit: {listed}.",
            )
        )
    return found
