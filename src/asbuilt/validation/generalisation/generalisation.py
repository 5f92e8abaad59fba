"""Findings of validation data: whether the fit generalises, and joints at rest."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from asbuilt.experiment.signal.samples import Samples
from asbuilt.findings import Cure, Finding, join_names
from asbuilt.identification.result.torque_prediction import TorqueMetrics
from asbuilt.validation.comparison.comparison import recording_name
from asbuilt.validation.generalisation.repeated_motion import measure_repeated_share
from asbuilt.validation.generalisation.standstill import RestingErrors, divide_resting_errors
from asbuilt.validation.generalisation.unexplained import describe_large_errors
from asbuilt.validation.prediction import Validation


@dataclass(frozen=True, slots=True)
class GeneralisationLimits:
    """Say what validation data must not exceed; own choices, from recordings of seven real robots.

    Parameters
    ----------
    overfit
        Error of a joint, in multiples of its training error.
    noticeable
        Error of a joint as a fraction of its torque, below which `overfit` is no matter.
    behind_cad
        Error of a joint as built, in multiples of that of CAD.
    repeated
        Share of states that the training motion came near to: 0 to 0.2 for other motions, 0.5 for 2
        s blocks of a slow one.
    resting_energy
        Share of a joint's squared error at rest,.
    resting_ratio
        Its error at rest in multiples of that in motion,.
    resting_time
        And its share of the time at rest, from which static friction is named.
    """

    overfit: float = 2.0
    noticeable: float = 0.1
    behind_cad: float = 1.05
    repeated: float = 0.6
    resting_energy: float = 0.5
    resting_ratio: float = 2.0
    resting_time: float = 0.05


LIMITS = GeneralisationLimits()


def check_validations(
    train: TorqueMetrics, validations: Sequence[Validation], *, refitted: bool = False
) -> tuple[Finding, ...]:
    """Return what predictions of validation data say beside the training error of the same fit.

    `refitted` says that the training errors shown elsewhere are those of another, final fit.
    """
    if not validations:
        return (
            Finding(
                "nothing_held_out",
                "warning",
                "No validation data: errors are those of the training data and are too small",
                Cure(
                    "validate on another recording, or hold out blocks", {"holdout": "blocks:5s:3"}
                ),
            ),
        )
    return _merge_by_code(
        (recording_name(validation.source), finding)
        for validation in validations
        for finding in (
            *_report_generalisation(train, validation, refitted),
            *_report_rest(validation),
        )
    )


def _merge_by_code(found: Iterable[tuple[str, Finding]]) -> tuple[Finding, ...]:
    """Return the first finding of each code, which names the recordings of the others."""
    groups: dict[str, list[tuple[str, Finding]]] = {}
    for source, finding in found:
        groups.setdefault(finding.code, []).append((source, finding))
    merged: list[Finding] = []
    for (_, first), *others in groups.values():
        also = [source for source, _ in others]
        said = f"{first.message}; likewise on {join_names(also)}" if also else first.message
        merged.append(replace(first, message=said))
    return tuple(merged)


def check_repetitions(
    training: Sequence[Samples], validation: Sequence[Samples]
) -> tuple[Finding, ...]:
    """Return a finding for each validation recording that repeats the training motion."""
    return tuple(
        Finding(
            "held_out_repeats",
            "warning",
            f"{recording_name(samples.source)} repeats the training motion in {100 * share:.0f} %"
            " of its states, so its errors are not those of other motion",
            Cure("validate on another motion"),
        )
        for samples in validation
        if (share := measure_repeated_share(training, samples)) > LIMITS.repeated
    )


def _report_rest(validation: Validation) -> Iterator[Finding]:
    """Name joints whose error is mostly that of static friction while they rest."""
    errors = divide_resting_errors(validation)
    held = np.flatnonzero(_find_resting(errors))
    if held.size:
        listed = "; ".join(
            f"{errors.joint_names[k]} {100 * errors.energy[k]:.0f} % of the squared error in"
            f" {100 * errors.time[k]:.0f} % of the time, RMS {errors.resting[k]:.3g} at rest and"
            f" {errors.moving[k]:.3g} ({100 * errors.relative_moving[k]:.1f} %) in motion"
            for k in held
        )
        yield Finding(
            "error_at_standstill",
            "warning",
            f"Static friction at rest, which no friction law in velocity predicts, dominates the"
            f" errors on {recording_name(validation.source)}: {listed}",
            Cure("validate these joints by their motion"),
        )


def _find_resting(errors: RestingErrors) -> NDArray[np.bool_]:
    """Return which joints (n,) have an error that is mostly static friction at rest."""
    return np.asarray(
        (errors.energy > LIMITS.resting_energy)
        & (errors.resting > LIMITS.resting_ratio * errors.moving)
        & (errors.time > LIMITS.resting_time),
        dtype=np.bool_,
    )


def _report_generalisation(
    train: TorqueMetrics, validation: Validation, refitted: bool
) -> Iterator[Finding]:
    built, cad = validation.metrics_as_built, validation.metrics_cad
    source, rest = recording_name(built.source), divide_resting_errors(validation)
    error = np.where(_find_resting(rest), rest.moving, built.rms)

    def listed(joints: NDArray[np.int64], errors: NDArray[np.float64], than: TorqueMetrics) -> str:
        return join_names(
            [
                f"{built.joint_names[k]} ({errors[k]:.3g} for {than.rms[k]:.3g}"
                f" {validation.units[k]})"
                for k in joints
            ]
        )

    worse = np.flatnonzero(
        (error > LIMITS.overfit * train.rms) & (built.relative_error_per_joint > LIMITS.noticeable)
    )
    if worse.size:
        whose = " of the same fit" if refitted else ""
        yield Finding(
            "does_not_generalise",
            "warning",
            f"Errors on {source} are more than {LIMITS.overfit:g} times those in"
            f" training{whose} at {listed(worse, error, train)}{_word_times(validation, worse)}",
            Cure("record longer and more varied motion, or use fewer drive terms"),
            joint=built.joint_names[worse[0]] if len(worse) == 1 else None,
            torque=_measure_error_share(built, worse),
        )
    behind = np.flatnonzero(built.rms > LIMITS.behind_cad * cad.rms)
    if behind.size and np.any(validation.predicted_cad):
        yield Finding(
            "cad_predicts_better",
            "warning",
            f"CAD predicts {source} better than the fit at {listed(behind, built.rms, cad)}",
            Cure("record longer, or regularise toward CAD", {"method": "ridge"}),
            torque=_measure_error_share(built, behind),
        )


def _measure_error_share(metrics: TorqueMetrics, joints: NDArray[np.int64]) -> float:
    """Return the share of the squared torque error at some joints."""
    return float(np.sum(metrics.rms[joints] ** 2) / np.nansum(metrics.rms**2))


def _word_times(validation: Validation, joints: NDArray[np.int64]) -> str:
    """Return when the errors of joints are large, where most of them come at one time."""
    said = [
        f"{validation.joint_names[k]} {text.removeprefix(', ')}"
        for k in joints
        if (text := describe_large_errors(validation.t, validation.error[:, k]))
    ]
    return f"; {join_names(said)}" if said else ""
