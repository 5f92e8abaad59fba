"""Findings of validation data: whether the fit generalises, and joints at rest."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from asbuilt.arrays import Array, Indices, Mask
from asbuilt.findings import Cure, Finding, join_names
from asbuilt.identification.result.torque_prediction import TorqueMetrics
from asbuilt.validation.comparison.comparison import recording_name
from asbuilt.validation.generalisation.unexplained import describe_large_errors
from asbuilt.validation.prediction import Validation

# Say what validation data must not exceed; own choices, from recordings of seven real robots.

GENERALISATION_OVERFIT = 2.0  # Error of a joint, in multiples of its training error
# Error of a joint as a fraction of its torque, below which `GENERALISATION_OVERFIT` is no matter
GENERALISATION_NOTICEABLE = 0.1
GENERALISATION_BEHIND_CAD = 1.05  # Error of a joint as built, in multiples of CAD's error
GENERALISATION_RESTING_ENERGY = 0.5  # Share of a joint's squared error at rest,
GENERALISATION_RESTING_RATIO = 2.0  # Its error at rest in multiples of that in motion,
# And its share of the time at rest, from which static friction is named
GENERALISATION_RESTING_TIME = 0.05


@dataclass(frozen=True, slots=True, eq=False)
class RestingErrors:
    """Divide the torque error of each joint, all (n,), into rest and motion.

    `time` is the share of samples at rest, `energy` the share of the squared error that falls on
    them; `resting` and `moving` are RMS errors, `relative_moving` the error in motion over the
    torque in motion. NaN if there are no such samples.
    """

    time: Array
    energy: Array
    resting: Array
    moving: Array
    relative_moving: Array

    @property
    def dominant(self) -> Mask:
        """Which joints (n,) have an error that is mostly static friction at rest."""
        return np.asarray(
            (self.energy > GENERALISATION_RESTING_ENERGY)
            & (self.resting > GENERALISATION_RESTING_RATIO * self.moving)
            & (self.time > GENERALISATION_RESTING_TIME)
        )


def divide_resting_errors(validation: Validation) -> RestingErrors:
    """Divide the errors of a prediction.

    At rest a joint is held by static friction, which may take any value up to break-away. A joint
    is at rest if its filtered velocity is exactly zero, which the signal chain makes it.
    """
    still = validation.velocity == 0.0
    error = validation.error
    # Joints that never rest, or never move, have no such errors.
    with np.errstate(invalid="ignore", divide="ignore"):
        squares = error**2
        resting, moving = (
            np.where(mask, squares, 0.0).sum(axis=0) / mask.sum(axis=0) for mask in (still, ~still)
        )
        torque = np.where(still, 0.0, validation.measured**2).sum(axis=0) / (~still).sum(axis=0)
        return RestingErrors(
            time=still.mean(axis=0),
            energy=np.where(still, squares, 0.0).sum(axis=0) / squares.sum(axis=0),
            resting=np.sqrt(resting),
            moving=np.sqrt(moving),
            relative_moving=np.sqrt(moving / torque),
        )


def check_validations(
    train: TorqueMetrics, validations: Sequence[Validation], *, refitted: bool = False
) -> tuple[Finding, ...]:
    """Return findings on validation errors, compared with the training error of the same fit.

    `refitted` says that the training errors shown elsewhere belong to another, final fit.
    """
    if not validations:
        return (
            Finding(
                "nothing_held_out",
                "warning",
                "No validation data: errors are of the training data and too small",
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
    first: dict[str, Finding] = {}
    others: dict[str, list[str]] = {}
    # Findings repeat in each recording: the first stands for all.
    for source, finding in found:
        if first.setdefault(finding.code, finding) is not finding:
            others.setdefault(finding.code, []).append(source)
    for code, sources in others.items():
        message = f"{first[code].message}; likewise on {join_names(sources)}"
        first[code] = replace(first[code], message=message)
    return tuple(first.values())


def _report_rest(validation: Validation) -> Iterator[Finding]:
    """Name joints whose error is mostly static friction while they rest."""
    errors = divide_resting_errors(validation)
    held = np.flatnonzero(errors.dominant)
    if held.size:
        listed = "; ".join(
            f"{validation.joint_names[k]} {100 * errors.energy[k]:.0f} % of the squared error in"
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


def _report_generalisation(
    train: TorqueMetrics, validation: Validation, refitted: bool
) -> Iterator[Finding]:
    built = validation.metrics_as_built
    cad = validation.metrics_cad
    source = recording_name(built.source)
    rest = divide_resting_errors(validation)
    # Static friction at rest is another finding, and no overfitting.
    error = np.where(rest.dominant, rest.moving, built.rms)

    def listed(joints: Indices, errors: Array, than: TorqueMetrics) -> str:
        return join_names(
            [
                f"{built.joint_names[k]} ({errors[k]:.3g} for {than.rms[k]:.3g}"
                f" {validation.units[k]})"
                for k in joints
            ]
        )

    worse = np.flatnonzero(
        # An error that is small compared with the torque is no matter, however it grew.
        (error > GENERALISATION_OVERFIT * train.rms)
        & (built.relative_error_per_joint > GENERALISATION_NOTICEABLE)
    )
    if worse.size:
        whose = " of the same fit" if refitted else ""
        yield Finding(
            "does_not_generalise",
            "warning",
            f"Errors on {source} are more than {GENERALISATION_OVERFIT:g} times those in"
            f" training{whose} at {listed(worse, error, train)}{_word_times(validation, worse)}",
            Cure("record longer and more varied motion, or use fewer drive terms"),
            joint=built.joint_names[worse[0]] if len(worse) == 1 else None,
            torque=_measure_error_share(built, worse),
        )
    behind = np.flatnonzero(built.rms > GENERALISATION_BEHIND_CAD * cad.rms)
    # Without masses CAD predicts nothing that could be better.
    if behind.size and np.any(validation.predicted_cad):
        yield Finding(
            "cad_predicts_better",
            "warning",
            f"CAD predicts {source} better than the fit at {listed(behind, built.rms, cad)}",
            Cure("record longer, or regularise toward CAD", {"method": "ridge"}),
            torque=_measure_error_share(built, behind),
        )


def _measure_error_share(metrics: TorqueMetrics, joints: Indices) -> float:
    """Return the share of the squared torque error at some joints."""
    return float(np.sum(metrics.rms[joints] ** 2) / np.nansum(metrics.rms**2))


def _word_times(validation: Validation, joints: Indices) -> str:
    """Return when the errors of joints are large, where most of them come at one time."""
    times = [
        f"{validation.joint_names[k]} {text.removeprefix(', ')}"
        for k in joints
        if (text := describe_large_errors(validation.t, validation.error[:, k]))
    ]
    return f"; {join_names(times)}" if times else ""
