"""Base tilt and springs that the description lacks and consistent links cannot imitate."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from asbuilt.description.model import RobotModel
from asbuilt.dynamics.drives.selection import DriveSet
from asbuilt.dynamics.drives.terms.spring import Spring
from asbuilt.errors import IdentifiabilityError, UsageError
from asbuilt.experiment.quality.running_statistics import IN_STEP, PositionMoments
from asbuilt.experiment.signal.samples import Samples
from asbuilt.findings import Cure, Finding
from asbuilt.identification.calibration.mounting import Mounting, find_mounting
from asbuilt.identification.calibration.mounting_evidence import relief_on_other_motions
from asbuilt.identification.drives.spring_search import suspected_springs
from asbuilt.identification.result.result import IdentificationResult

BADLY_FITTING = ("consistent_fit_costly", "consistent_fit_rejected")
"""Findings of the estimator for which base tilt and springs are looked for."""


@dataclass(frozen=True, slots=True)
class HiddenCauseLimits:
    """Say when a hidden cause is named; own choices, tested on virtual and real robots.

    Parameters
    ----------
    tilt
        Base tilt [rad] that nested models must find.
    relief
        Part of the torque residual that a tilt must take away if both are searched.
    searched
        Samples up to which a base tilt and springs are searched.
    """

    tilt: float = np.deg2rad(0.5)
    relief: float = 0.02
    searched: int = 30_000


LIMITS = HiddenCauseLimits()
TILTED = Cure("check the mounting, or estimate it", {"mounting": "estimate"})


@dataclass(frozen=True, slots=True, eq=False)
class HiddenCauses:
    """Hold findings of hidden causes, and the mounting that was estimated for them, if any."""

    findings: tuple[Finding, ...]
    mounting: Mounting | None


def find_hidden_causes(
    result: IdentificationResult,
    training: Sequence[Samples],
    drive: DriveSet,
    *,
    tilt: float | None = None,
    mounting: Mounting | None = None,
    block_seconds: float | None = None,
) -> HiddenCauses:
    """Find causes that seem to act without being described.

    Parameters
    ----------
    result
        The result; if its consistent fit is poor, springs are searched, and a base tilt if that
        is so or nested models have one. A tilt is named if it is significant by its own estimate,
        that of the mounting, and predicts groups of different motion better.
    training
        The samples it was identified from.
    drive
        The drive terms.
    tilt
        Base tilt [rad] of nested models; None if that was not asked.
    mounting
        The mounting that was estimated, if any; then no other is searched.
    block_seconds
        Length of the time blocks [s].
    """
    n_samples = sum(len(samples.t) for samples in training)
    searched = (
        any(finding.code in BADLY_FITTING for finding in result.findings)
        and n_samples <= LIMITS.searched
    )
    estimated = mounting is not None
    suspected = tilt is not None and (searched or tilt >= LIMITS.tilt)
    if not estimated and suspected and n_samples <= LIMITS.searched:
        mounting = _mounting(result, training, drive, block_seconds)
    tilted: tuple[Finding, ...] = ()
    if not estimated and mounting is not None:
        tilted = tuple(_tilt_findings(mounting, training, drive, block_seconds))
    elif not estimated and suspected and tilt is not None:
        tilted = tuple(_unsearched_tilt(tilt))
    springs: tuple[Finding, ...] = ()
    if searched:
        springs = tuple(
            _spring_findings(result, mounting, estimated, training, drive, block_seconds)
        )
    return HiddenCauses((*tilted, *springs), None if estimated else mounting)


def _mounting(
    result: IdentificationResult,
    training: Sequence[Samples],
    drive: DriveSet,
    block_seconds: float | None,
) -> Mounting | None:
    """Estimate the mounting; None if it is undetermined or there is no gravity."""
    try:
        return find_mounting(result.model, training, drive=drive, block_seconds=block_seconds)
    except (IdentifiabilityError, UsageError):
        return None


def _tilt_findings(
    mounting: Mounting,
    training: Sequence[Samples],
    drive: DriveSet,
    block_seconds: float | None,
) -> Iterator[Finding]:
    """Name a base tilt that is significant and predicts groups of different motion better."""
    if not (mounting.is_tilted and mounting.relief > LIMITS.relief):
        return
    relief = relief_on_other_motions(mounting, training, drive=drive, block_seconds=block_seconds)
    if relief is not None and relief[0] <= relief[1]:
        return
    holds = "" if relief is None else f", on motions held out {_lower(relief)}"
    yield Finding(
        "base_tilt",
        "warning",
        f"The base seems tilted by {np.rad2deg(mounting.angle):.1f} deg, which physically"
        f" consistent links cannot imitate: {mounting.sentence}{holds}",
        TILTED,
    )


def _lower(relief: tuple[float, float]) -> str:
    """Return how much lower the squared torque error is, as text."""
    fall, error = 1.0 - np.exp(-relief[0]), np.exp(-relief[0]) * relief[1]
    return f"{100 * fall:.0f} +- {100 * error:.0f} % less squared error"


def _unsearched_tilt(tilt: float) -> Iterator[Finding]:
    """Name the tilt of nested models where recordings are too long, or unfit, for the search."""
    if tilt >= LIMITS.tilt:
        yield Finding(
            "base_tilt",
            "warning",
            f"The base seems tilted by {np.rad2deg(tilt):.1f} deg against the description, which"
            " the links then imitate",
            TILTED,
        )


def _spring_findings(
    result: IdentificationResult,
    mounting: Mounting | None,
    estimated: bool,
    training: Sequence[Samples],
    drive: DriveSet,
    block_seconds: float | None,
) -> Iterator[Finding]:
    """Name springs that would explain what consistent links cannot, on the mounting found."""
    tilted = mounting is not None and mounting.is_tilted
    model = mounting.model if mounting is not None and tilted else result.model
    springs = suspected_springs(model, training, drive, block_seconds=block_seconds)
    if not springs:
        return
    described = [
        number for term in drive.terms if term.key == Spring.key for number in term.joints or ()
    ]
    joints = "/".join(map(str, sorted([*described, *(spring.joint + 1 for spring in springs)])))
    terms = ",".join((*drive.without(Spring.key).specifications, f"{Spring.key}:joints={joints}"))
    tilt = {"mounting": "estimate"} if tilted and not estimated else {}
    suspects = [spring.joint for spring in springs]
    yield Finding(
        "spring_suspected",
        "warning",
        "A spring would explain what physically consistent links cannot at"
        f" {', '.join(map(str, springs))}: cables or hoses that wind up there, or a sensor that"
        f" drifts with position{_correlated(model, training, suspects)}",
        Cure("if that can be, identify with the spring", {"drive": terms, **tilt}),
    )


def _correlated(model: RobotModel, training: Sequence[Samples], suspects: Sequence[int]) -> str:
    """Return which joints move as those of springs do, so that either may have the spring."""
    moments = PositionMoments.none(model.n_joints)
    for samples in training:
        moments = moments.with_more(samples.q)
    moving = moments.moving
    correlated = np.abs(moments.correlations(moving)) > IN_STEP
    pairs = []
    for k in (joint for joint in suspects if joint in moving):
        others = [
            model.joint_names[j]
            for j, same in zip(moving, correlated[moving.index(k)], strict=True)
            if same and j != k
        ]
        if others:
            pairs.append(f"{model.joint_names[k]} with {', '.join(others)}")
    return (
        f". Positions are correlated in this motion ({'; '.join(pairs)}), so that the spring may be"
        " at any of these joints"
        if pairs
        else ""
    )
